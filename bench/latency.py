"""One-way time of 200 bytes at 500 messages a second through the relay, against HAProxy in http mode.

The same client, server and clock on both sides, all in this process: from just before a message is sent until the read
that brought it has returned. HAProxy passes bytes on unread; the relay parses, judges and converts.
"""

from __future__ import annotations

import contextlib
import statistics
import tempfile
import time
from pathlib import Path

from websockets.frames import Frame, Opcode

from bench.haproxy import HAProxy, executable
from bench.hop import SMALL, Ground, Hop, text_message
from bench.relay import Relay
from bench.report import Options, Row
from bench.wire import Loop, text_frame
from tests.worlds.processes import running

RATE = 500.0


def delays(loop: Loop, hop: Hop, count: int) -> list[float]:
    """Seconds each of these messages took; one that did not come within 10 s fails the measurement."""
    taken = []
    begun = time.perf_counter()
    for number in range(count):
        while (wait := begun + number / RATE - time.perf_counter()) > 0:
            loop.turn(wait)
        before = hop.received()
        sent = time.perf_counter()
        hop.sender.send(hop.messages[0])
        while hop.received() == before:
            loop.turn(1.0)
            assert time.perf_counter() - sent < 10, "a message did not come"
        taken.append(hop.receiver.at - sent)
        if time.perf_counter() - begun > (number + 2) / RATE + 0.01:
            # Something held us up; don't hurry after it.
            begun = time.perf_counter() - (number + 1) / RATE
    return taken


def through_haproxy(proxy: HAProxy) -> dict[str, Hop]:
    """Both ways through HAProxy: websocket frames as a client and as a server send them."""
    payload = text_message("/chatter", SMALL)
    up, down = text_frame(payload), Frame(Opcode.TEXT, payload).serialize(mask=False)
    client, server = proxy.client, proxy.server
    return {
        "up": Hop(client, [up], lambda: server.messages, (proxy.pid,), 1, receiver=server),
        "down": Hop(server, [down], lambda: client.messages, (proxy.pid,), 1, receiver=client),
    }


def measure(loop: Loop, what: str, ours: Hop, theirs: Hop, options: Options) -> Row:
    """Ours and theirs in turn; the median of all."""
    count, rounds = int(options.pick(10, 1500)), int(options.pick(1, 3))
    mine: list[float] = []
    other: list[float] = []
    for _ in range(rounds):
        mine += delays(loop, ours, count)
        other += delays(loop, theirs, count)
    p99 = [sorted(each)[int(0.99 * len(each))] * 1e6 for each in (mine, other)]
    row = Row(
        "latency",
        f"one way, {what}, 200 B, 500/s, p50",
        "µs",
        statistics.median(mine) * 1e6,
        statistics.median(other) * 1e6,
        "HAProxy, http mode",
        2.5,
        note=f"{what}: p99 {p99[0]:.0f} µs, HAProxy {p99[1]:.0f} µs",
    )
    print(f"    {row.what}: {row.ours:.0f} µs, HAProxy {row.other:.0f} µs", flush=True)
    return row


def run(options: Options) -> list[Row]:
    """Both ways."""
    executable()
    loop = Loop()
    with tempfile.TemporaryDirectory(prefix="bench-") as name, contextlib.ExitStack() as stack:
        relay = Relay(Path(name), "--heartbeat", "60")
        stack.enter_context(running(relay))
        stack.callback(loop.close)
        ground = Ground(loop, relay)
        chatter, told = text_message("/chatter", SMALL), text_message("/told", SMALL)
        proxy = HAProxy(loop, Path(name), len(text_frame(chatter)))
        stack.callback(proxy.stop)
        theirs = through_haproxy(proxy)
        return [
            measure(
                loop, "client → JSON robot", ground.to_robot("json", [chatter], 1), theirs["up"], options
            ),
            measure(
                loop,
                "CDR robot → client",
                ground.to_client("cdr", [told], 1),
                theirs["down"],
                options,
            ),
        ]
