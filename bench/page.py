"""``python -m bench.page``: the figures of ``bench/results/latest.json`` go into ``docs/performance.md``."""

from __future__ import annotations

import dataclasses
import json
import sys
from typing import Any

from bench import RESULTS, ROOT
from bench.__main__ import MEASUREMENTS
from bench.plot import plot
from bench.report import Row, figure, ratio_text

PAGE = ROOT / "docs" / "performance.md"
PICTURE = ROOT / "docs" / "images" / "performance.svg"
BEGIN, END = "<!-- figures: python -m bench.page -->", "<!-- end of figures -->"
_MET = {True: "yes", False: "**no**", None: ""}

WHY = {
    (
        "hop",
        "client → JSON robot, 200 B",
    ): "websockify unmasks a message and writes it on unread. The relay reads "
    "each one and judges it by right and by age before it hands it on. About ten Python calls and a pass of "
    "msgspec are left of that.",
    (
        "hop",
        "CDR robot → client, 64 KiB",
    ): "the text is framed and copied once more than by websockify, which passes bytes on unread.",
    (
        "endtoend",
        "LaserScan 40 Hz to 10 viewers",
    ): "at this rate everything sleeps between two samples, and each "
    "sample wakes three threads one by one. Most of the time of the daemon's main thread is Python that runs cold "
    "after a sleep. Fast DDS's own share comes on top. Where work after a rest costs little more than in a loop this "
    "was 1/8.8.",
    (
        "hop",
        "CDR robot → client, 200 B, one at a time",
    ): "one message at a time is mostly waking up, and the relay wakes a larger program than websockify.",
    (
        "latency",
        "one way",
    ): "500 messages a second leave 2 ms of rest before each, and HAProxy is a small program in C. Where work after "
    "a rest costs little more than in a loop this was 2.0×.",
    (
        "fanout",
        "fan-out",
    ): "100 samples a second, each after a rest, are framed once and then written to 500 sockets in a loop of Python; "
    "a loop in C stays in the cache. Where work after a rest costs little more than in a loop this was 1.8 to 2.0×.",
}
"""Reasons, by measurement and the beginning of what a row is called."""


def rows_of(kept: dict[str, Any]) -> list[Row]:
    """The rows as they were measured, in the order of the measurements."""
    names = {field.name for field in dataclasses.fields(Row)}
    order = [kept["measurements"][name] for name in MEASUREMENTS if name in kept["measurements"]]
    rows = [row for measurement in order for row in measurement["rows"]]
    return [Row(**{name: value for name, value in row.items() if name in names}) for row in rows]


def table(rows: list[Row]) -> str:
    """Markdown."""
    lines = ["| | What | Bar | Ours | Alternative | Ratio | Met |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        other = "" if row.other is None else f"{figure(row.other)} {row.unit}, {row.against}"
        cells = (
            f"`{row.measurement}`",
            row.what,
            row.bar_text,
            f"{figure(row.ours)} {row.unit}",
            other,
            ratio_text(row.ratio),
            _MET[row.met],
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def reasons(rows: list[Row]) -> str:
    """Why bars are missed, and why ours costs more where there is no bar: of the rows of which that is true."""
    lines = dict.fromkeys(
        f"- {measurement}, {what}: {why}\n"
        for (measurement, what), why in WHY.items()
        for row in rows
        if row.measurement == measurement and row.what.startswith(what) and _costs_more(row)
    )
    return f"\nWhy bars are missed, or ours costs more:\n\n{''.join(lines)}" if lines else ""


def _costs_more(row: Row) -> bool:
    return row.met is False or (row.met is None and row.ratio is not None and row.ratio > 1)


def figures(kept: dict[str, Any]) -> str:
    """The part of the page that is written by a run."""
    machine, measured, rows = kept["machine"], kept["measurements"], rows_of(kept)
    loads = [each["load_before"] for each in measured.values()]
    commits = ", ".join(dict.fromkeys(f"`{each['commit']}`" for each in measured.values()))
    missed = sum(row.met is False for row in rows)
    asked = sum(row.met is not None for row in rows)
    notes = dict.fromkeys(f"- {row.measurement}: {row.note}" for row in rows if row.note)
    left_out = "".join(
        f"\nNot measured: {name} ({each['missing']}).\n" for name, each in measured.items() if each["missing"]
    )
    return (
        f"Measured {max(each['when'] for each in measured.values())[:10]} at {commits}, {machine['cores']} cores "
        f"({machine['processor']}), Linux {machine['kernel']}, Python {machine['python']}, loopback. The "
        f"machine's load before the measurements was {min(loads):.1f} to {max(loads):.1f}; work after a rest of 50 ms "
        f"cost {machine['rest_costs']:g} times as much there as in a loop. "
        f"{asked - missed} of {asked} bars are met.\n\n"
        f"{table(rows)}\n{left_out}{reasons(rows)}\nBeside the figures:\n\n" + "\n".join(notes)
    )


def main() -> int:
    """Write both; the page must have its marks."""
    kept = json.loads((RESULTS / "latest.json").read_text())
    text = PAGE.read_text()
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        print(f"{PAGE} has no '{BEGIN}' followed by '{END}'", file=sys.stderr)
        return 1
    PAGE.write_text(f"{before}{BEGIN}\n{figures(kept)}\n{END}{after}")
    plot(rows_of(kept), PICTURE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
