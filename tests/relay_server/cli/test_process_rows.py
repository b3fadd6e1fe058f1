"""Rows and columns of ``switchboard top``."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from relay_server.cli import modules, output
from relay_server.modules.schemas import ProcessList, ProcessStatus

ROWS = [
    ProcessStatus(
        pid=3, parent=1, name="b", part="arm", state="sleeping", cpu=None, cpu_number=None, created=5.0
    ),
    ProcessStatus(pid=1, parent=1, name="a", part="base", state="running", cpu=1.0, cpu_number=1, nice=5),
    ProcessStatus(pid=2, parent=1, name="c", part="base", state="sleeping", cpu=9.0, cpu_number=0, memory=10),
]
MEASURED = ProcessList(at=0.0, processes=ROWS, more=0)


@pytest.mark.parametrize(
    ("column", "pids"),
    [
        ("cpu", [2, 1, 3]),
        ("memory", [2, 1, 3]),
        ("started", [3, 1, 2]),
        ("part", [3, 1, 2]),
        ("name", [1, 3, 2]),
        ("state", [1, 2, 3]),
        ("pid", [1, 2, 3]),
        ("nice", [2, 3, 1]),
        ("cpu-number", [2, 3, 1]),
        ("threads", [1, 2, 3]),
        ("voluntary", [1, 2, 3]),
        ("involuntary", [1, 2, 3]),
    ],
)
def test_rows_are_sorted_by_any_column(column: str, pids: list[int]) -> None:
    assert [int(row[0]) for row in modules._process_rows(MEASURED, column)] == pids
    assert column in modules._SORT_KEYS


@pytest.mark.parametrize(
    ("width", "left_out"),
    [(200, []), (100, ["nice", "CPU", "started"]), (20, list(modules._DISPENSABLE_COLUMNS))],
)
def test_narrow_terminal_leaves_out_columns_and_names_them(
    monkeypatch: pytest.MonkeyPatch, width: int, left_out: list[str]
) -> None:
    monkeypatch.setattr(modules, "console", lambda: Console(width=width))
    rows = modules._process_rows(MEASURED, "pid")
    *notes, table = modules._fitting_table(rows)
    assert [each.title for each in notes] == (
        [f"The terminal is too narrow for: {', '.join(left_out)}."] if left_out else []
    )
    assert table.columns == [each for each in modules._PROCESS_COLUMNS if each not in left_out]
    drawn = io.StringIO()
    if left_out != list(modules._DISPENSABLE_COLUMNS):
        Console(width=width, file=drawn).print(output._rich_table(table.columns, table.cells))
        assert "…" not in drawn.getvalue()
