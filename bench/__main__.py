"""``python -m bench [measurement …]``: measure, print one table, keep the figures."""

from __future__ import annotations

import argparse
import importlib
import subprocess
import sys
import time
import traceback
from pathlib import Path

from bench import RESULTS, ROOT
from bench.base import compare
from bench.report import Options, Row, Unavailable, load, machine, save, show

MEASUREMENTS = {
    "hop": "relay, one hop, against websockify",
    "latency": "one-way time against HAProxy",
    "fanout": "one topic to 500 clients against a loop in C",
    "codec": "CDR to JSON and back against rosbridge's way",
    "viewers": "what one viewer and fifty cost the robot",
    "idle": "memory of an idle client",
    "endtoend": "LaserScan to ten viewers against rosbridge's way",
    "foxglove": "scan, image and cloud to ten Foxglove clients against foxglove-sdk's server",
    "reconnects": "a hundred Foxglove connections by one URL, 3 s apart",
    "crowd": "fifty clients of mixed speed, and one that breaks every rule",
    "soak": "a minute of load: nothing is lost",
    "video": "cameras: what viewers cost, how old a picture is, slow beside fast",
    "browser": "cameras in a browser: how old the picture on the page is",
    "thin": "small topics beside heavy ones over thin links; pictures over an uplink that becomes thin",
    "standstill": "from a fault to standstill",
    "control": "twenty clients race for control; how long it takes to hand over",
    "stopping": "from anybody's stop to standstill, under full load",
    "alerts": "from a robot's unplugging to the webhook",
    "apps": "from a word, a stick, a tilt and a scan to what the robot does",
    "unproven": "memory of a connection nobody has proved",
    "hostile": "what strangers' inputs make others wait",
    "memory": "a million events: asked, written by the thousand, killed",
    "pipes": "pipes between robots: whole messages, a field, a scan, five hundred at once",
    "modules": "supervised processes: idle, watched ten times a second, killed",
    "offload": "functions on workers: the robot's processor, times over thin uplinks, what a call adds",
    "cluster": "three relays: one hop more, viewers at all of them, the death of one with 2,000 robots",
    "roles": "10,000 Roles: memory, elements to their Roles, queries",
    "navigation": "goals around a table, with depth and without; stops in the middle of them",
}


def commit() -> str:
    """What was measured; ``-dirty`` where more is changed than the figures of measurements before."""
    changed = _git("status", "--porcelain", "--", ".", f":!{RESULTS.relative_to(ROOT)}")
    return _git("describe", "--always") + ("-dirty" if changed else "")


def _git(*words: str) -> str:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False)
    return done.stdout.strip()


def arguments() -> argparse.Namespace:
    """The command line."""
    names = "\n".join(f"  {name:<11} {what}" for name, what in MEASUREMENTS.items())
    parser = argparse.ArgumentParser(
        prog="python -m bench",
        description="Measure Switchboard beside its alternatives.",
        epilog=f"measurements (all, if none is named):\n{names}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="*", metavar="measurement", choices=[*MEASUREMENTS, []])
    parser.add_argument("--quick", action="store_true", help="tiny counts: does it run? figures say nothing")
    parser.add_argument("--seconds", type=float, help="length of 'crowd', 'soak' and 'memory'")
    parser.add_argument(
        "--runs",
        type=int,
        help="of each fault, of the race, of stops, of connections (50, 20 of 'alerts', 1000, 200, 100)",
    )
    parser.add_argument(
        "--json",
        type=Path,
        help="where figures go, beside those of other measurements (bench/results/latest.json)",
    )
    parser.add_argument(
        "--strict",
        action="store_true",
        help="exit with 1 also if a bar is missed or a measurement is left out",
    )
    parser.add_argument(
        "--base",
        metavar="COMMIT",
        action="append",
        help="measure this commit too, in turns, and print both and their ratios (again: further commits)",
    )
    parser.add_argument("--plot", type=Path, help="where a picture of the ratios goes (SVG)")
    return parser.parse_args()


def measure(name: str, options: Options) -> tuple[list[Row], str]:
    """Run one measurement; its rows, or why there are none."""
    began = time.monotonic()
    rows: list[Row] = []
    missing = ""
    try:
        rows = _measured(name, options)
    except Unavailable as error:
        missing = str(error)
    except Exception as error:
        traceback.print_exc()
        missing = f"failed: {error!r}"
    print(f"    {name} took {time.monotonic() - began:.0f} s", flush=True)
    return rows, missing


def _measured(name: str, options: Options) -> list[Row]:
    """The rows of one measurement, checked."""
    rows: list[Row] = importlib.import_module(f"bench.{name}").run(options)
    for row in rows:
        row.check(name)
    names = [row.what for row in rows]
    twice = {what for what in names if names.count(what) > 1}
    if twice:
        raise ValueError(f"rows of {name} have the same name: {', '.join(sorted(twice))}")
    return rows


def exit_code(rows: list[Row], missing: dict[str, str], *, strict: bool) -> int:
    """1 if a measurement failed, else 0.

    :param missing: why measurements have no rows, by their names
    :param strict: 1 also if a row misses its bar, or a measurement was left out; both are printed
    """
    if not strict:
        return int(any(reason.startswith("failed") for reason in missing.values()))
    missed = [f"{row.measurement}: {row.what}" for row in rows if row.met is False]
    for each in [*missed, *missing]:
        print(f"--strict: {each} {'missed its bar' if each in missed else 'was not measured'}")
    return int(bool(missed or missing))


def _without_base(options: list[str]) -> list[str]:
    kept = [each for each in options if not each.startswith("--base=")]
    while "--base" in kept:
        at = kept.index("--base")
        del kept[at : at + 2]
    return kept


def main() -> int:
    """Measure and print; returns the exit code, see :func:`exit_code`."""
    asked = arguments()
    if asked.base:
        return compare(asked.base, _without_base(sys.argv[1:]))
    target = asked.json or (None if asked.quick else RESULTS / "latest.json")
    options, measured = Options(asked.quick, asked.seconds, asked.runs), commit()
    rows: list[Row] = []
    missing: dict[str, str] = {}
    print(
        f"on this machine work after a rest of 50 ms costs {machine()['rest_costs']:g} times as much as in a loop"
    )
    for name in asked.names or MEASUREMENTS:
        before = round(load(), 1)
        print(f"--- {name}: {MEASUREMENTS[name]} (load {before})", flush=True)
        found, why = measure(name, options)
        rows += found
        if why:
            missing[name] = why
        if target is not None:
            save(target, name, found, why, before, measured)
    show(rows, missing)
    if target is not None:
        print(f"figures: {target}")
    if asked.plot is not None:
        from bench.plot import plot

        plot(rows, asked.plot)
        print(f"picture: {asked.plot}")
    return exit_code(rows, missing, strict=asked.strict)


if __name__ == "__main__":
    sys.exit(main())
