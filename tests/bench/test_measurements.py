"""Every measurement runs, with tiny counts, and yields figures. What the figures are is not asked here."""

from __future__ import annotations

import importlib
import json
import math
from pathlib import Path

import pytest

from bench.__main__ import MEASUREMENTS
from bench.report import Options, Row, Unavailable, ratio_text, save

LEAST_ROWS = {
    "hop": 9,
    "latency": 2,
    "fanout": 1,
    "codec": 15,
    "viewers": 2,
    "idle": 1,
    "endtoend": 1,
    "crowd": 10,
    "soak": 7,
    "video": 16,
    "browser": 6,
    "thin": 8,
    "standstill": 3,
    "control": 6,
    "stopping": 4,
    "alerts": 5,
    "apps": 15,
    "memory": 10,
    "hostile": 3,
    "unproven": 7,
}


@pytest.mark.parametrize("name", MEASUREMENTS)
def test_a_measurement_yields_its_rows(name: str) -> None:
    """Each row has a finite figure and a name of its own; without what only ``make bench`` installs it says so."""
    try:
        rows = importlib.import_module(f"bench.{name}").run(Options(quick=True))
    except Unavailable as reason:
        # The extra 'bench' and HAProxy are no part of what tests install; the reason must be words.
        assert str(reason)
        return
    assert len(rows) >= LEAST_ROWS[name]
    assert len({row.what for row in rows}) == len(rows)
    for row in rows:
        assert math.isfinite(row.ours)
        assert row.other is None or math.isfinite(row.other)
        assert row.measurement == name


def test_a_bar_for_the_ratio_is_met_or_missed() -> None:
    """Ours over the alternative's is compared with the bar, and without an alternative nothing is met."""
    assert Row("x", "x", "µs", 1.0, 4.0, "y", ratio_bar=0.25).met is True
    assert Row("x", "x", "µs", 1.1, 4.0, "y", ratio_bar=0.25).met is False
    assert Row("x", "x", "µs", 1.0, None, ratio_bar=0.25).met is False
    assert Row("x", "x", "µs", 1.0, 4.0).met is None


def test_a_bar_for_the_figure_is_met_or_missed() -> None:
    """The figure itself is compared with its bar; 0 of 0 is met."""
    assert Row("x", "x", "messages", 0, bar=0).met is True
    assert Row("x", "x", "messages", 1, bar=0).met is False


def test_ratios_read_as_people_say_them() -> None:
    """Parts below one, times above."""
    assert ratio_text(0.25) == "1/4"
    assert ratio_text(2.5) == "2.5×"
    assert ratio_text(None) == ""


def test_what_is_kept_names_no_machine(tmp_path: Path) -> None:
    """Figures, bars and facts of the machine are kept; its name, users and paths are not."""
    path = tmp_path / "figures.json"
    save(path, "hop", [Row("hop", "x", "µs", 1.0, 4.0, "y", 0.25)], "", 0.5, "abc")
    save(path, "latency", [], "no HAProxy", 0.5, "abc")
    content = json.loads(path.read_text())
    assert set(content["machine"]) == {"cores", "processor", "memory_gib", "kernel", "python", "rest_costs"}
    assert content["measurements"]["hop"]["rows"][0]["met"] is True
    assert content["measurements"]["latency"]["missing"] == "no HAProxy"
    assert str(Path.home()) not in path.read_text()
