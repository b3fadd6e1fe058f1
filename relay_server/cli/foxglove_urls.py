"""``switchboard foxglove-url``."""

from __future__ import annotations

import time
from typing import Any
from urllib.parse import urlsplit

import click

from relay_db import queries
from relay_db.queries import TokenRecord
from relay_protocol.errors import Invalid, NotFound, Unavailable
from relay_protocol.rights import Rules
from relay_server.cli.admin_socket_client import ask_status
from relay_server.cli.app import (
    App,
    examples,
    get_robot,
    json_option,
    number_argument,
    pass_app,
    user_id,
)
from relay_server.cli.output import format_duration, format_time, parse_duration, print_list, print_result
from relay_server.config import ListenAddress
from relay_server.foxglove_urls.schemas import LONGEST_SECONDS, SHORTEST_SECONDS, UrlLevel
from relay_server.foxglove_urls.service import require_level, websocket_url

_LOCAL = "ws://127.0.0.1:9090"

_ONLY_HERE = "It works only on this machine. For others give --relay with the relay's address, as wss://relay.example.org."


@click.group()
def foxglove_url() -> None:
    """Create, list and revoke URLs by which Foxglove and Lichtblick open a robot.

    Such a URL has a token in it, for one robot. A client that has the URL may do what it allows.
    """


@foxglove_url.command(
    epilog=examples(
        "switchboard foxglove-url create rover ann",
        "switchboard foxglove-url create rover ann --level operator --ttl 8h --relay wss://relay.example.org",
    )
)
@click.argument("robot")
@click.argument("user")
@click.option(
    "--level",
    type=click.Choice(["viewer", "operator"]),
    default="viewer",
    show_default=True,
    help="The most that it allows; never more than USER may. Driving needs 'operator'.",
)
@click.option("--ttl", default="30d", show_default=True, help="How long it is valid: 15m, 1h, 7d, 2w.")
@click.option("--label", default="", help="Its purpose, one line.")
@click.option(
    "--relay",
    metavar="URL",
    help=f"Address of the relay, as Foxglove reaches it; by default that of the running relay's portal, else {_LOCAL}.",
)
@json_option
@pass_app
def create(
    app: App, robot: str, user: str, level: UrlLevel, ttl: str, label: str, relay: str | None, as_json: bool
) -> None:
    """Create a URL for ROBOT that acts as USER. It is shown once and not stored."""
    seconds = parse_duration(ttl)
    if not SHORTEST_SECONDS <= seconds <= LONGEST_SECONDS:
        raise Invalid(f"a URL is valid for one minute to 366 days, not for {format_duration(seconds)}")
    with app.change() as change:
        found, whose = change.robot(robot), change.user(user)
        if whose.disabled:
            raise Invalid(f"user '{whose.full}' is disabled; enable it first")
        seen = queries.find_robot(change.session, found.name, whose.realm)
        if seen is None or seen.id != found.id:
            raise Invalid(f"robot '{found.full}' does not belong to the realm of user '{whose.full}'")
        grants = queries.grants_for(change.session, whose.id, found.id)
        require_level(Rules(grants), level, f"user '{whose.full}' is")
        number, token = change.create_foxglove_url(whose, found, level, seconds, label)
    url = websocket_url(relay or _address(app), found.name, token)
    answer = {"url": url, "expires_in": seconds, "id": number, "user": whose.full, "robot": found.full}
    print_result(as_json, {**answer, "level": level}, url)
    if not as_json:
        # Not to stdout, which a script may take as the URL.
        click.echo(f"URL {number}, valid for {format_duration(seconds)}. It is not shown again.", err=True)
        if level == "viewer":
            click.echo("It can watch, but not drive. A URL that drives needs --level operator.", err=True)
        if _is_loopback(url):
            click.echo(_ONLY_HERE, err=True)


def _address(app: App) -> str:
    """The portal's address, if a relay runs, as it knows it; otherwise this machine."""
    try:
        return str(ask_status(app.data).get("url") or _LOCAL)
    except Unavailable:
        return _LOCAL


def _is_loopback(url: str) -> bool:
    return ListenAddress(urlsplit(url).hostname or "", 0).loopback


@foxglove_url.command(
    "list", epilog=examples("switchboard foxglove-url list", "switchboard foxglove-url list --robot rover")
)
@click.option("--user", metavar="NAME", help="Only URLs of this user.")
@click.option("--robot", metavar="NAME", help="Only URLs of this robot.")
@json_option
@pass_app
def list_(app: App, user: str | None, robot: str | None, as_json: bool) -> None:
    """List URLs that have not expired, without their tokens."""
    with app.reading() as session:
        of_robot = None if robot is None else get_robot(session, robot).id
        found = queries.foxglove_tokens(
            session, time.time(), user_id=user_id(session, user), robot_id=of_robot
        )
        users = {each.id: each.full for each in queries.list_users(session)}
        robots = {each.id: each.full for each in queries.list_robots(session)}
    rows = [_row(each, users[each.user_id], robots.get(each.robot_id or 0, "")) for each in found]
    columns = ("id", "robot", "user", "level", "expires", "created", "label")
    cells = (
        (
            str(each["id"]),
            each["robot"],
            each["user"],
            each["level"],
            format_time(each["expires"]),
            format_time(each["created"]),
            each["label"],
        )
        for each in rows
    )
    print_list(as_json, rows, columns, cells)


@foxglove_url.command(epilog=examples("switchboard foxglove-url revoke 7"))
@number_argument
@json_option
@pass_app
def revoke(app: App, number: int, as_json: bool) -> None:
    """Revoke the URL of number ID. Connections that use it are cut at once."""
    with app.change() as change:
        if not change.revoke_foxglove_url(number):
            raise NotFound(f"there is no Foxglove URL {number}; see 'switchboard foxglove-url list'")
    print_result(as_json, {"id": number, "revoked": True}, f"Revoked Foxglove URL {number}.")


def _row(record: TokenRecord, user: str, robot: str) -> dict[str, Any]:
    return {
        "id": record.id,
        "robot": robot,
        "user": user,
        "level": record.scope,
        "label": record.label,
        "created": record.created,
        "expires": record.expires,
    }
