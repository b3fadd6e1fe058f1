"""What inputs that parsers are slow on cost those who do nothing wrong: a fixed list, all of it before login.

Each input comes alone, on a connection of its own. A bystander in a process of its own asks for a small answer again
and again; how long it waits at most while an input is served counts. Of several tries the one with the shortest wait
counts, since the machine, too, makes people wait.
"""

from __future__ import annotations

import contextlib
import json
import select
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from bench.child import Child
from bench.relay import Relay
from bench.report import Options, Row
from tests.worlds.hostile_inputs import Attack, Reactor, exchange, request, send, unproved
from tests.worlds.processes import running

TRIES = 3
BAR_MS = 50.0
LOOK = 0.005
"""Processor seconds of the reactor from which on an input is tried by all tries; others can't make anybody wait."""


def run(options: Options) -> list[Row]:
    """All inputs, or with ``--quick`` one in a hundred."""
    attacks = unproved()[:: 100 if options.quick else 1]
    with (
        tempfile.TemporaryDirectory() as folder,
        _relay(Path(folder)) as relay,
        _bystander(relay) as bystander,
    ):
        reactor = Reactor(relay.pid)
        idle = bystander.worst_of(lambda: time.sleep(0.2))  # what it waits when nothing else is asked
        costs, waits = {}, {}
        for attack in attacks:
            costs[attack.name], waits[attack.name] = _measured(attack, relay, reactor, bystander)
    slowest, dearest = max(waits, key=lambda name: waits[name]), max(costs, key=lambda name: costs[name])
    return [
        Row(
            "hostile",
            f"longest wait of a bystander over {len(attacks)} inputs",
            "ms",
            waits[slowest] * 1000,
            bar=BAR_MS,
            note=f"the longest wait is beside '{slowest}'; with nothing else to do it is {idle * 1000:.1f} ms",
        ),
        Row(
            "hostile",
            "processor time of the dearest input",
            "ms",
            costs[dearest] * 1000,
            note=f"that is '{dearest}'; 64 KiB at most, in slices between which others are served",
        ),
        Row("hostile", "processor time of an input, median", "ms", statistics.median(costs.values()) * 1000),
    ]


def _measured(attack: Attack, relay: Relay, reactor: Reactor, bystander: Bystander) -> tuple[float, float]:
    """Processor seconds of the reactor, and seconds that the bystander waited at most; the least of some tries."""
    costs, waits = [], []

    def attacked() -> None:
        costs.append(reactor.cost(lambda: send(relay.http_port, relay.robots_port, attack)))

    while len(costs) < TRIES and (not costs or costs[-1] > LOOK or waits[-1] > BAR_MS / 5000):
        waits.append(bystander.worst_of(attacked))
    return min(costs), min(waits)


@contextlib.contextmanager
def _relay(folder: Path) -> Iterator[Relay]:
    relay = Relay(folder, "--requests-per-second", "0")
    try:
        yield relay
    finally:
        relay.stop()


class Bystander:
    """Asks again and again from another process, and tells what it waited for at most.

    :param child: that process
    """

    def __init__(self, child: Child) -> None:
        self._child = child

    def worst_of(self, work: Callable[[], object]) -> float:
        """Seconds it waited at most for one answer while some work was done."""
        self._child.ask()
        work()
        return float(self._child.ask()["worst"])


@contextlib.contextmanager
def _bystander(relay: Relay) -> Iterator[Bystander]:
    command = [sys.executable, "-m", "bench.hostile", str(relay.http_port)]
    child = Child(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    child.ready(AssertionError("the bystander does not start; see above"))
    with running(child):
        yield Bystander(child)


def _stand_by(port: int) -> None:
    """Ask until the standard input ends; for each line of it say what was waited for at most since the last."""
    asked = request("GET", b"/robots/nobody", {"Connection": b"keep-alive"})
    worst = 0.0
    connection = socket.create_connection(("127.0.0.1", port))
    print("READY", flush=True)
    while True:
        began = time.perf_counter()
        exchange(connection, asked)
        worst = max(worst, time.perf_counter() - began)
        if select.select([sys.stdin], [], [], 0.001)[0]:
            if not sys.stdin.readline():
                return
            print(json.dumps({"worst": worst}), flush=True)
            worst = 0.0


if __name__ == "__main__":
    _stand_by(int(sys.argv[1]))
