"""The page of figures is written from stored figures only."""

from __future__ import annotations

import json
from pathlib import Path

from bench import RESULTS
from bench.page import BEGIN, END, PAGE, WHY, figures, reasons, rows_of
from bench.report import Row, save

ROWS = [
    Row("hop", "one hop", "µs", 1.0, 4.0, "a proxy", 0.25, note="a remark"),
    Row("fanout", "fan-out", "µs", 9.0, 4.0, "a loop", 2.0),
    Row("idle", "memory", "KiB", 7.0, bar=12.0),
]


def kept(tmp_path: Path) -> dict[str, object]:
    """The file of a run with these rows."""
    path = tmp_path / "figures.json"
    for row in ROWS:
        save(path, row.measurement, [row], "", 0.5, "abc")
    save(path, "latency", [], "no HAProxy", 2.0, "abc")
    return dict(json.loads(path.read_text()))


def test_figures_survive_storage(tmp_path: Path) -> None:
    """Rows read back equal the measured ones."""
    assert rows_of(kept(tmp_path)) == ROWS


def test_missed_targets_and_missing_measurements_are_reported(tmp_path: Path) -> None:
    """A missed bar is marked "no", the sum is stated, and missing measurements have a reason."""
    text = figures(kept(tmp_path))
    assert "| `fanout` | fan-out | ≤ 2× | 9 µs | 4 µs, a loop | 2.25× | **no** |" in text
    assert "2 of 3 bars are met" in text
    assert "Not measured: latency (no HAProxy)." in text
    assert "- hop: a remark" in text


def test_missed_bars_are_explained_and_met_ones_are_not() -> None:
    """A reason is shown as long as its row is missed; rows without a bar are explained while they cost more."""
    for (measurement, what), why in WHY.items():
        missed = Row(measurement, what, "µs", 3.0, 2.0, "a proxy", 1.0)
        assert (
            reasons([missed, missed])
            == f"\nWhy bars are missed, or ours costs more:\n\n- {measurement}, {what}: {why}\n"
        )
        assert reasons([Row(measurement, what, "µs", 3.0, 2.0, "a proxy")])
        assert reasons([Row(measurement, what, "µs", 3.0, 2.0, "a proxy", 2.0)]) == ""
        assert reasons([Row(measurement, what, "µs", 1.0, 2.0, "a proxy")]) == ""


def test_reasons_are_of_rows_that_are_measured() -> None:
    """Reasons of renamed rows are found."""
    rows = rows_of(json.loads((RESULTS / "latest.json").read_text()))
    for measurement, what in WHY:
        assert any(row.measurement == measurement and row.what.startswith(what) for row in rows)


def test_the_page_has_its_place_for_figures() -> None:
    """The marks exist, in order."""
    text = PAGE.read_text()
    assert 0 < text.index(BEGIN) < text.index(END)
