"""``switchboard status``."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import click

from relay_protocol.errors import NotFound, Unavailable
from relay_protocol.realms import full_name, parted
from relay_server.cli.app import App, examples, json_option, pass_app
from relay_server.cli.control_socket import ask_status
from relay_server.cli.output import Printable, duration, say, show_json, table, watch_sheets

_ROBOTS = (
    "robot", "state", "control", "stopped", "people", "round trip", "from people", "link", "drops", "battery",
)  # fmt: skip
_PEOPLE = ("user", "from", "for", "watches", "round trip", "to the robot", "link", "drops")
_NOBODY = "No robot has dialled in yet; 'switchboard robot list' shows which may."
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
@click.option("--watch", is_flag=True, help="Show it anew every second until Ctrl-C, in a terminal.")
@json_option
@pass_app
def status(app: App, robot: str | None, watch: bool, as_json: bool) -> None:
    """Show which robots are online, who is there and how good the links are; of one ROBOT, who exactly.

    Asks the relay that runs on the data folder.
    """
    answer = _asked(app, robot)
    if as_json:
        show_json(answer)
    elif watch and sys.stdout.isatty():
        watch_sheets(_sheets(app, robot))
    else:
        head, *tables = _drawn(answer, robot)
        say(head.title)
        for each in tables:
            if each.columns:
                table(each.columns, each.cells)
            else:
                say(each.title)


def _asked(app: App, robot: str | None) -> dict[str, Any]:
    """What the relay says, of one robot or of all.

    :raises NotFound: the relay has not seen that robot
    """
    answer = ask_status(app.data)
    if robot is None:
        return answer
    full = full_name(*parted(robot))
    mine = [each for each in _dicts(answer.get("robots")) if each.get("name") == full]
    if not mine:
        raise NotFound(
            f"the relay has not seen a robot '{robot}'; 'switchboard robot list' shows which may dial in"
        )
    return {**answer, "robots": mine}


def _sheets(app: App, robot: str | None) -> Iterator[list[Printable]]:
    """What is drawn, time after time; while the relay is away, what it said last, and why there is nothing new."""
    last: list[Printable] = []
    while True:
        try:
            last = _drawn(_asked(app, robot), robot)
            yield last
        except (Unavailable, NotFound) as error:
            yield [*last, Printable(f"{error} (shown is what was)")]


def _drawn(answer: dict[str, Any], robot: str | None) -> list[Printable]:
    uptime = answer.get("uptime_s")
    since = f", up {duration(uptime)}" if isinstance(uptime, int | float) else ""
    head = Printable(f"Relay {answer.get('relay', '?')}{since}")
    robots = _dicts(answer.get("robots"))
    if not robots:
        return [head, Printable(_NOBODY)]
    sheets = [head, Printable("", _ROBOTS, [_row(each) for each in robots])]
    if robot is not None:
        now = time.time()
        there = [_person(each, now) for each in _people(robots[0])]
        sheets.append(Printable("", _PEOPLE, there) if there else Printable("Nobody is there."))
    return sheets


def _row(robot: dict[str, Any]) -> tuple[str, ...]:
    link = _Link.of(robot)
    return (
        str(robot.get("name", "?")),
        str(robot.get("state", "?")),
        _control(robot),
        _stopped(robot.get("stopped")),
        _names(_people(robot)),
        link.rtt,
        _span(each.get("robot_rtt_ms") for each in _dicts(robot.get("clients"))),
        link.quality,
        _number(robot.get("drops")),
        _percent(robot.get("battery")),
    )


def _person(person: dict[str, Any], now: float) -> tuple[str, ...]:
    since, link = person.get("since"), _Link.of(person)
    return (
        str(person.get("user", "?")),
        str(person.get("address", "?")),
        duration(max(0.0, now - since)) if isinstance(since, int | float) else _NONE,
        str(person.get("camera") or _NONE),
        link.rtt,
        _span([person.get("robot_rtt_ms")]),
        link.quality,
        _number(person.get("drops")),
    )


class _Link(NamedTuple):
    """How good a link is, in words."""

    rtt: str
    quality: str

    @classmethod
    def of(cls, end: dict[str, Any]) -> _Link:
        link = end.get("link")
        told = link if isinstance(link, dict) else {}
        rtt = told.get("rtt_ms", end.get("rtt_ms"))
        lost = told.get("lost")
        losses = f", {lost} lost" if isinstance(lost, int) and lost else ""
        return cls(_span([rtt]), f"{told.get('quality') or _NONE}{losses}")


def _span(round_trips: Iterable[Any]) -> str:
    """Round trips in milliseconds, from the shortest to the longest of those that are known."""
    known = [each for each in round_trips if isinstance(each, int | float)]
    if not known:
        return _NONE
    shortest, longest = f"{min(known):.1f}", f"{max(known):.1f}"
    return f"{shortest} ms" if shortest == longest else f"{shortest}–{longest} ms"


def _people(robot: dict[str, Any]) -> list[dict[str, Any]]:
    return [*_dicts(robot.get("clients")), *_dicts(robot.get("onlookers"))]


def _names(people: Iterable[dict[str, Any]]) -> str:
    """Who, each user once, with how often."""
    times: dict[str, int] = {}
    for each in people:
        name = str(each.get("user", "?"))
        times[name] = times.get(name, 0) + 1
    return ", ".join(name if count == 1 else f"{name} ({count})" for name, count in times.items()) or _NONE


def _control(robot: dict[str, Any]) -> str:
    """Who has it, and who has a hand on topics all the same."""
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
    """By whom; of a robot that has not confirmed it, that it is only being stopped."""
    by = _named(value, "by")
    if not isinstance(value, dict):
        return by
    again = f", again by {_named(value['again'], 'by')}" if value.get("again") else ""
    return (by if value.get("told", True) else f"being stopped by {by}") + again


def _number(value: Any) -> str:
    return str(value) if isinstance(value, int) else _NONE


def _percent(value: Any) -> str:
    return f"{value:.0%}" if isinstance(value, int | float) else _NONE


def _dicts(value: Any) -> Sequence[dict[str, Any]]:
    return [each for each in value if isinstance(each, dict)] if isinstance(value, list) else []
