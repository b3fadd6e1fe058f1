"""``switchboard module`` and ``switchboard top``: supervised processes of a robot, and all its processes."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, get_args

import click
import msgspec

from relay_protocol.errors import Invalid, SwitchboardError, Unavailable
from relay_protocol.limits import LOG_LINES
from relay_protocol.link import LogLevel
from relay_protocol.realms import full_name
from relay_server.cli.admin_socket_client import send_order
from relay_server.cli.app import App, examples, json_option, one_realm_option, os_user, pass_app
from relay_server.cli.fleet import ROBOT_SECONDS, run_order
from relay_server.cli.output import (
    Printable,
    columns_that_fit,
    console,
    format_duration,
    format_size,
    print_json,
    print_line,
    print_result,
    print_table,
    watch_live,
)
from relay_server.modules.cpu_shares import CpuShares
from relay_server.modules.schemas import FASTEST_SECONDS, SLOWEST_SECONDS, ProcessList, ProcessStatus

FOLLOW_WAIT_SECONDS = 10.0
"""A followed log is asked for its next line again after so long. With the time for the robot's answer it is less than
the relay's process has to answer."""

_MODULE_COLUMNS = ("module", "state", "for", "PID", "restarts", "why", "last exit", "pending order")
_PROCESS_COLUMNS = (
    "PID", "part", "name", "state", "CPU %", "CPU", "nice", "threads", "voluntary", "involuntary", "memory", "started",
)  # fmt: skip
_DISPENSABLE_COLUMNS = ("nice", "CPU", "started", "involuntary", "voluntary", "threads", "state", "memory")
"""Left out in a narrow terminal, the first one first."""
_LARGEST_FIRST = ("cpu", "memory", "threads", "voluntary", "involuntary", "started")
_SORT_KEYS = ("part", "name", "state", "pid", "cpu-number", "nice", *_LARGEST_FIRST)
_LONGEST_NAME = 24
"""Characters of a program's name in the table; ``--json`` has all."""
_NONE = "–"


@click.group(
    epilog=examples(
        "switchboard module list rover",
        "switchboard module restart rover base",
        "switchboard module log rover base -f",
    )
)
def module() -> None:
    """List, start, stop and restart modules of a robot, and read their logs.

    Modules are processes that the robot's daemon supervises; its settings say which there are.
    """


@module.command(
    "list", epilog=examples("switchboard module list rover", "switchboard module list rover --json")
)
@click.argument("robot")
@json_option
@pass_app
def list_modules(app: App, robot: str, as_json: bool) -> None:
    """List the modules of ROBOT."""
    answer = _ask(app, robot, "list")
    if as_json:
        print_json(answer)
        return
    now = time.time()
    modules, current = answer["modules"], answer["current"]
    if not current:
        print_line(_last_report(answer, now))
    if modules:
        print_table(_MODULE_COLUMNS, [_module_row(each, current, now) for each in modules])
    elif answer["reported_at"] is not None:
        had = "has" if current else "had"
        print_line(f"Robot {robot} {had} no modules; they are listed in its settings as [[module]].")
    for each in modules:
        if each["refused"]:
            order = f"{each['refused']['action']} {each['name']}, by {each['refused']['by']}"
            print_line(f"A pending order was refused: {order}: {each['refused']['why']}")


def _last_report(answer: dict[str, Any], now: float) -> str:
    """Of when the states are, if they are not those of now."""
    robot = f"Robot {answer['robot']} is {'online' if answer['online'] else 'offline'}"
    if answer["reported_at"] is None:
        return f"{robot}, and has never reported its modules: it is not known which it has."
    last = f"last reported {format_duration(max(0.0, now - answer['reported_at']))} ago:"
    return (
        f"{robot}, and has not reported its modules yet; {last}" if answer["online"] else f"{robot}; {last}"
    )


