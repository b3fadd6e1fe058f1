"""Figures of two commits are put side by side; the measuring itself is shown by ``make bench BASE=…``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from bench import base
from bench.__main__ import _without_base


def content(**rows: float) -> dict[str, Any]:
    """A file of figures."""
    return {
        "measurements": {
            "hop": {"rows": [{"what": what, "unit": "µs", "ours": ours} for what, ours in rows.items()]}
        }
    }


def test_figures_are_medians_by_row_and_ratios_are_of_this_tree(capsys: pytest.CaptureFixture[str]) -> None:
    """A row that only one of them has is shown without a ratio."""
    before = [base._figures(content(up=2.0, gone=1.0)), base._figures(content(up=4.0, gone=1.0))]
    after = [base._figures(content(up=1.0, added=5.0)), base._figures(content(up=2.0, added=5.0)), {}]
    base._show({"c6e24f2": base._medians(before), "this tree": base._medians(after)})
    lines = [line for line in capsys.readouterr().out.splitlines() if "hop:" in line]
    cells = [[cell.strip() for cell in line.strip("│").split("│")] for line in lines]
    assert cells == [
        ["hop: up", "3 µs", "1.5 µs", "0.50×"],
        ["hop: gone", "1 µs", "", ""],
        ["hop: added", "", "5 µs", ""],
    ]


def test_several_commits_have_a_column_each(capsys: pytest.CaptureFixture[str]) -> None:
    """The ratio is that of this tree to the last of them."""
    base._show({"a": {"hop: up": ("µs", 4.0)}, "b": {"hop: up": ("µs", 2.0)}, "c": {"hop: up": ("µs", 3.0)}})
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "hop:" in line]
    assert [cell.strip() for cell in line.strip("│").split("│")] == [
        "hop: up",
        "4 µs",
        "2 µs",
        "3 µs",
        "1.50×",
    ]


def test_an_unknown_commit_is_an_error_in_words() -> None:
    with pytest.raises(
        SystemExit, match="there is no commit nothing-like-this; give one that 'git log' shows"
    ):
        base.compare(["nothing-like-this"], ["hop"])


@pytest.mark.parametrize(
    "given", [["--base", "c6e24f2"], ["--base=c6e24f2"], ["--base", "c6e24f2", "--base", "b5a52b7"]]
)
def test_both_commits_get_the_other_options(given: list[str]) -> None:
    assert _without_base(["hop", *given, "--quick"]) == ["hop", "--quick"]


def test_the_other_commit_is_measured_where_it_is_ignored() -> None:
    """Its tree is below ``build``, which is not committed."""
    assert "/build/" in Path(".gitignore").read_text().splitlines()
    assert base.BUILD.relative_to(base.ROOT).parts[0] == "build"
