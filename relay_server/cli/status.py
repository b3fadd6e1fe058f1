"""``switchboard status``."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import click

from relay_protocol.errors import NotFound, Unavailable
from relay_protocol.realms import full_name, split_name
from relay_server.cli.admin_socket_client import ask_status
from relay_server.cli.app import App, examples, json_option, pass_app
from relay_server.cli.output import (
    Printable,
    format_duration,
    print_json,
    print_line,
    print_table,
    watch_live,
)

_ROBOT_COLUMNS = (
    "robot", "state", "control", "stopped", "people", "round trip", "from clients", "link", "drops", "battery",
)  # fmt: skip
_CLIENT_COLUMNS = ("user", "from", "for", "watches", "round trip", "to the robot", "link", "drops")
_NO_ROBOTS = "No robot has connected yet; 'switchboard robot list' shows which may."
_NONE = "–"


@click.command(
    epilog=examples(
        "switchboard status",
        "switchboard status --watch",
        "switchboard status rover --watch",
        "switchboard --data /srv/switchboard status --json",
    )
)
@click.argument("robot", required=False)
@click.option("--watch", is_flag=True, help="Refresh every second until q or Ctrl-C, in a terminal.")
@json_option
@pass_app
def status(app: App, robot: str | None, watch: bool, as_json: bool) -> None:
    """Show which robots are online, who uses them and how good the links are; with ROBOT also its clients.

    Asks the relay that runs on the data folder.
    """
    answer = _fetch_status(app, robot)
    if as_json:
        print_json(answer)
    elif watch and sys.stdout.isatty():
        watch_live(_updates(app, robot))
    else:
        head, *tables = _render(answer, robot)
        print_line(head.title)
        for each in tables:
            if each.columns:
                print_table(each.columns, each.cells)
            else:
                print_line(each.title)


def _fetch_status(app: App, robot: str | None) -> dict[str, Any]:
    """The relay's status, of one robot or of all.

    :raises NotFound: the relay does not know that robot
    """
    answer = ask_status(app.data)
    if robot is None:
        return answer
    full = full_name(*split_name(robot))
    mine = [each for each in _dicts(answer.get("robots")) if each.get("name") == full]
    if not mine:
        raise NotFound(
            f"the relay does not know a robot '{robot}'; 'switchboard robot list' shows which may connect"
        )
    return {**answer, "robots": mine}


def _updates(app: App, robot: str | None) -> Iterator[list[Printable]]:
    """The screens to draw. While the relay does not answer, its last status is shown with the reason."""
    last: list[Printable] = []
    while True:
        try:
            last = _render(_fetch_status(app, robot), robot)
            yield last
        except (Unavailable, NotFound) as error:
            yield [*last, Printable(f"{error} (showing the last status)")]


def _render(answer: dict[str, Any], robot: str | None) -> list[Printable]:
    uptime = answer.get("uptime_s")
    since = f", up {format_duration(uptime)}" if isinstance(uptime, int | float) else ""
    head = Printable(f"Relay {answer.get('relay', '?')}{since}")
    robots = _dicts(answer.get("robots"))
    if not robots:
        return [head, Printable(_NO_ROBOTS)]
    items = [head, Printable("", _ROBOT_COLUMNS, [_robot_row(each) for each in robots])]
    if robot is not None:
        now = time.time()
        rows = [_client_row(each, now) for each in _connections(robots[0])]
        items.append(Printable("", _CLIENT_COLUMNS, rows) if rows else Printable("No clients."))
    return items


def _robot_row(robot: dict[str, Any]) -> tuple[str, ...]:
    link = _Link.of(robot)
    return (
        str(robot.get("name", "?")),
        f"{robot.get('state', '?')}{' at another relay' if robot.get('elsewhere') else ''}",
        _control(robot),
        _stopped(robot.get("stopped")),
        _names(_connections(robot)),
        link.rtt,
        _rtt_range(each.get("robot_rtt_ms") for each in _dicts(robot.get("clients"))),
        link.quality,
        _number(robot.get("drops")),
        _percent(robot.get("battery")),
    )


def _client_row(person: dict[str, Any], now: float) -> tuple[str, ...]:
    since, link = person.get("since"), _Link.of(person)
    return (
        str(person.get("user", "?")),
        str(person.get("address", "?")),
        format_duration(max(0.0, now - since)) if isinstance(since, int | float) else _NONE,
        str(person.get("camera") or _NONE),
        link.rtt,
        _rtt_range([person.get("robot_rtt_ms")]),
        link.quality,
        _number(person.get("drops")),
    )


class _Link(NamedTuple):
    """The quality of a link as text."""

    rtt: str
    quality: str

    @classmethod
    def of(cls, end: dict[str, Any]) -> _Link:
        link = end.get("link")
        facts = link if isinstance(link, dict) else {}
        rtt = facts.get("rtt_ms", end.get("rtt_ms"))
        lost = facts.get("lost")
        losses = f", {lost} lost" if isinstance(lost, int) and lost else ""
        return cls(_rtt_range([rtt]), f"{facts.get('quality') or _NONE}{losses}")


def _rtt_range(round_trips: Iterable[Any]) -> str:
    """Round trip times in milliseconds, from the shortest to the longest known one."""
    known = [each for each in round_trips if isinstance(each, int | float)]
    if not known:
        return _NONE
    shortest, longest = f"{min(known):.1f}", f"{max(known):.1f}"
    return f"{shortest} ms" if shortest == longest else f"{shortest}–{longest} ms"


def _connections(robot: dict[str, Any]) -> list[dict[str, Any]]:
    return [*_dicts(robot.get("clients")), *_dicts(robot.get("viewers"))]


def _names(connections: Iterable[dict[str, Any]]) -> str:
    """Each user once, with the number of their connections."""
    times: dict[str, int] = {}
    for each in connections:
        name = str(each.get("user", "?"))
        times[name] = times.get(name, 0) + 1
    return ", ".join(name if count == 1 else f"{name} ({count})" for name, count in times.items()) or _NONE


def _control(robot: dict[str, Any]) -> str:
    """The holder of control, and the users who suppress or inhibit topics."""
    commands = [
        f"{each.get('by', '?')} commands {each.get('resource', '?')}"
        for each in _dicts(robot.get("suppressed"))
    ]
    quiet = [
        f"{each.get('by', '?')} {'holds' if each.get('hold') else 'inhibits'} {each.get('resource', '?')}"
        for each in _dicts(robot.get("inhibited"))
    ]
    return "; ".join([_named(robot.get("holder"), "user"), *commands, *quiet])


def _named(value: Any, field: str) -> str:
    return str(value.get(field) or "?") if isinstance(value, dict) else _NONE


def _stopped(value: Any) -> str:
    """The user who stopped a robot; until the robot has confirmed it, "being stopped by"."""
    by = _named(value, "by")
    if not isinstance(value, dict):
        return by
    again = f", again by {_named(value['again'], 'by')}" if value.get("again") else ""
    return (by if value.get("confirmed", True) else f"being stopped by {by}") + again


def _number(value: Any) -> str:
    return str(value) if isinstance(value, int) else _NONE


def _percent(value: Any) -> str:
    return f"{value:.0%}" if isinstance(value, int | float) else _NONE


def _dicts(value: Any) -> Sequence[dict[str, Any]]:
    return [each for each in value if isinstance(each, dict)] if isinstance(value, list) else []