def _add_order(action: str, sentence: str) -> None:
    @module.command(
        action,
        help=f"{sentence}\n\nROBOT is a name, or a pattern ('cleaner-*') or group (group:NAME) for many robots.",
        epilog=examples(
            f"switchboard module {action} rover base", f"switchboard module {action} 'cleaner-*' cleaning"
        ),
    )
    @click.argument("robot")
    @click.argument("module_name", metavar="MODULE")
    @one_realm_option
    @json_option
    @pass_app
    def order(app: App, robot: str, module_name: str, realm: str | None, as_json: bool) -> None:
        if robot.startswith("group:") or any(each in robot for each in "*?[,"):
            many = {"do": "module", "module": module_name, "action": action}
            run_order(app, robot, many, ROBOT_SECONDS, realm, as_json)
            return
        if realm is not None:
            robot = full_name(robot, realm)
        done = _ask(app, robot, action, module=module_name)
        text = f"Robot {robot} has accepted: {action} {module_name}."
        if done["pending"]:
            why = done["why"][:1].upper() + done["why"][1:]
            text = f"{why}. The order is pending until it answers or is back: {action} {module_name}."
        print_result(as_json, done, text)


_add_order("start", "Start MODULE of ROBOT. A robot that is offline gets the order when it is back.")
_add_order("stop", "Stop MODULE of ROBOT. A robot that is offline gets the order when it is back.")
_add_order("restart", "Stop MODULE of ROBOT, and start it again.")


@module.command(
    "log",
    epilog=examples(
        "switchboard module log rover base",
        "switchboard module log rover base --lines 300 -f",
        "switchboard module log rover base --level error",
    ),
)
@click.argument("robot")
@click.argument("module_name", metavar="MODULE")
@click.option(
    "--lines", type=click.IntRange(1, LOG_LINES), default=50, show_default=True, help="Newest lines to show."
)
@click.option(
    "--level",
    type=click.Choice(get_args(LogLevel)),
    default="debug",
    help="Only lines of this level, or a more severe one.",
)
@click.option(
    "--before", type=click.IntRange(0), metavar="OFFSET", help="Lines in front of those shown before."
)
@click.option("-f", "--follow", is_flag=True, help="Go on as lines are written, until Ctrl-C.")
@json_option
@pass_app
def show_log(
    app: App,
    robot: str,
    module_name: str,
    lines: int,
    level: LogLevel,
    before: int | None,
    follow: bool,
    as_json: bool,
) -> None:
    """Show the log of MODULE of ROBOT. Where there are earlier lines, a line on stderr says how to see them."""
    if follow and before is not None:
        raise Invalid("--before does not go with --follow")

    def read(**query: Any) -> dict[str, Any]:
        return _ask(app, robot, "log", module=module_name, query={"level": level, "limit": lines, **query})

    page = read(before=before)
    while not page["lines"] and page["previous"]:
        page = read(before=page["previous"])
    _print_lines(page, as_json)
    if not follow and page["previous"]:
        click.echo(f"earlier lines: --before {page['previous']}", err=True)
    if follow:
        with contextlib.suppress(KeyboardInterrupt):
            _follow_log(read, page["next"], as_json)


def _follow_log(read: Callable[..., dict[str, Any]], after: int, as_json: bool) -> None:
    while True:
        try:
            page = read(after=after, limit=LOG_LINES, wait=FOLLOW_WAIT_SECONDS)
        except Unavailable as error:
            click.echo(f"{error}; trying again", err=True)
            time.sleep(1)
            continue
        if page["missed"]:
            click.echo("some lines are no longer on the robot", err=True)
        _print_lines(page, as_json)
        after = page["next"]


@click.command(
    epilog=examples(
        "switchboard top rover", "switchboard top rover --every 0.2", "switchboard top rover --json"
    )
)
@click.argument("robot")
@click.option(
    "--every",
    type=click.FloatRange(FASTEST_SECONDS, SLOWEST_SECONDS),
    default=1.0,
    show_default=True,
    help="Seconds between two measurements.",
)
@click.option(
    "--sort",
    type=click.Choice(sorted(_SORT_KEYS)),
    default="cpu",
    show_default=True,
    help="Order of rows.",
)
@json_option
@pass_app
def top(app: App, robot: str, every: float, sort: str, as_json: bool) -> None:
    """Watch the processes of ROBOT's daemon and modules, until q or Ctrl-C in a terminal; else show them once."""
    if sys.stdout.isatty() and not as_json:
        watch_live(_turns(app, robot, sort), every)
        return
    measured = _Measurements(app, robot)
    # The share of a CPU is known from the second measurement on.
    measured.next()
    time.sleep(every)
    found = measured.next()
    if as_json:
        print_json(msgspec.to_builtins(found))
    else:
        print_table(_PROCESS_COLUMNS, _process_rows(found, sort))


