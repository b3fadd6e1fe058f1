"""``switchboard robot``."""

from __future__ import annotations

import shlex
import socket
from typing import Any

import click

from relay_db import queries
from relay_protocol.errors import Unavailable
from relay_protocol.limits import ENROLMENT_SECONDS
from relay_server.cli.app import App, examples, json_option, pass_app, robot_of, sure, yes_option
from relay_server.cli.control_socket import ask_status
from relay_server.cli.fleet import ORDERS
from relay_server.cli.names import known_realm, listed, new_name, realm_option
from relay_server.cli.output import duration, moment, show, tell
from relay_server.cli.remove import remove_named

_ROBOTS_PORT = 9091


@click.group()
def robot() -> None:
    """Add, list and remove robots and their keys; give orders to many of them."""


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
    """Add a robot NAME, or NAME@REALM, and print the code with which it enrols."""
    with app.change() as change:
        added, code = change.add_robot(*new_name(change.session, name), description)
    _tell_code(app, added, code, as_json, f"Added robot {added.full}.")


@robot.command(epilog=examples("switchboard robot code rover"))
@click.argument("name")
@json_option
@pass_app
def code(app: App, name: str, as_json: bool) -> None:
    """Print a new enrolment code for robot NAME; one that was not used yet is void."""
    with app.change() as change:
        found = change.robot(name)
        new = change.new_code(found)
    _tell_code(app, found, new, as_json)


@robot.command("list", epilog=examples("switchboard robot list --realm lab2 --json"))
@realm_option
@json_option
@pass_app
def list_(app: App, realm: str | None, as_json: bool) -> None:
    """List all robots, or those of one realm; 'switchboard status' tells which are online."""
    with app.reading() as session:
        robots = listed(session, queries.list_robots, realm)
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
    show(as_json, rows, ("robot", "live keys", "also of", "description"), cells)


@robot.command(epilog=examples('switchboard robot describe rover "Lab 3, by the window"'))
@click.argument("name")
@click.argument("description")
@json_option
@pass_app
def describe(app: App, name: str, description: str, as_json: bool) -> None:
    """Say in one line what robot NAME is, for people."""
    with app.change() as change:
        found = change.describe_robot(change.robot(name), description)
    told = {"robot": found.full, "description": found.description}
    tell(as_json, told, f"{found.full}: {found.description or 'no description'}")


@robot.command(epilog=examples("switchboard robot share mobile@lab1 lab2"))
@click.argument("name")
@click.argument("realm")
@json_option
@pass_app
def share(app: App, name: str, realm: str, as_json: bool) -> None:
    """Make robot NAME one of REALM too, under the same name.

    Rights on it can then be given there, and its administrators own it. Who is at the robot, and what they do with
    it, is told to all who have a right on it, whatever their realm.
    """
    with app.change() as change:
        found, realm = change.robot(name), known_realm(change.session, realm)
        change.share_robot(found, realm)
    answer = {"robot": found.full, "realm": realm, "shared": True}
    tell(as_json, answer, f"Robot {found.full} is of the realm {realm} too.")


@robot.command(epilog=examples("switchboard robot unshare mobile@lab1 lab2 --yes"))
@click.argument("name")
@click.argument("realm")
@yes_option
@json_option
@pass_app
def unshare(app: App, name: str, realm: str, yes: bool, as_json: bool) -> None:
    """Take robot NAME out of REALM; the rights on it that are held there go, and what is open by them is cut.

    What was recorded of it there is deleted: nobody could have it any more.
    """
    sure(f"Take {name} out of the realm {realm}, with the rights on it and the recordings of it there?", yes)
    with app.change() as change:
        found, realm = change.robot(name), known_realm(change.session, realm)
        change.unshare_robot(found, realm)
    answer = {"robot": found.full, "realm": realm, "shared": False}
    tell(as_json, answer, f"Robot {found.full} is not of the realm {realm} any more.")


@robot.command(epilog=examples("switchboard robot remove rover --yes"))
@click.argument("name")
@yes_option
@json_option
@pass_app
def remove(app: App, name: str, yes: bool, as_json: bool) -> None:
    """Remove robot NAME with its keys and all rights on it; its link is cut at once."""
    remove_named(app, "robot", name, yes, as_json)


@robot.command(
    epilog=examples("switchboard robot keys rover", "switchboard robot keys rover --revoke 0f3a52c1d4e5b697")
)
@click.argument("name")
@click.option("--revoke", metavar="FINGERPRINT", help="Retire this key; a link that uses it is cut at once.")
@json_option
@pass_app
def keys(app: App, name: str, revoke: str | None, as_json: bool) -> None:
    """List the keys of robot NAME, or retire one."""
    if revoke is not None:
        with app.change() as change:
            change.revoke_key(change.robot(name), revoke)
    with app.reading() as session:
        known = queries.list_keys(session, robot_of(session, name).id)
    cells = ((each.fingerprint, moment(each.created), _state(each), each.agent) for each in known)
    show(as_json, (each._asdict() for each in known), ("fingerprint", "enrolled", "state", "agent"), cells)


def _tell_code(app: App, found: queries.RobotRecord, new: str, as_json: bool, *before: str) -> None:
    answer: dict[str, Any] = {"robot": found.full, "enrolment_code": new, "expires_in": ENROLMENT_SECONDS}
    if as_json:
        tell(True, answer)
        return
    address, tls = _relay_address(app)
    command = ["switchboard-robot", "enroll", "--relay", address, *(["--tls"] if tls else [])]
    command += ["--robot", found.full, "--code", "-", "--state", "/var/lib/switchboard-robot/state"]
    tell(
        False,
        answer,
        *before,
        f"Enrolment code: {new} (good once, for {duration(ENROLMENT_SECONDS)})",
        "On the robot, run this and type the code in (an argument would be seen in the list of processes):",
        f"  {shlex.join(command)}",
    )


def _relay_address(app: App) -> tuple[str, bool]:
    """Where robots dial, and whether by TLS: this machine, as the relay that runs here says, if one does."""
    try:
        status = ask_status(app.data)
    except Unavailable:
        status = {}
    host = "127.0.0.1" if status.get("robots_loopback") else socket.gethostname()
    return f"{host}:{status.get('robots_port', _ROBOTS_PORT)}", bool(status.get("tls"))


def _live_keys(known: list[queries.KeyRecord]) -> int:
    return sum(each.retired is None for each in known)


def _state(key: queries.KeyRecord) -> str:
    return "live" if key.retired is None else f"retired {moment(key.retired)}"
