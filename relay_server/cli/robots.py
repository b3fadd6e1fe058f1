"""``switchboard robot``."""

from __future__ import annotations

import shlex
import socket
from typing import Any

import click

from relay_db import queries
from relay_protocol.errors import Unavailable
from relay_protocol.limits import ENROLMENT_SECONDS
from relay_server.cli.admin_socket_client import ask_status
from relay_server.cli.app import (
    App,
    confirm,
    examples,
    existing_realm,
    get_robot,
    json_option,
    list_in_realm,
    new_name,
    pass_app,
    realm_option,
    yes_option,
)
from relay_server.cli.fleet import ORDERS
from relay_server.cli.output import format_duration, format_time, print_list, print_result, remove_named

_ROBOTS_PORT = 9091


@click.group()
def robot() -> None:
    """Add, list and remove robots and their keys; send orders to many robots."""


for _name, _order in ORDERS.items():
    robot.add_command(_order, _name)


@robot.command(
    epilog=examples(
        "switchboard robot add rover",
        'switchboard robot add arm-2 --description "Lab 3"',
        "switchboard robot add mobile@lab2",
    )
)
@click.argument("name")
@click.option("--description", default="", help="One line for people.")
@json_option
@pass_app
def add(app: App, name: str, description: str, as_json: bool) -> None:
    """Add the robot NAME, or NAME@REALM, and print the code with which it enrols."""
    with app.change() as change:
        added, code = change.add_robot(*new_name(change.session, name), description)
    _print_code(app, added, code, as_json, f"Added robot {added.full}.")


@robot.command(epilog=examples("switchboard robot code rover"))
@click.argument("name")
@json_option
@pass_app
def code(app: App, name: str, as_json: bool) -> None:
    """Print a new enrolment code for robot NAME. An earlier code that was not used is void."""
    with app.change() as change:
        found = change.robot(name)
        new = change.new_code(found)
    _print_code(app, found, new, as_json)


@robot.command("list", epilog=examples("switchboard robot list --realm lab2 --json"))
@realm_option
@json_option
@pass_app
def list_(app: App, realm: str | None, as_json: bool) -> None:
    """List all robots, or those of one realm. 'switchboard status' shows which are online."""
    with app.reading() as session:
        robots = list_in_realm(session, queries.list_robots, realm)
        shares = {number: " ".join(sorted(of)) for number, of in queries.robot_shares(session).items()}
        live = {each.id: _live_keys(queries.list_keys(session, each.id)) for each in robots}
    rows = (
        {
            "robot": each.full,
            "description": each.description,
            "keys": live[each.id],
            "shared": shares.get(each.id, "").split(),
        }
        for each in robots
    )
    cells = (
        (
            each.full,
            str(live[each.id]) if live[each.id] else "not enrolled",
            shares.get(each.id, ""),
            each.description,
        )
        for each in robots
    )
    print_list(as_json, rows, ("robot", "live keys", "also of", "description"), cells)


@robot.command(epilog=examples('switchboard robot describe rover "Lab 3, by the window"'))
@click.argument("name")
@click.argument("description")
@json_option
@pass_app
def describe(app: App, name: str, description: str, as_json: bool) -> None:
    """Set the description of robot NAME, one line for people."""
    with app.change() as change:
        found = change.set_robot_description(change.robot(name), description)
    result = {"robot": found.full, "description": found.description}
    print_result(as_json, result, f"{found.full}: {found.description or 'no description'}")


@robot.command(epilog=examples("switchboard robot share mobile@lab1 lab2"))
@click.argument("name")
@click.argument("realm")
@json_option
@pass_app
def share(app: App, name: str, realm: str, as_json: bool) -> None:
    """Share robot NAME with REALM, under the same name.

    Rights on it can then be granted there, and administrators of that realm own it. All users with a right on
    the robot see who uses it and how, whatever their realm.
    """
    with app.change() as change:
        found, realm = change.robot(name), existing_realm(change.session, realm)
        change.share_robot(found, realm)
    answer = {"robot": found.full, "realm": realm, "shared": True}
    print_result(as_json, answer, f"Robot {found.full} now belongs to the realm {realm} too.")