class _Measurements:
    def __init__(self, app: App, robot: str) -> None:
        self._app = app
        self._robot = robot
        self._shares = CpuShares()

    def next(self) -> ProcessList:
        """Measure now.

        :raises SwitchboardError: no relay runs here, or it can't ask the robot
        """
        found = msgspec.convert(_ask(self._app, self._robot, "processes"), ProcessList)
        return self._shares.measured(found)


def _turns(app: App, robot: str, sort: str) -> Iterator[list[Printable]]:
    """Tables to draw, turn by turn. While the robot is offline its last processes are shown, with age and reason."""
    last: list[Printable] = []
    last_at = 0.0
    measured = _Measurements(app, robot)
    while True:
        try:
            found = measured.next()
        except SwitchboardError as error:
            if not last and not isinstance(error, Unavailable):
                raise
            age = f"STALE, {format_duration(time.monotonic() - last_at)} old: " if last else ""
            yield [Printable(f"{age}{error}"), *last]
            continue
        last_at = time.monotonic()
        busy = sum(each.cpu or 0 for each in found.processes)
        memory = sum(each.memory for each in found.processes)
        title = f"{robot}: {len(found.processes)} processes, {busy:.1f} % of a CPU, {format_size(memory)}"
        last = [Printable(title), *_fitting_table(_process_rows(found, sort))]
        yield last


def _fitting_table(rows: list[tuple[str, ...]]) -> list[Printable]:
    """The table, with a line that names the columns for which the terminal is too narrow."""
    staying, left_out = columns_that_fit(_PROCESS_COLUMNS, rows, _DISPENSABLE_COLUMNS, console().width)
    columns = [_PROCESS_COLUMNS[number] for number in staying]
    table = Printable("", columns, [[row[number] for number in staying] for row in rows])
    note = f"The terminal is too narrow for: {', '.join(left_out)}."
    return [Printable(note), table] if left_out else [table]


def _ask(app: App, robot: str, do: str, **more: Any) -> dict[str, Any]:
    """:raises SwitchboardError: no relay runs here, or it refuses"""
    return send_order(app.data, "modules", {"robot": robot, "by": os_user(), "do": do, **more})


def _module_row(module: dict[str, Any], current: bool, now: float) -> tuple[str, ...]:
    lasts = current and module["since"]
    return (
        module["name"],
        module["state"],
        format_duration(max(0.0, now - module["since"])) if lasts else _NONE,
        str((current and module["pid"]) or _NONE),
        str(module["restarts"]),
        module["why"] or _NONE,
        module["last_exit"] or _NONE,
        _order_text(module),
    )


def _order_text(module: dict[str, Any]) -> str:
    pending, refused = module["pending"], module["refused"]
    if pending:
        return f"{pending['action']}, by {pending['by']}"
    if refused:
        return f"{refused['action']}: refused"
    return _NONE


def _process_rows(found: ProcessList, sort: str) -> list[tuple[str, ...]]:
    field = {"started": "created"}.get(sort, sort.replace("-", "_"))

    def key(process: ProcessStatus) -> Any:
        # A value that is not known counts as 0.
        value = getattr(process, field)
        return 0 if value is None else value

    rows = sorted(found.processes, key=lambda each: each.pid)
    rows.sort(key=key, reverse=sort in _LARGEST_FIRST)
    return [_process_row(each) for each in rows]


def _process_row(process: ProcessStatus) -> tuple[str, ...]:
    return (
        str(process.pid),
        process.part,
        _cut(process.name),
        process.state,
        _NONE if process.cpu is None else f"{process.cpu:.1f}",
        _NONE if process.cpu_number is None else str(process.cpu_number),
        str(process.nice),
        str(process.threads),
        str(process.voluntary),
        str(process.involuntary),
        format_size(process.memory),
        time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(process.created)) + "Z",
    )


def _cut(name: str) -> str:
    return name if len(name) <= _LONGEST_NAME else f"{name[: _LONGEST_NAME - 1]}…"


def _print_lines(page: dict[str, Any], as_json: bool) -> None:
    for line in page["lines"]:
        if as_json:
            print_json(line)
        else:
            at = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(line["at"]))
            print_line(f"{at} {line['stream']:<3} {line['level']:<5} {line['text']}")
