"""``switchboard robot call|publish|set``: one order to many robots; ``switchboard robot group``."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable
from typing import Any

import click

from relay_db import queries
from relay_protocol.errors import Invalid, NotFound, Unavailable
from relay_protocol.realms import DEFAULT_REALM, full_name, parted
from relay_server.cli.app import App, examples, json_option, pass_app, sure, why_option, yes_option
from relay_server.cli.control_socket import give_order
from relay_server.cli.names import listed, new_name, of_one_realm, one_realm_option, realm_option
from relay_server.cli.output import progress, say, show, show_json, table, tell

SECONDS = 10.0
"""What each robot has where nothing else is said. A stop and a resume have their own time."""


def _number(value: float) -> float:
    """Click takes NaN for a number within any bounds."""
    if math.isnan(value):
        raise click.BadParameter("nan is no number")
    return value


timeout_option: Callable[[Any], Any] = click.option(
    "--timeout",
    type=click.FloatRange(0.1, 300),
    callback=lambda _context, _option, seconds: _number(seconds),
    default=SECONDS,
    show_default=True,
    help="Seconds each robot has.",
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
@click.option("--type", "type_name", default="", help="Of the service, where the robot does not tell.")
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

    ROBOTS is a name, a pattern ('cleaner-*') or a group (group:NAME), or several of them with commas between.
    A service that moves a robot takes control of it where that is free.
    """
    order = {"do": "call", "service": service, "args": _json(args, "ARGS"), "type": type_name}
    _give(app, robots, order, timeout, realm, as_json)


@click.command(
    epilog=examples(
        "switchboard robot publish 'cleaner-*' /mode '{\"data\": \"dock\"}' --type std_msgs/msg/String"
    )
)
@click.argument("robots")
@click.argument("topic")
@click.argument("msg")
@click.option("--type", "type_name", default="", help="Of the topic, where the robot does not tell.")
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

    ROBOTS is a name, a pattern ('cleaner-*') or a group (group:NAME), or several of them with commas between.
    Not for topics that move a robot: one message moves none.
    """
    order = {"do": "publish", "topic": topic, "msg": _json(msg, "MSG"), "type": type_name}
    _give(app, robots, order, timeout, realm, as_json)


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

    ROBOTS is a name, a pattern ('cleaner-*') or a group (group:NAME), or several of them with commas between.
    VALUE is JSON; what is none counts as text.
    """
    try:
        meant = json.loads(value)
    except ValueError:
        meant = value
    _give(app, robots, {"do": "set", "name": parameter, "value": meant}, timeout, realm, as_json)


@click.command(epilog=examples("switchboard robot stop 'cleaner-*' --why \"wet floor\""))
@click.argument("robots")
@why_option
@one_realm_option
@json_option
@pass_app
def stop(app: App, robots: str, why: str, realm: str | None, as_json: bool) -> None:
    """Stop many robots; those that are offline before anything else when they are back.

    ROBOTS is a name, a pattern ('cleaner-*') or a group (group:NAME), or several of them with commas between.
    Where no relay runs, 'switchboard stop' keeps the order.
    """
    _give(app, robots, {"do": "stop", "why": why}, SECONDS, realm, as_json)


@click.command(epilog=examples("switchboard robot resume 'cleaner-*'"))
@click.argument("robots")
@why_option
@one_realm_option
@json_option
@pass_app
def resume(app: App, robots: str, why: str, realm: str | None, as_json: bool) -> None:
    """Let many robots that were stopped move again.

    ROBOTS is a name, a pattern ('cleaner-*') or a group (group:NAME), or several of them with commas between.
    """
    _give(app, robots, {"do": "resume", "why": why}, SECONDS, realm, as_json)


def _json(text: str, what: str) -> Any:
    """:raises Invalid: it is no JSON"""
    try:
        return json.loads(text)
    except ValueError as error:
        raise Invalid(f"{what} is no JSON: {error}") from None