@robot.command(epilog=examples("switchboard robot unshare mobile@lab1 lab2 --yes"))
@click.argument("name")
@click.argument("realm")
@yes_option
@json_option
@pass_app
def unshare(app: App, name: str, realm: str, yes: bool, as_json: bool) -> None:
    """Take robot NAME out of REALM. Rights that users of that realm have on it end, and their connections are
    cut.

    Recordings that belong to that realm are deleted, since no user could reach them.
    """
    confirm(
        f"Take {name} out of the realm {realm}, with the rights on it and the recordings of it there?", yes
    )
    with app.change() as change:
        found, realm = change.robot(name), existing_realm(change.session, realm)
        change.unshare_robot(found, realm)
    answer = {"robot": found.full, "realm": realm, "shared": False}
    print_result(as_json, answer, f"Robot {found.full} no longer belongs to the realm {realm}.")


@robot.command(epilog=examples("switchboard robot remove rover --yes"))
@click.argument("name")
@yes_option
@json_option
@pass_app
def remove(app: App, name: str, yes: bool, as_json: bool) -> None:
    """Remove robot NAME with its keys and all rights on it. Its link is cut at once."""
    remove_named(app, "robot", name, yes, as_json)


@robot.command(
    epilog=examples("switchboard robot keys rover", "switchboard robot keys rover --revoke 0f3a52c1d4e5b697")
)
@click.argument("name")
@click.option("--revoke", metavar="FINGERPRINT", help="Revoke this key; a link that uses it is cut at once.")
@json_option
@pass_app
def keys(app: App, name: str, revoke: str | None, as_json: bool) -> None:
    """List the keys of robot NAME, or revoke one."""
    if revoke is not None:
        with app.change() as change:
            change.revoke_key(change.robot(name), revoke)
    with app.reading() as session:
        known = queries.list_keys(session, get_robot(session, name).id)
    cells = ((each.fingerprint, format_time(each.created), _state(each), each.agent) for each in known)
    print_list(
        as_json, (each._asdict() for each in known), ("fingerprint", "enrolled", "state", "agent"), cells
    )


def _print_code(app: App, found: queries.RobotRecord, new: str, as_json: bool, *before: str) -> None:
    answer: dict[str, Any] = {"robot": found.full, "enrolment_code": new, "expires_in": ENROLMENT_SECONDS}
    if as_json:
        print_result(True, answer)
        return
    address, tls = _relay_address(app)
    command = ["switchboard-robot", "enroll", "--relay", address, *(["--tls"] if tls else [])]
    command += ["--robot", found.full, "--code", "-", "--state", "/var/lib/switchboard-robot/state"]
    print_result(
        False,
        answer,
        *before,
        f"Enrolment code: {new} (works once, for {format_duration(ENROLMENT_SECONDS)})",
        "On the robot, run this and type the code in (the process list would show an argument):",
        f"  {shlex.join(command)}",
        *(["With an authority of your own, write --ca ca.pem in place of --tls."] if tls else []),
    )


def _relay_address(app: App) -> tuple[str, bool]:
    """The address that robots dial, and whether it uses TLS. A running relay is asked; otherwise it is this
    machine."""
    try:
        status = ask_status(app.data)
    except Unavailable:
        status = {}
    host = status.get("robots_host") or socket.gethostname()
    shown = f"[{host}]" if ":" in host else host
    return f"{shown}:{status.get('robots_port', _ROBOTS_PORT)}", bool(status.get("robots_tls"))


def _live_keys(known: list[queries.KeyRecord]) -> int:
    return sum(each.retired is None for each in known)


def _state(key: queries.KeyRecord) -> str:
    return "live" if key.retired is None else f"retired {format_time(key.retired)}"
