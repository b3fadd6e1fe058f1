"""Every measurement runs, with tiny counts, and yields figures, whose values are not checked here."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import pytest

from bench.__main__ import MEASUREMENTS, exit_code, measure
from bench.report import Options, Row, ratio_text, save

LEAST_ROWS = {"hop": 15, "codec": 15, "idle": 1}
"""Measurements that run here, to show that the others can; ``make bench BENCH=--quick`` runs all of them."""


@pytest.mark.parametrize("name", LEAST_ROWS)
def test_a_measurement_yields_its_rows(name: str) -> None:
    """Each row has a finite figure and a unique name; without packages that only ``make bench`` installs it
    reports so.
    """
    rows, missing = measure(name, Options(quick=True))
    if missing:
        # Tests install neither the extra 'bench' nor HAProxy; the reason must be given in words.
        assert not missing.startswith("failed"), missing
        return
    assert len(rows) >= LEAST_ROWS[name]


@pytest.mark.parametrize("name", MEASUREMENTS)
def test_a_measurement_can_be_imported(name: str) -> None:
    """Each has a function that takes the options."""
    assert callable(importlib.import_module(f"bench.{name}").run)


@pytest.mark.parametrize(
    "rows",
    [
        [Row("hop", "one", "µs", float("nan"))],
        [Row("hop", "one", "µs", 1.0, float("inf"), "another")],
        [Row("hop", "one", "µs", 1.0), Row("hop", "one", "µs", 2.0)],
        [Row("latency", "one", "µs", 1.0)],
    ],
)
def test_rows_that_say_nothing_are_a_failure(rows: list[Row], monkeypatch: pytest.MonkeyPatch) -> None:
    """A figure that is not finite, a name that comes twice, and another measurement's row."""
    monkeypatch.setattr("bench.hop.run", lambda options: rows)
    kept, missing = measure("hop", Options(quick=True))
    assert kept == []
    assert missing.startswith("failed: ValueError")
    assert "one" in missing


def test_without_foxglove_sdk_a_sentence_names_the_command_that_installs_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    rows, why = measure("foxglove", Options(quick=True))
    assert rows == []
    assert why.startswith("foxglove-sdk is not installed")
    assert "(scripts/setup.sh python)" in why


def test_a_bar_for_the_ratio_is_met_or_missed() -> None:
    """Ours over the alternative's is compared with the bar; without an alternative it counts as missed."""
    assert Row("x", "x", "µs", 1.0, 4.0, "y", ratio_bar=0.25).met is True
    assert Row("x", "x", "µs", 1.1, 4.0, "y", ratio_bar=0.25).met is False
    assert Row("x", "x", "µs", 1.0, None, ratio_bar=0.25).met is False
    assert Row("x", "x", "µs", 1.0, 4.0).met is None


def test_a_bar_for_the_figure_is_met_or_missed() -> None:
    """The figure itself is compared with its bar; 0 of 0 is met."""
    assert Row("x", "x", "messages", 0, bar=0).met is True
    assert Row("x", "x", "messages", 1, bar=0).met is False


def test_ratios_are_readable() -> None:
    """Parts below one, times above."""
    assert ratio_text(0.25) == "1/4"
    assert ratio_text(2.5) == "2.5×"
    assert ratio_text(None) == ""


def test_stored_file_names_no_machine(tmp_path: Path) -> None:
    """Figures, bars and facts of the machine are stored; its name, users and paths are not."""
    path = tmp_path / "figures.json"
    save(path, "hop", [Row("hop", "x", "µs", 1.0, 4.0, "y", 0.25)], "", 0.5, "abc")
    save(path, "latency", [], "no HAProxy", 0.5, "abc")
    content = json.loads(path.read_text())
    assert set(content["machine"]) == {"cores", "processor", "memory_gib", "kernel", "python", "rest_costs"}
    assert content["measurements"]["hop"]["rows"][0]["met"] is True
    assert content["measurements"]["latency"]["missing"] == "no HAProxy"
    assert str(Path.home()) not in path.read_text()


@pytest.mark.parametrize(
    ("ours", "missing", "code", "strict_code"),
    [
        (1.0, {}, 0, 0),
        (2.0, {}, 0, 1),
        (1.0, {"latency": "HAProxy is not installed"}, 0, 1),
        (1.0, {"latency": "failed: OSError()"}, 1, 1),
    ],
)
def test_a_missed_bar_is_in_the_exit_code_only_if_strict(
    ours: float, missing: dict[str, str], code: int, strict_code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [Row("hop", "cost", "µs", ours, bar=1.5), Row("hop", "without a bar", "µs", 9.0)]
    assert exit_code(rows, missing, strict=False) == code
    assert capsys.readouterr().out == ""
    assert exit_code(rows, missing, strict=True) == strict_code
    printed = capsys.readouterr().out
    assert ("hop: cost missed its bar" in printed) == (ours > 1.5)
    assert ("latency was not measured" in printed) == bool(missing)
    assert "without a bar" not in printed
