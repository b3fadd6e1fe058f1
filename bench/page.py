"""``python -m bench.page``: the figures of ``bench/results/latest.json`` go into ``docs/performance.md``."""

from __future__ import annotations

import dataclasses
import json
import sys
from typing import Any

from bench import RESULTS, ROOT
from bench.plot import plot
from bench.report import Row, figure, ratio_text

PAGE = ROOT / "docs" / "performance.md"
PICTURE = ROOT / "docs" / "performance.svg"
BEGIN, END = "<!-- figures: python -m bench.page -->", "<!-- end of figures -->"
_MET = {True: "yes", False: "**no**", None: ""}


def rows_of(kept: dict[str, Any]) -> list[Row]:
    """The rows as they were measured."""
    names = {field.name for field in dataclasses.fields(Row)}
    return [Row(**{name: value for name, value in row.items() if name in names}) for row in kept["rows"]]


def table(rows: list[Row]) -> str:
    """Markdown."""
    lines = ["| What | Bar | Ours | Alternative | Ratio | Met |", "|---|---|---|---|---|---|"]
    for row in rows:
        other = "" if row.other is None else f"{figure(row.other)} {row.unit}, {row.against}"
        cells = (
            row.what,
            row.bar_text,
            f"{figure(row.ours)} {row.unit}",
            other,
            ratio_text(row.ratio),
            _MET[row.met],
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def figures(kept: dict[str, Any]) -> str:
    """The part of the page that is written by a run."""
    machine, rows = kept["machine"], rows_of(kept)
    loads = kept["load_before"].values()
    missed = sum(row.met is False for row in rows)
    asked = sum(row.met is not None for row in rows)
    notes = dict.fromkeys(f"- {row.measurement}: {row.note}" for row in rows if row.note)
    left_out = "".join(f"\nNot measured: {name} ({why}).\n" for name, why in kept["missing"].items())
    return (
        f"Measured {kept['when'][:10]} at `{kept['commit']}`, {machine['cores']} cores ({machine['processor']}), Linux "
        f"{machine['kernel']}, Python {machine['python']}, loopback. Others worked on the machine too: its load was "
        f"{min(loads):.1f} to {max(loads):.1f} before the measurements. {asked - missed} of {asked} bars are met.\n\n"
        f"{table(rows)}\n{left_out}\nBeside the figures:\n\n" + "\n".join(notes)
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
