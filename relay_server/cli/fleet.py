"""``switchboard robot call|publish|set|stop|resume``: one order to many robots; ``switchboard robot group``."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from typing import Any
from uuid import uuid4

import click

from relay_db import queries
from relay_protocol.errors import Invalid, NotFound, Unavailable
from relay_protocol.realms import DEFAULT_REALM, full_name, split_name
from relay_server.cli.admin_socket_client import send_fleet_order
from relay_server.cli.app import (
    App,
    confirm,
    examples,
    json_option,
    list_in_realm,
    new_name,
    one_realm_option,
    pass_app,
    realm_option,
    resolve_realm,
    why_option,
    yes_option,
)
from relay_server.cli.output import print_json, print_line, print_list, print_result, print_table, progress

ROBOT_SECONDS = 10.0
"""Default time for each robot. A stop and a resume have times of their own."""


def _number(value: float) -> float:
    """Click accepts NaN within any bounds."""
    if math.isnan(value):
        raise click.BadParameter("nan is not a number")
    return value


timeout_option: Callable[[Any], Any] = click.option(
    "--timeout",
    type=click.FloatRange(0.1, 300),
    callback=lambda _context, _option, seconds: _number(seconds),
    default=ROBOT_SECONDS,
    show_default=True,
    help="Seconds that each robot has.",
)


@click.command(
    epilog=examples(
        "switchboard robot call 'cleaner-*' /start",
        "switchboard robot call group:cleaners /set_mode '{\"data\": true}' --type std_srvs/srv/SetBool",
        "switchboard robot call 'cleaner-*' /start --realm lab2",
    )
)
@click.argument("robots")
@click.argument("service")
@click.argument("args", default="{}")
@click.option("--type", "type_name", default="", help="Type of the service, if the robot does not know it.")
@timeout_option
@one_realm_option
@json_option
@pass_app
def call(
    app: App,
    robots: str,
    service: str,
    args: str,
    type_name: str,
    timeout: float,
    realm: str | None,
    as_json: bool,
) -> None:
    """Call SERVICE with ARGS (JSON) on many robots.

    ROBOTS is a name, a pattern ('cleaner-*') or a group (group:NAME), or several of them separated by commas.
    A service that moves a robot takes control of it, if no client has control.
    """
    order = {"do": "call", "service": service, "args": _json(args, "ARGS"), "type": type_name}
    run_order(app, robots, order, timeout, realm, as_json)


@click.command(
    epilog=examples(
        "switchboard robot publish 'cleaner-*' /mode '{\"data\": \"dock\"}' --type std_msgs/msg/String"
    )
)
@click.argument("robots")
@click.argument("topic")
@click.argument("msg")
@click.option("--type", "type_name", default="", help="Type of the topic, if the robot does not know it.")
@timeout_option
@one_realm_option
@json_option
@pass_app
def publish(
    app: App,
    robots: str,
    topic: str,
    msg: str,
    type_name: str,
    timeout: float,
    realm: str | None,
    as_json: bool,
) -> None:
    """Publish MSG (JSON) once to TOPIC on many robots.

    ROBOTS is a name, a pattern ('cleaner-*') or a group (group:NAME), or several of them separated by commas.
    Topics that move a robot are refused, since they need a stream of messages.
    """
    order = {"do": "publish", "topic": topic, "msg": _json(msg, "MSG"), "type": type_name}
    run_order(app, robots, order, timeout, realm, as_json)


@click.command(epilog=examples("switchboard robot set 'cleaner-*' /driver:max_speed 0.5"))
@click.argument("robots")
@click.argument("parameter")
@click.argument("value")
@timeout_option
@one_realm_option
@json_option
@pass_app
def set_(
    app: App, robots: str, parameter: str, value: str, timeout: float, realm: str | None, as_json: bool
) -> None:
    """Set PARAMETER (node:name) to VALUE on many robots.

    ROBOTS is a name, a pattern ('cleaner-*') or a group (group:NAME), or several of them separated by commas.
    VALUE is JSON; anything else is taken as text.
    """
    try:
        decoded = json.loads(value)
    except ValueError:
        decoded = value
    run_order(app, robots, {"do": "set", "name": parameter, "value": decoded}, timeout, realm, as_json)


@click.command(epilog=examples("switchboard robot stop 'cleaner-*' --why \"wet floor\""))
@click.argument("robots")
@why_option
@one_realm_option
@json_option
@pass_app
def stop(app: App, robots: str, why: str, realm: str | None, as_json: bool) -> None:
    """Stop many robots. Robots that are offline are stopped as soon as they come back.

    ROBOTS is a name, a pattern ('cleaner-*') or a group (group:NAME), or several of them separated by commas.
    This needs a running relay; 'switchboard stop' works without one.
    """
    run_order(app, robots, {"do": "stop", "why": why, "stop_id": uuid4().hex}, ROBOT_SECONDS, realm, as_json)


@click.command(epilog=examples("switchboard robot resume 'cleaner-*'"))
@click.argument("robots")
@why_option
@one_realm_option
@json_option
@pass_app
def resume(app: App, robots: str, why: str, realm: str | None, as_json: bool) -> None:
    """Let many stopped robots move again.

    ROBOTS is a name, a pattern ('cleaner-*') or a group (group:NAME), or several of them separated by commas.
    """
    run_order(app, robots, {"do": "resume", "why": why}, ROBOT_SECONDS, realm, as_json)


def _json(text: str, what: str) -> Any:
    try:
        return json.loads(text)
    except ValueError as error:
        raise Invalid(f"{what} is not JSON: {error}") from None


def run_order(
    app: App, robots: str, order: dict[str, Any], timeout: float, realm: str | None, as_json: bool
) -> None:
    """Give an order and show its progress and results. The exit code is 1 when it failed on any robot.

    :param realm: the option ``--realm``
    """
    in_realm, asked = resolve_realm([each.strip() for each in robots.split(",") if each.strip()], realm)
    if not order.get("type", True):
        del order["type"]
    lines = send_fleet_order(app.data, {"robots": asked, "timeout": timeout, **order}, in_realm)
    try:
        report = _OrderReport(next(lines, {}), in_realm)
    except NotFound as error:
        if in_realm == DEFAULT_REALM:
            raise
        raise NotFound(f"{error} in the realm '{in_realm}'; see 'switchboard realm list'") from None
    with progress(len(report.robots), shown=not as_json and sys.stderr.isatty()) as step:
        try:
            for line in lines:
                if "robot" in line:
                    report.results.append({**line, "robot": full_name(str(line["robot"]), in_realm)})
                    step()
        except Unavailable as error:
            report.interruption = str(error)
    if as_json:
        result = {"results": report.results, "unmatched": report.unmatched, "whole": report.complete}
        print_json({**result, "missed": report.missed} if report.missed else result)
    else:
        report.show()
    if not report.succeeded:
        sys.exit(1)


class _OrderReport:
    """The results of an order.

    :param head: first line of the relay's answer
    :param realm: of the robots
    """

    def __init__(self, head: dict[str, Any], realm: str) -> None:
        self._where = "" if realm == DEFAULT_REALM else f" of the realm '{realm}'"
        self.robots = [str(each) for each in head.get("robots") or ()]
        self.unmatched = [str(each) for each in head.get("unmatched") or ()]
        self.missed = str(head.get("missed") or "")
        self.results: list[dict[str, Any]] = []
        self.interruption = "the answer ended early"

    @property
    def complete(self) -> bool:
        """Whether there is a result for every robot."""
        return len(self.results) == len(self.robots)

    @property
    def succeeded(self) -> bool:
        """Whether the order was carried out on every robot that it was meant for."""
        return (
            self.complete
            and not (self.unmatched or self.missed)
            and all(each.get("ok") for each in self.results)
        )

    def show(self) -> None:
        """Print the results for people."""
        results = sorted(self.results, key=lambda each: str(each.get("robot")))
        print_table(("robot", "", "time", "answer"), [_row(each) for each in results])
        print_line(f"Done on {sum(bool(each.get('ok')) for each in results)} of {len(self.robots)}.")
        if not self.complete:
            left = len(self.robots) - len(results)
            print_line(
                f"For {left} robots the result is not known: the relay's answer is incomplete ({self.interruption})."
            )
        if self.missed:
            print_line(f"The order may be meant for more robots: {self.missed}.")
        for each in self.unmatched:
            print_line(f"'{each}' matches no robot{self._where}.")


def _row(result: dict[str, Any]) -> tuple[str, ...]:
    seconds, values = result.get("seconds"), result.get("values")
    words = str(result.get("message") or "")
    return (
        str(result.get("robot")),
        "ok" if result.get("ok") else "FAILED",
        f"{seconds:.2f} s" if isinstance(seconds, int | float) else "–",
        words or ("" if values in (None, {}) else json.dumps(values)),
    )


# --- groups -----------------------------------------------------------------------------------------------


@click.group()
def group() -> None:
    """Put robots into groups, to send orders to all of them."""


@group.command(
    epilog=examples(
        "switchboard robot group add cleaners cleaner-1 cleaner-2",
        "switchboard robot group add cleaners@lab2 cleaner-1@lab2",
    )
)
@click.argument("name")
@click.argument("robots", nargs=-1)
@json_option
@pass_app
def add(app: App, name: str, robots: tuple[str, ...], as_json: bool) -> None:
    """Put ROBOTS into group NAME of their realm. The group is created if there is none."""
    with app.change() as change:
        chosen = [change.robot(each) for each in robots]
        found = change.fill_robot_group(*new_name(change.session, name), chosen)
    print_result(as_json, _group_json(found), _group_text(found))


@group.command(
    epilog=examples(
        "switchboard robot group remove cleaners cleaner-1", "switchboard robot group remove cleaners --yes"
    )
)
@click.argument("name")
@click.argument("robots", nargs=-1)
@yes_option
@json_option
@pass_app
def remove(app: App, name: str, robots: tuple[str, ...], yes: bool, as_json: bool) -> None:
    """Take ROBOTS out of group NAME. Without ROBOTS, remove the group; its robots stay."""
    if not robots:
        with app.reading() as session:
            confirm(f"Remove group of robots {_group(session, name).full}?", yes)
    with app.change() as change:
        found = _group(change.session, name)
        chosen = [change.robot(each) for each in robots]
        left = change.empty_robot_group(found, chosen) if robots else None
        if left is None:
            change.remove_robot_group(found)
    if left is None:
        print_result(
            as_json, {"group": found.full, "removed": True}, f"Removed group of robots {found.full}."
        )
    else:
        print_result(as_json, _group_json(left), _group_text(left))


@group.command(
    "list", epilog=examples("switchboard robot group list", "switchboard robot group list --realm lab2")
)
@realm_option
@json_option
@pass_app
def list_(app: App, realm: str | None, as_json: bool) -> None:
    """List all groups of robots and their robots, or those of one realm."""
    with app.reading() as session:
        groups = list_in_realm(session, queries.list_robot_groups, realm)
    cells = ((each.full, ", ".join(_robots(each))) for each in groups)
    print_list(as_json, map(_group_json, groups), ("group", "robots"), cells)


def _group(session: Any, name: str) -> queries.RobotGroupRecord:
    found = queries.find_robot_group(session, *split_name(name))
    if found is None:
        raise NotFound(f"there is no group of robots '{name}'; see 'switchboard robot group list'")
    return found


def _group_json(record: queries.RobotGroupRecord) -> dict[str, Any]:
    return {"group": record.full, "robots": _robots(record)}


def _group_text(record: queries.RobotGroupRecord) -> str:
    return f"Group {record.full}: {', '.join(_robots(record)) or 'no robots'}."


def _robots(record: queries.RobotGroupRecord) -> list[str]:
    return [full_name(each, record.realm) for each in record.robots]


ORDERS = {
    "call": call,
    "publish": publish,
    "set": set_,
    "stop": stop,
    "resume": resume,
    "group": group,
}
"""Commands of ``switchboard robot``."""
