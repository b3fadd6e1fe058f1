"""What commands print: tables and sentences for people, or JSON for programs."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from relay_protocol.text import inert

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

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


class Sheet(NamedTuple):
    """Something to draw: a line, a table, or both."""

    title: str
    columns: Sequence[str] = ()
    cells: Sequence[Sequence[str]] = ()


def watch_sheets(turns: Iterator[list[Sheet]]) -> None:
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
