"""What commands print: tables and sentences for people, or JSON for programs."""

from __future__ import annotations

import contextlib
import json
import math
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from relay_protocol.errors import Invalid
from relay_protocol.text import inert

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

_DURATION = re.compile(r"([0-9]{1,9})([smhdw])\Z")
_UNITS = {"s": 1, "m": 60, "h": 3600, "d": 86400, "w": 7 * 86400}
_LONGEST = 10 * 365 * 86400


def moment(at: float | None) -> str:
    """Unix seconds as UTC, to the second; a dash for none."""
    if at is None:
        return "–"
    return datetime.fromtimestamp(at, timezone.utc).strftime("%Y-%m-%d %H:%M:%SZ")


def duration(seconds: float) -> str:
    """A span of time, in its two largest units."""
    left, parts = int(seconds), []
    for unit in reversed(_UNITS):
        count, left = divmod(left, _UNITS[unit])
        if count:
            parts.append(f"{count} {unit}")
    return " ".join(parts[:2]) or "0 s"


def file_size(size: int) -> str:
    """Bytes in the units disks are sold in, never less than there are."""
    for unit, name in ((10**9, "GB"), (10**6, "MB")):
        if size >= unit:
            return f"{math.ceil(size * 10 / unit) / 10:g} {name}"
    return f"{math.ceil(size / 1000)} kB"


def parse_duration(text: str) -> int:
    """Seconds of ``90s``, ``15m``, ``1h``, ``7d`` or ``2w``.

    :raises Invalid: anything else, nothing at all, or over ten years
    """
    found = _DURATION.match(text)
    seconds = int(found[1]) * _UNITS[found[2]] if found else 0
    if not 0 < seconds <= _LONGEST:
        raise Invalid(f"'{text}' is no time span; write 90s, 15m, 1h, 7d or 2w (at most ten years)")
    return seconds


_PIPE_WIDTH = 4096
"""Columns of a table that goes into a pipe: nothing is cut or wrapped there."""

_WATCH_SECONDS = 1.0


def say(sentence: str) -> None:
    """Print a line for people."""
    click.echo(inert(sentence))


def say_aside(sentence: str) -> None:
    """Print a line for people that is no outcome, to stderr."""
    click.echo(inert(sentence), err=True)


def tell(as_json: bool, value: object, *sentences: str) -> None:
    """Print the outcome of a command: JSON, or sentences."""
    if as_json:
        show_json(value)
        return
    for sentence in sentences:
        say(sentence)


def show_json(value: object) -> None:
    """Print one line of JSON; ASCII, so nothing in it moves a cursor."""
    click.echo(json.dumps(value))


def show(
    as_json: bool, rows: Iterable[dict[str, Any]], columns: Sequence[str], cells: Iterable[Sequence[str]]
) -> None:
    """Print a list.

    :param rows: what it is for programs
    :param cells: what it is for people, a row for a row
    """
    if as_json:
        show_json(list(rows))
        return
    table(columns, cells)


def table(columns: Sequence[str], cells: Iterable[Sequence[str]]) -> None:
    """Print a table for people."""
    console().print(_drawn(columns, cells))


class Printable(NamedTuple):
    """Something to draw: a line, a table, or both."""

    title: str
    columns: Sequence[str] = ()
    cells: Sequence[Sequence[str]] = ()


def watch_sheets(turns: Iterator[list[Printable]]) -> None:
    """Draw sheets, and every second those of the next turn in their place, until Ctrl-C."""
    from rich.console import Group
    from rich.live import Live
    from rich.text import Text

    def drawn() -> Group:
        parts: list[Table | Text] = []
        for each in next(turns):
            parts += [Text(inert(each.title))] if each.title else []
            parts += [_drawn(each.columns, each.cells)] if each.columns else []
        return Group(*parts)

    with (
        contextlib.suppress(KeyboardInterrupt),
        Live(drawn(), console=console(), auto_refresh=False, screen=True) as live,
    ):
        while True:
            time.sleep(_WATCH_SECONDS)
            live.update(drawn(), refresh=True)


@contextlib.contextmanager
def progress(total: int, *, shown: bool) -> Iterator[Callable[[], None]]:
    """A bar on stderr; what comes is to be called at each step.

    :param shown: false: no bar
    """
    if not shown:
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn

    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=total)
        yield lambda: bar.advance(task)


def console() -> Console:
    """Where tables go: as wide as the terminal; nothing in a text is markup."""
    from rich.console import Console

    return Console(
        file=sys.stdout,
        width=None if sys.stdout.isatty() else _PIPE_WIDTH,
        highlight=False,
        markup=False,
        emoji=False,
    )


def _drawn(columns: Sequence[str], cells: Iterable[Sequence[str]]) -> Table:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    drawn = Table(*columns, box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for row in cells:
        drawn.add_row(*(Text(inert(cell)) for cell in row))
    return drawn
