"""Memory of an idle client: how much the relay grows by 1000 logged-in clients of a robot who do nothing."""

from __future__ import annotations

import contextlib
import tempfile
import time
from pathlib import Path

from bench.cpu import resident
from bench.native import Receivers
from bench.relay import Relay
from bench.report import Options, Row
from bench.wire import Loop, PlainRobot, handshake
from tests.worlds.processes import running

FIRST = 100
"""Clients that come before, so that what the relay takes once is not counted."""

SETTLE_SECONDS = 5.0
"""Each has been pinged twice by then."""


def settled(loop: Loop, pid: int, seconds: float) -> int:
    """The relay's memory after a while."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        loop.turn(0.1)
    return resident(pid)


def run(options: Options) -> list[Row]:
    """Once; memory does not jitter as times do."""
    clients = int(options.pick(10, 1000))
    seconds = options.pick(0.5, SETTLE_SECONDS)
    with tempfile.TemporaryDirectory(prefix="bench-") as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        relay = Relay(folder, "--heartbeat", "60")
        stack.enter_context(running(relay))
        pid = relay.pid
        loop = Loop()
        stack.callback(loop.close)
        PlainRobot(loop, relay, "plain", "cdr", {})
        token = relay.user("watcher")
        relay.cli("right", "grant", "watcher", "plain", "viewer")
        request = handshake("/robots/plain", token)
        sizes = []
        for count in (FIRST, clients):
            receivers = Receivers(folder, relay.http_port, count, request)
            stack.callback(receivers.stop)
            sizes.append(settled(loop, pid, seconds))
            assert receivers.report()["open"] == count
    row = Row(
        "idle",
        f"an idle websocket client, of {clients}",
        "KiB",
        (sizes[1] - sizes[0]) / clients / 1024,
        bar=12.0,
        note=f"the relay held {sizes[0] / 2**20:.1f} MiB with {FIRST} clients, {sizes[1] / 2**20:.1f} MiB with "
        f"{FIRST + clients}",
    )
    print(f"    {row.ours:.1f} KiB", flush=True)
    return [row]
