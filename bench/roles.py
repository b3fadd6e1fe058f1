"""10,000 Roles of 50 statements: seconds to fill the graph, memory, and time to resolve an element and to query."""

from __future__ import annotations

import json
import random
import subprocess
import sys
import time
from typing import Any

import psutil
from twisted.internet import reactor
from twisted.internet.defer import Deferred
from twisted.python.failure import Failure

from bench.cpu import resident
from bench.report import Options, Row
from relay_server.roles.process import RoleProcess
from relay_server.roles.sparql import RESULTS_CSV, TURTLE

TYPE = "<http://www.w3.org/1999/02/22-rdf-syntax-ns#type>"
ELEMENTS = 11
TURNS = 500
QUERIES = 30
FEW = 100
"""Roles that a user sees who is no administrator."""

MIB = 1024 * 1024


def document(number: int) -> str:
    """A Role in N-Triples: 6 statements of its own and 4 of each of 11 fields."""
    role, action = f"<fierro:R{number}>", f"<fierro:A{number}>"
    lines = [
        f"{role} {TYPE} <fierro:role>",
        f"{role} <fierro:subject> <fierro:S{number}>",
        f"{role} <fierro:action> {action}",
        f"{role} <fierro:directObject> <fierro:D{number}>",
        f"{action} {TYPE} <fierro:action>",
        f"<fierro:S{number}> {TYPE} <fierro:subject>",
    ]
    for each in range(ELEMENTS):
        field, port, process = (f"<fierro:{kind}{number}_{each}>" for kind in ("AXIS_", "Port_", "Process_"))
        lines += [
            f"{action} <fierro:process> {process}",
            f"{process} <fierro:port> {port}",
            f"{field} <fierro:mapping> {port}",
            f"{field} {TYPE} <fierro:field>",
        ]
    return " .\n".join(lines) + " .\n"


def figures(seconds: list[float]) -> dict[str, float]:
    """Median and 99th percentile, milliseconds."""
    found = sorted(seconds)
    return {
        "p50": found[len(found) // 2] * 1e3,
        "p99": found[min(len(found) - 1, len(found) * 99 // 100)] * 1e3,
    }


class Measurement:
    """A process with the Roles of one realm."""

    def __init__(self, roles: int) -> None:
        self._roles = roles
        self._process = RoleProcess(reactor)
        self._draw = random.Random(1)

    async def run(self) -> dict[str, Any]:
        """All figures."""
        begun = time.perf_counter()
        for number in range(self._roles):
            await self._process.ask("put", realm="lab", name=f"R{number}", text=document(number))
        filled = time.perf_counter() - begun
        (worker,) = psutil.Process().children()
        found = {
            "filled": filled,
            "memory": resident(worker.pid) / MIB,
            "all": figures([await self._resolve(self._roles, None) for _ in range(TURNS)]),
            "few": figures(
                [await self._resolve(FEW, [f"R{each}" for each in range(FEW)]) for _ in range(TURNS)]
            ),
            "query": figures([await self._query() for _ in range(QUERIES)]),
        }
        await self._process.close()
        return found

    async def _resolve(self, among: int, names: list[str] | None) -> float:
        number, field = self._draw.randrange(among), self._draw.randrange(ELEMENTS)
        begun = time.perf_counter()
        found = await self._process.ask(
            "roles_of", realm="lab", names=names, text=f"fierro:AXIS_{number}_{field}"
        )
        assert found == [f"R{number}"], found
        return time.perf_counter() - begun

    async def _query(self) -> float:
        text = f"SELECT ?port {{ <fierro:Process_{self._draw.randrange(self._roles)}_3> fierro:port ?port }}"
        begun = time.perf_counter()
        await self._process.ask(
            "query", realm="lab", names=None, text=text, media=RESULTS_CSV, graph_media=TURTLE
        )
        return time.perf_counter() - begun


def run(options: Options) -> list[Row]:
    """Measure in a process of its own, as it runs a reactor."""
    roles = int(options.pick(100, 10_000))
    done = subprocess.run(
        [sys.executable, "-m", "bench.roles", str(roles)], check=True, capture_output=True, text=True
    )
    found = json.loads(done.stdout)

    def row(what: str, unit: str, value: float, bar: float | None = None) -> Row:
        return Row("roles", f"{roles} Roles of 50 statements, {what}", unit, value, bar=bar)

    rows = [
        row("to fill the graph", "s", found["filled"]),
        row("memory of the process", "MiB", found["memory"]),
    ]
    for name, what in (("all", "element to its Role"), ("few", f"the same, {FEW} visible")):
        rows.append(row(f"{what}, p50", "ms", found[name]["p50"]))
        rows.append(row(f"{what}, p99", "ms", found[name]["p99"], 10))
    rows.append(row("query of a client, in a process of its own, p50", "ms", found["query"]["p50"]))
    return rows


def main() -> None:
    """Print the figures as JSON, for the number of Roles in the first argument."""
    results: list[Any] = []
    twisted: Any = reactor

    def end(result: Any) -> None:
        results.append(result)
        twisted.stop()

    def begin() -> None:
        Deferred.fromCoroutine(Measurement(int(sys.argv[1])).run()).addBoth(end)

    twisted.callWhenRunning(begin)
    twisted.run()
    if isinstance(results[0], Failure):
        sys.exit(results[0].getTraceback())
    print(json.dumps(results[0]))


if __name__ == "__main__":
    main()
