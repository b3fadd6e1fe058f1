"""What commands print: tables and sentences for people, or JSON for programs."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from typing import Any

import click

from relay_protocol.text import inert

_PIPE_WIDTH = 4096
"""Columns of a table that goes into a pipe: nothing is cut or wrapped there."""


def say(sentence: str) -> None:
    """Print a line for people."""
    click.echo(inert(sentence))


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
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    drawn = Table(*columns, box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False)
    for row in cells:
        drawn.add_row(*(Text(inert(cell)) for cell in row))
    Console(
        file=sys.stdout,
        width=None if sys.stdout.isatty() else _PIPE_WIDTH,
        highlight=False,
        markup=False,
        emoji=False,
    ).print(drawn)
