"""Output of commands: tables and sentences for people, JSON for programs.

How commands remove users, groups and robots.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import select
import signal
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import datetime, timezone
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import click
from sqlalchemy.orm import Session

from relay_db.names import full_name_of
from relay_db.queries import GroupRecord, RobotRecord, UserRecord
from relay_protocol.errors import Invalid, Unavailable
from relay_protocol.text import escape_unprintable
from relay_server.cli.app import App, confirm, get_group, get_robot, get_user

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table


_DURATION = re.compile(r"([0-9]{1,9})([smhdw])\Z")
_UNITS = {"s": 1, "m": 60, "h": 3600, "d": 86400, "w": 7 * 86400}
_LONGEST = 10 * 365 * 86400


def format_time(at: float | None) -> str:
    """Unix seconds as UTC, to the second; a dash for ``None``."""
    if at is None:
        return "–"
    return datetime.fromtimestamp(at, timezone.utc).strftime("%Y-%m-%d %H:%M:%SZ")


def format_duration(seconds: float) -> str:
    """A time span in its two largest units."""
    left, parts = int(seconds), []
    for unit, length in (("d", 86400), ("h", 3600), ("min", 60), ("s", 1)):
        count, left = divmod(left, length)
        if count:
            parts.append(f"{count} {unit}")
    return " ".join(parts[:2]) or "0 s"


def format_size(size: int) -> str:
    """Bytes in decimal units, rounded up."""
    for unit, name in ((10**9, "GB"), (10**6, "MB")):
        if size >= unit:
            return f"{math.ceil(size * 10 / unit) / 10:g} {name}"
    return f"{math.ceil(size / 1000)} kB"


def parse_duration(text: str) -> int:
    """Seconds of ``90s``, ``15m``, ``1h``, ``7d`` or ``2w``.

    :raises Invalid: any other text, 0, or more than ten years
    """
    found = _DURATION.match(text)
    seconds = int(found[1]) * _UNITS[found[2]] if found else 0
    if not 0 < seconds <= _LONGEST:
        raise Invalid(f"'{text}' is not a time span; write 90s, 15m, 1h, 7d or 2w (at most ten years)")
    return seconds


_PIPE_WIDTH = 4096
"""Columns of a table that goes into a pipe: nothing is cut or wrapped there."""

_WATCH_SECONDS = 1.0

_COLUMN_GAP = 3
"""Characters between two columns of a table."""


def print_line(sentence: str) -> None:
    """Print a line for people."""
    click.echo(escape_unprintable(sentence))


def print_note(sentence: str) -> None:
    """Print a line for people to stderr, because it is not the result."""
    click.echo(escape_unprintable(sentence), err=True)


def print_result(as_json: bool, value: object, *sentences: str) -> None:
    """Print the result of a command: JSON or sentences."""
    if as_json:
        print_json(value)
        return
    for sentence in sentences:
        print_line(sentence)


def print_json(value: object) -> None:
    """Print one line of JSON in ASCII, so that no text in it can move the cursor."""
    click.echo(json.dumps(value))


def print_list(
    as_json: bool, rows: Iterable[dict[str, Any]], columns: Sequence[str], cells: Iterable[Sequence[str]]
) -> None:
    """Print a list.

    :param rows: for programs
    :param cells: for people, one row for each of ``rows``
    """
    if as_json:
        print_json(list(rows))
        return
    print_table(columns, cells)


def print_table(columns: Sequence[str], cells: Iterable[Sequence[str]]) -> None:
    console().print(_rich_table(columns, cells))


class Printable(NamedTuple):
    """A line, a table, or both."""

    title: str
    columns: Sequence[str] = ()
    cells: Sequence[Sequence[str]] = ()


def columns_that_fit(
    columns: Sequence[str], cells: Sequence[Sequence[str]], dispensable: Sequence[str], width: int
) -> tuple[list[int], list[str]]:
    """Leave out columns of a table that is too wide.

    :param dispensable: columns that may be left out, the first one first
    :param width: characters of a line
    :returns: the numbers of the columns that stay; the names of those left out
    """
    widths = [max(len(name), *(len(row[number]) for row in cells), 0) for number, name in enumerate(columns)]
    staying, left_out = list(range(len(columns))), []
    for name in dispensable:
        if sum(widths[number] + _COLUMN_GAP for number in staying) - _COLUMN_GAP <= width:
            break
        staying.remove(columns.index(name))
        left_out.append(name)
    return staying, left_out


def watch_live(turns: Iterator[list[Printable]], seconds: float = _WATCH_SECONDS) -> None:
    """Draw items, and those of the next turn in their place, until q, Ctrl-C or SIGTERM; then restore the terminal.

    :param seconds: between two turns
    """
    from rich.console import group
    from rich.live import Live
    from rich.text import Text

    @group()
    def rendered() -> Iterator[Table | Text]:
        for each in next(turns):
            if each.title:
                yield Text(escape_unprintable(each.title))
            if each.columns:
                yield _rich_table(each.columns, each.cells)

    with (
        contextlib.suppress(KeyboardInterrupt),
        _keys_at_once() as quit_within,
        Live(rendered(), console=console(), auto_refresh=False, screen=True) as live,
    ):
        while not quit_within(seconds):
            live.update(rendered(), refresh=True)


@contextlib.contextmanager
def _keys_at_once() -> Iterator[Callable[[float], bool]]:
    """Have the terminal pass on each key at once and without echo.

    Yields a function that waits so many seconds, and returns at once with ``True`` if q is pressed.
    """
    if not sys.stdin.isatty():
        yield _no_key_within
        return
    descriptor = sys.stdin.fileno()
    settings = termios.tcgetattr(descriptor)
    former = signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        tty.setcbreak(descriptor)
        yield partial(_is_quit_within, descriptor)
    finally:
        termios.tcsetattr(descriptor, termios.TCSAFLUSH, settings)
        signal.signal(signal.SIGTERM, former)


def _no_key_within(seconds: float) -> bool:
    time.sleep(seconds)
    return False


def _is_quit_within(terminal: int, seconds: float) -> bool:
    until = time.monotonic() + seconds
    while select.select([terminal], [], [], max(0.0, until - time.monotonic()))[0]:
        keys = os.read(terminal, 64)
        if b"q" in keys or not keys:  # nothing comes from a terminal that was closed
            return True
    return False


@contextlib.contextmanager
def progress(total: int, *, shown: bool) -> Iterator[Callable[[], None]]:
    """A progress bar on stderr; call the function it yields at each step."""
    if not shown:
        yield lambda: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn

    bar = Progress(
        BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), console=Console(stderr=True), transient=True
    )
    with bar:
        task = bar.add_task("", total=total)
        yield lambda: bar.advance(task)


def console() -> Console:
    """A console as wide as the terminal, without markup."""
    from rich.console import Console

    return Console(
        file=sys.stdout,
        width=None if sys.stdout.isatty() else _PIPE_WIDTH,
        highlight=False,
        markup=False,
        emoji=False,
    )


def _rich_table(columns: Sequence[str], cells: Iterable[Sequence[str]]) -> Table:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    rendered = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for column in columns:
        rendered.add_column(column)
    for row in cells:
        rendered.add_row(*(Text(escape_unprintable(cell)) for cell in row))
    return rendered


class _Removable(NamedTuple):
    """:param along: parts that are removed too, for the question"""

    find: Callable[[Session, str], UserRecord | GroupRecord | RobotRecord]
    along: str


_REMOVABLE = {
    "user": _Removable(get_user, "all rights and tokens"),
    "group": _Removable(get_group, "its rights"),
    "robot": _Removable(get_robot, "its keys and all rights on it"),
}


def remove_named(app: App, what: str, name: str, yes: bool, as_json: bool) -> None:
    """Remove a user, a group or a robot, after a question.

    :param what: ``user``, ``group`` or ``robot``
    :param yes: do not ask
    :raises NotFound: there is none of this name
    :raises Unavailable: the recordings of a robot cannot be read
    """
    kind = _REMOVABLE[what]
    with app.reading() as session:
        found = kind.find(session, name)
    if isinstance(found, RobotRecord) and full_name_of(name) != found.full:
        raise Invalid(
            f"'{name}' is {found.full}, which is shared: 'switchboard robot unshare' takes it out of the realm, "
            f"'switchboard robot remove {found.full}' removes it"
        )
    recordings = _stored_recordings(app, found.id) if what == "robot" else None
    recordings_text = f", and {recordings.words}" if recordings else ""
    confirm(f"Remove {what} {found.full} with {kind.along}{recordings_text}?", yes)
    with app.change() as change:
        found = kind.find(change.session, name)
        if isinstance(found, UserRecord):
            change.remove_user(found)
        elif isinstance(found, GroupRecord):
            change.remove_group(found)
        else:
            change.remove_robot(found, recordings.number if recordings else 0)
    answer: dict[str, Any] = {what: found.full, "removed": True}
    sentences = [f"Removed {what} {found.full}."]
    if recordings:
        answer["recordings"] = recordings.number
        sentences.append(f"The relay deletes {recordings.words}: now if it runs, otherwise when it starts.")
    print_result(as_json, answer, *sentences)


class _StoredRecordings(NamedTuple):
    number: int
    words: str


def _stored_recordings(app: App, robot_id: int) -> _StoredRecordings | None:
    # Imported late: recordings need more packages than other commands.
    from relay_server.recordings.library import FOLDER, kept_of

    try:
        count, size = kept_of(app.data / FOLDER, robot_id)
    except OSError as error:
        raise Unavailable(f"the folder of recordings cannot be read: {error.strerror}") from None
    if not count:
        return None
    return _StoredRecordings(count, f"its {count} recording{'s' if count > 1 else ''} ({format_size(size)})")
