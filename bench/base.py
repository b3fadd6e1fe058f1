"""Measures other commits beside this tree: in turns, on one machine, each with its own measurements."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from bench import BUILD, ROOT
from bench.report import figure

TURNS = 2
"""Runs of each."""

PARTS = ("python", "web", "interfaces", "bench")
"""What ``scripts/setup.sh`` prepares for measurements."""

Figures = dict[str, tuple[str, float]]
"""Unit and figure by measurement and row."""


def compare(bases: list[str], options: list[str]) -> int:
    """Measure commits and this tree in turns, and print their figures, and the ratios of this tree to the last commit.

    :param bases: commits; each is checked out and prepared below ``build/bench``
    :param options: arguments of ``python -m bench``, the same for all
    :returns: the exit code: 1 if a measurement failed
    """
    names = {_prepared(base): base for base in bases} | {ROOT: "this tree"}
    figures: dict[Path, list[Figures]] = {tree: [] for tree in names}
    failed = 0
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        for turn in range(TURNS):
            for tree, found in figures.items():
                path = Path(folder) / f"{turn}.json"
                path.unlink(missing_ok=True)
                print(f"=== {names[tree]}, {turn + 1} of {TURNS}", flush=True)
                command = [str(tree / ".venv/bin/python"), "-m", "bench", *options, "--json", str(path)]
                failed |= subprocess.run(command, cwd=tree, check=False).returncode
                found.append(_figures(json.loads(path.read_text())) if path.exists() else {})
    _show({names[tree]: _medians(found) for tree, found in figures.items()})
    return int(bool(failed))


def _prepared(base: str) -> Path:
    """A work tree of the commit with an environment of its own, which stays for the next comparison."""
    found = subprocess.run(
        ["git", "rev-parse", "--verify", "--short=12", f"{base}^{{commit}}"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if found.returncode:
        sys.exit(f"there is no commit {base}; give one that 'git log' shows")
    tree = BUILD / "base" / found.stdout.strip()
    if not (tree / "setup.cfg").exists():
        tree.parent.mkdir(parents=True, exist_ok=True)
        subprocess.run(["git", "clone", "--quiet", "--no-checkout", str(ROOT), str(tree)], check=True)
        subprocess.run(["git", "checkout", "--quiet", "--detach", tree.name], cwd=tree, check=True)
    subprocess.run(["scripts/setup.sh", *PARTS], cwd=tree, check=True)
    return tree


def _figures(content: dict[str, Any]) -> Figures:
    return {
        f"{name}: {row['what']}": (row["unit"], row["ours"])
        for name, measurement in content["measurements"].items()
        for row in measurement["rows"]
    }


def _medians(turns: list[Figures]) -> Figures:
    names = dict.fromkeys(name for each in turns for name in each)
    found = {name: [each[name] for each in turns if name in each] for name in names}
    return {
        name: (values[0][0], statistics.median(value for _, value in values))
        for name, values in found.items()
    }


def _show(columns: dict[str, Figures]) -> None:
    """Print a table, with the ratio of the last column to the one before it."""
    table = Table("what", *columns, "ratio", title=f"medians of {TURNS} turns")
    for name in dict.fromkeys(name for each in columns.values() for name in each):
        cells = [each.get(name) for each in columns.values()]
        old, new = cells[-2:]
        ratio = new[1] / old[1] if old and new and old[1] else None
        texts = ["" if cell is None else f"{figure(cell[1])} {cell[0]}" for cell in cells]
        table.add_row(name, *texts, "" if ratio is None else f"{ratio:.2f}×")
    Console(width=None if sys.stdout.isatty() else 180).print(table)
