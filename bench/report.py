"""What a measurement hands back, and how it is shown and kept."""

from __future__ import annotations

import functools
import json
import math
import os
import platform
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import psutil
from rich.console import Console
from rich.table import Table

from bench.machine import rest_costs


class Unavailable(Exception):
    """Something this machine lacks; the rows that need it are left out and named."""


@dataclass(frozen=True)
class Options:
    """How much is done.

    :param quick: tiny counts, to see that everything works; the figures say nothing
    :param seconds: length of the long measurements, where one was asked for
    :param runs: how often the same is done over, where that was asked for
    """

    quick: bool = False
    seconds: float | None = None
    runs: int | None = None

    def pick(self, quick: float, full: float) -> float:
        """One of two amounts."""
        return quick if self.quick else full


@dataclass(frozen=True)
class Row:
    """One line of the table.

    :param ours: the figure, in ``unit``
    :param other: the same of the alternative, ``None`` where there is none
    :param against: the alternative, in words
    :param ratio_bar: the most that ``ours / other`` may be
    :param bar: the most that ``ours`` may be
    :param note: what should be known beside
    """

    measurement: str
    what: str
    unit: str
    ours: float
    other: float | None = None
    against: str = ""
    ratio_bar: float | None = None
    bar: float | None = None
    note: str = ""

    def check(self, measurement: str) -> None:
        """Raise ValueError unless this is a row of the measurement, with finite figures."""
        if self.measurement != measurement:
            raise ValueError(f"the row '{self.what}' is of {self.measurement}, not of {measurement}")
        if not all(math.isfinite(figure) for figure in (self.ours, self.other or 0.0)):
            raise ValueError(f"the row '{self.what}' has a figure that is not finite")

    @property
    def ratio(self) -> float | None:
        """Ours in parts of the alternative's."""
        return self.ours / self.other if self.other else None

    @property
    def met(self) -> bool | None:
        """Whether it is as good as it has to be; ``None`` where nothing is asked."""
        if self.ratio_bar is not None:
            return self.ratio is not None and self.ratio <= self.ratio_bar
        return None if self.bar is None else self.ours <= self.bar

    @property
    def bar_text(self) -> str:
        """What is asked, in words."""
        if self.ratio_bar is not None:
            return f"≤ {ratio_text(self.ratio_bar)}"
        return "" if self.bar is None else f"≤ {figure(self.bar)} {self.unit}"


def ratio_text(ratio: float | None) -> str:
    """``1/7.2`` or ``1.4×``."""
    if ratio is None:
        return ""
    return f"1/{figure(1 / ratio)}" if 0 < ratio < 0.8 else f"{figure(ratio)}×"


def figure(value: float) -> str:
    """Three digits, no more."""
    if value == int(value) and abs(value) < 1e6:
        return str(int(value))
    if abs(value) >= 100:
        return f"{value:.0f}"
    return f"{value:.3g}"


def show(rows: list[Row], missing: dict[str, str]) -> None:
    """The table for people."""
    table = Table("what", "bar", "ours", "alternative", "ratio", "met?", title="make bench", show_lines=False)
    last = ""
    for row in rows:
        if last and row.measurement != last:
            table.add_section()
        last = row.measurement
        other = "" if row.other is None else f"{figure(row.other)} {row.unit}, {row.against}"
        table.add_row(
            row.what,
            row.bar_text,
            f"{figure(row.ours)} {row.unit}",
            other,
            ratio_text(row.ratio),
            {True: "yes", False: "[bold red]NO[/]", None: ""}[row.met],
        )
    console = Console(width=None if os.isatty(1) else 180)
    console.print(table)
    for note in dict.fromkeys(f"{row.measurement}: {row.note}" for row in rows if row.note):
        console.print(note, style="dim", highlight=False, markup=False)
    for name, reason in missing.items():
        console.print(f"not measured: {name}: {reason}", markup=False)


def machine() -> dict[str, Any]:
    """What should be known of the machine: nothing that names it."""
    model = ""
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        model = lines[0].partition(":")[2].strip() if lines else ""
    return {
        "cores": os.cpu_count(),
        "processor": model,
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
        "kernel": platform.release().partition("-")[0],
        "python": platform.python_version(),
        "rest_costs": _rest_costs(),
    }


@functools.cache
def _rest_costs() -> float:
    return round(rest_costs(), 1)


def load() -> float:
    """Processes that want a processor, mean of the last minute."""
    return os.getloadavg()[0]


def save(path: Path, name: str, rows: list[Row], missing: str, before: float, commit: str) -> None:
    """Keep the figures of one measurement as JSON; those of others stay as they were.

    :param missing: why there are none; empty when there are
    :param before: the machine's load before it
    """
    content: dict[str, Any] = {"measurements": {}}
    if path.exists():
        content = json.loads(path.read_text())
    content["machine"] = machine()
    content["measurements"][name] = {
        "when": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "commit": commit,
        "load_before": before,
        "missing": missing,
        "rows": [{**asdict(row), "ratio": row.ratio, "met": row.met} for row in rows],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n")