def _give(
    app: App, robots: str, order: dict[str, Any], timeout: float, realm: str | None, as_json: bool
) -> None:
    """Give an order, show how it goes, and what came of it; exit code 1 when it failed on any robot.

    :param realm: the one that was named besides the robots
    """
    where, asked = of_one_realm([each.strip() for each in robots.split(",") if each.strip()], realm)
    if not order.get("type", True):
        del order["type"]
    lines = give_order(app.data, {"robots": asked, "timeout": timeout, **order}, where)
    try:
        done = _Done(next(lines, {}), where)
    except NotFound as error:
        if where == DEFAULT_REALM:
            raise
        raise NotFound(f"{error} in the realm '{where}'; see 'switchboard realm list'") from None
    with progress(len(done.meant), shown=not as_json and sys.stderr.isatty()) as step:
        try:
            for line in lines:
                if "robot" in line:
                    done.results.append({**line, "robot": full_name(str(line["robot"]), where)})
                    step()
        except Unavailable as error:
            done.broken = str(error)
    if as_json:
        told = {"results": done.results, "unmatched": done.unmatched, "whole": done.whole}
        show_json({**told, "missed": done.missed} if done.missed else told)
    else:
        done.show()
    if not done.well:
        sys.exit(1)


class _Done:
    """What came of an order.

    :param head: the first line of the relay's answer
    :param realm: whose robots it was for
    """

    def __init__(self, head: dict[str, Any], realm: str) -> None:
        self._where = "" if realm == DEFAULT_REALM else f" of the realm '{realm}'"
        self.meant = [str(each) for each in head.get("robots") or ()]
        self.unmatched = [str(each) for each in head.get("unmatched") or ()]
        self.missed = str(head.get("missed") or "")
        self.results: list[dict[str, Any]] = []
        self.broken = "it has ended the answer"

    @property
    def whole(self) -> bool:
        """Whether every robot is told of."""
        return len(self.results) == len(self.meant)

    @property
    def well(self) -> bool:
        """Whether all that was asked for is done."""
        return (
            self.whole
            and not (self.unmatched or self.missed)
            and all(each.get("ok") for each in self.results)
        )

    def show(self) -> None:
        """For people."""
        results = sorted(self.results, key=lambda each: str(each.get("robot")))
        table(("robot", "", "time", "answer"), [_row(each) for each in results])
        say(f"Done on {sum(bool(each.get('ok')) for each in results)} of {len(self.meant)}.")
        if not self.whole:
            left = len(self.meant) - len(results)
            say(f"Of {left} nothing is known: the relay did not tell to the end ({self.broken}).")
        if self.missed:
            say(f"There may be more robots that are meant: {self.missed}.")
        for each in self.unmatched:
            say(f"No robot{self._where} is meant by '{each}'.")


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
    """Put robots into groups, for orders to all of them."""


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
    """Put ROBOTS into group NAME of their realm, which is made when there is none."""
    with app.change() as change:
        meant = [change.robot(each) for each in robots]
        found = change.fill_robot_group(*new_name(change.session, name), meant)
    tell(as_json, _told(found), _words(found))


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
    """Take ROBOTS out of group NAME; without any, remove the group. Its robots stay."""
    if not robots:
        with app.reading() as session:
            sure(f"Remove group of robots {_group(session, name).full}?", yes)
    with app.change() as change:
        found = _group(change.session, name)
        meant = [change.robot(each) for each in robots]
        left = change.empty_robot_group(found, meant) if robots else None
        if left is None:
            change.remove_robot_group(found)
    if left is None:
        tell(as_json, {"group": found.full, "removed": True}, f"Removed group of robots {found.full}.")
    else:
        tell(as_json, _told(left), _words(left))


@group.command(
    "list", epilog=examples("switchboard robot group list", "switchboard robot group list --realm lab2")
)
@realm_option
@json_option
@pass_app
def list_(app: App, realm: str | None, as_json: bool) -> None:
    """List all groups of robots, or those of one realm, and what is in them."""
    with app.reading() as session:
        groups = listed(session, queries.list_robot_groups, realm)
    cells = ((each.full, ", ".join(_robots(each))) for each in groups)
    show(as_json, map(_told, groups), ("group", "robots"), cells)


def _group(session: Any, name: str) -> queries.RobotGroupRecord:
    """:raises NotFound: no such group"""
    found = queries.find_robot_group(session, *parted(name))
    if found is None:
        raise NotFound(f"there is no group of robots '{name}'; see 'switchboard robot group list'")
    return found


def _told(record: queries.RobotGroupRecord) -> dict[str, Any]:
    return {"group": record.full, "robots": _robots(record)}


def _words(record: queries.RobotGroupRecord) -> str:
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
