"""The page of figures is written from what was kept, and nothing else."""

from __future__ import annotations

import json
from pathlib import Path

from bench.page import BEGIN, END, PAGE, figures, rows_of
from bench.report import Row, save

ROWS = [
    Row("hop", "one hop", "µs", 1.0, 4.0, "a proxy", 0.25, note="a remark"),
    Row("fanout", "fan-out", "µs", 9.0, 4.0, "a loop", 2.0),
    Row("idle", "memory", "KiB", 7.0, bar=12.0),
]


def kept(tmp_path: Path) -> dict[str, object]:
    """What a run with these rows leaves."""
    path = tmp_path / "figures.json"
    for row in ROWS:
        save(path, row.measurement, [row], "", 0.5, "abc")
    save(path, "latency", [], "no HAProxy", 2.0, "abc")
    return dict(json.loads(path.read_text()))


def test_figures_survive_being_kept(tmp_path: Path) -> None:
    """Rows read back are the rows that were measured."""
    assert rows_of(kept(tmp_path)) == ROWS


def test_missed_bars_and_missing_measurements_are_told(tmp_path: Path) -> None:
    """A missed bar is a plain no, the sum is stated, and what was not measured is named with its reason."""
    text = figures(kept(tmp_path))
    assert "| `fanout` | fan-out | ≤ 2× | 9 µs | 4 µs, a loop | 2.25× | **no** |" in text
    assert "2 of 3 bars are met" in text
    assert "Not measured: latency (no HAProxy)." in text
    assert "- hop: a remark" in text


def test_the_page_has_its_place_for_figures() -> None:
    """The marks are there, in order."""
    text = PAGE.read_text()
    assert 0 < text.index(BEGIN) < text.index(END)
