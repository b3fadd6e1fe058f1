"""One topic, 1 KB at 100 Hz, to 500 clients: processor time per delivery, against the least a loop in C needs.

The receivers (``native/receivers.c``) are the same on both sides, and look for what has come every millisecond. If
each message woke them, that would be work of the sender's processor, here a third of a delivery, and not the same for
both: a sender that is quicker than they are finds them awake. Clients are somewhere else, and nobody here wakes them.
The relay's figure holds all that goes with 500 clients: reading, judging and converting the sample, and their pings.
"""

from __future__ import annotations

import contextlib
import socket
import statistics
import struct
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from bench.cpu import measured
from bench.messages import STRING, text_of
from bench.native import Native, Receivers
from bench.relay import Relay
from bench.report import Options, Row
from bench.wire import Loop, PlainRobot, handshake, text_frame
from relay_protocol import jsontext
from relay_protocol.ros_types import TypeRegistry
from tests.worlds.processes import running

RATE = 100.0
SIZE = 1000
TOPIC = "/told"
EVERY_MS = 1
"""How often receivers look."""


class Side:
    """One of the two: a process, its source, its receivers."""

    def __init__(self, pid: int, receivers: Receivers, send: Callable[[], None]) -> None:
        self.pid = pid
        self.receivers = receivers
        self.send = send

    def run(self, loop: Loop, seconds: float, clients: int) -> float:
        """Microseconds of processor time per delivery."""
        self.receivers.report()
        messages = int(seconds * RATE)
        begun = time.monotonic()
        with measured(self.pid) as watch:
            for number in range(messages):
                self.send()
                while (wait := begun + (number + 1) / RATE - time.monotonic()) > 0:
                    loop.turn(wait)
            came, end = 0, time.monotonic() + 10
            while came < messages * clients and time.monotonic() < end:
                loop.turn(0.1)
                came += self.receivers.report()["messages"]
        assert came == messages * clients, f"{came} deliveries of {messages * clients}"
        return watch.seconds * 1e6 / came


def relay_side(loop: Loop, relay: Relay, folder: Path, clients: int) -> Side:
    """The relay, a robot that speaks CDR, clients with tokens of one viewer."""
    texts = text_of(STRING)
    robot = PlainRobot(loop, relay, "plain", "cdr", texts)
    token = relay.user("watcher")
    relay.cli("right", "grant", "watcher", "plain", "viewer")
    ask = text_frame(jsontext.encode({"op": "subscribe", "topic": TOPIC, "type": STRING}))
    receivers = Receivers(
        folder, relay.http_port, clients, handshake("/robots/plain", token), ask, every_ms=EVERY_MS
    )
    types = TypeRegistry()
    types.add(STRING, texts[STRING])
    loop.until("the relay has subscribed", lambda: TOPIC in robot.subscriptions)
    body = types.from_json(STRING, {"data": "x" * (SIZE - len(_empty()))}, 0)
    frame = robot.sample(TOPIC, body)
    channel = robot.channel
    assert channel is not None
    channel.send(frame)
    loop.until("everybody has the first", lambda: receivers.report()["messages"], 10)
    return Side(relay.pid, receivers, lambda: channel.send(frame))


def _empty() -> bytes:
    return jsontext.encode({"op": "publish", "topic": TOPIC, "msg": {"data": ""}})


def loop_side(folder: Path, clients: int, stack: contextlib.ExitStack) -> Side:
    """The loop in C."""
    spreader = Native("fanout")
    stack.callback(spreader.stop)
    source_port, receiver_port = (int(each) for each in spreader.words[1:])
    source = stack.enter_context(socket.create_connection(("127.0.0.1", source_port)))
    source.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    receivers = Receivers(folder, receiver_port, clients, handshake("/"), every_ms=EVERY_MS)
    stack.callback(receivers.stop)
    message = struct.pack("!I", SIZE) + b"x" * SIZE
    return Side(spreader.pid, receivers, lambda: source.sendall(message))


def run(options: Options) -> list[Row]:
    """Both in turn; medians."""
    clients = int(options.pick(5, 500))
    seconds = options.pick(0.3, 6)
    loop = Loop()
    with tempfile.TemporaryDirectory(prefix="bench-") as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        relay = Relay(folder, "--heartbeat", "60")
        stack.enter_context(running(relay))
        stack.callback(loop.close)
        ours = relay_side(loop, relay, folder, clients)
        stack.callback(ours.receivers.stop)
        theirs = loop_side(folder, clients, stack)
        ours.run(loop, seconds / 4, clients)
        both = [
            (ours.run(loop, seconds, clients), theirs.run(loop, seconds, clients))
            for _ in range(int(options.pick(1, 3)))
        ]
    row = Row(
        "fanout",
        f"fan-out, 1 KB at 100 Hz to {clients} clients",
        "µs/delivery",
        statistics.median(each[0] for each in both),
        statistics.median(each[1] for each in both),
        "a loop in C",
        2.0,
    )
    print(f"    {row.ours:.2f} µs, in C {row.other:.2f} µs", flush=True)
    return [row]
