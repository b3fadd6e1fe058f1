"""Pipes between two plain robots: whole messages, one field, a shared scan, and five hundred pipes at once."""

from __future__ import annotations

import contextlib
import socket
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from bench.cpu import measured
from bench.messages import STRING, text_of
from bench.relay import Relay
from bench.report import Options, Row
from bench.wire import Loop, PlainRobot, TcpEnd, flood
from relay_protocol.ros_types import TypeRegistry
from tests.worlds.processes import running

NUMBER = "std_msgs/msg/Float64"
SCAN = "sensor_msgs/msg/LaserScan"
POINTS = 720
LARGE = 1 << 20
"""Bytes of a whole message, as of a point cloud."""

PIPES = 500
HERTZ = 10
WINDOW = 2
"""Whole messages under way: the newest one waits at most, so that none is dropped."""


class Ground:
    """A relay with two plain robots, and pipes of one user."""

    def __init__(self, loop: Loop, relay: Relay) -> None:
        self.loop = loop
        self.relay = relay
        texts = text_of(STRING, NUMBER, SCAN)
        self.types = TypeRegistry()
        for name, text in texts.items():
            self.types.add(name, text)
        relay.user("ann")
        self.robots = {name: PlainRobot(loop, relay, name, "cdr", texts) for name in ("one", "two")}
        for name in self.robots:
            relay.cli("right", "grant", "ann", name, "operator")

    def pipe(self, source: str, target: str, topic: str, type_name: str, *options: str) -> None:
        """Carry a topic under its own name, with ``/piped`` before it."""
        ends = f"{source}:{topic}", f"{target}:/piped{topic}"
        kinds = "--source-type", type_name, "--target-type", type_name
        name = f"{source}{topic.replace('/', '-')}"
        self.relay.cli("pipe", "add", name, *ends, "--owner", "ann", *kinds, *options)

    def ready(self, robot: str, *topics: str) -> None:
        """Wait until the relay has subscribed to all."""
        wanted = set(topics)
        self.loop.until("the pipes run", lambda: wanted <= self.robots[robot].subscriptions.keys(), 120)

    def runs(self, name: str) -> None:
        """Wait until a pipe runs."""
        while self.relay.cli("pipe", "show", name)["state"] != "running":
            self.loop.turn(0.05)

    def warm(self, frame: bytes, copies: int = 1) -> None:
        """Wait until a first message has come through.

        :param copies: that come of it
        """
        one, two = self.robots["one"], self.robots["two"]
        before = two.received
        assert one.channel is not None
        one.channel.send(frame)
        self.loop.until("the first message comes", lambda: two.received >= before + copies)


@contextlib.contextmanager
def ground() -> Iterator[Ground]:
    """All of it, in a folder that goes with it."""
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        relay, loop = Relay(Path(folder)), Loop()
        with running(relay):
            try:
                yield Ground(loop, relay)
            finally:
                loop.close()


def whole(here: Ground, options: Options) -> list[Row]:
    """Megabytes of whole messages in a second, and processor time of the relay for each."""
    here.pipe("one", "two", "/cloud", STRING)
    here.ready("one", "/cloud")
    one, two = here.robots["one"], here.robots["two"]
    body = here.types.from_json(STRING, {"data": "x" * LARGE}, 0)
    frame = one.sample("/cloud", body)
    here.warm(frame)
    total = int(options.pick(20, 2000))
    assert one.channel is not None
    began = time.perf_counter()
    with measured(here.relay.pid) as watch:
        flood(here.loop, one.channel, [frame], total, lambda: two.received, WINDOW)
    megabytes, seconds = total * len(body) / 1e6, time.perf_counter() - began
    found = here.relay.cli("pipe", "show", "one-cloud")
    note = f"{megabytes / seconds:.0f} MB/s; of {found['messages']} messages {found['messages'] - found['encoded']} "
    note += f"were decoded, {found['drops']} dropped"
    return [
        Row("pipes", "whole messages of 1 MiB", "ms per MB", seconds * 1000 / megabytes, bar=10.0, note=note),
        Row("pipes", "whole messages of 1 MiB, relay", "ms of CPU per MB", watch.seconds * 1000 / megabytes),
    ]


def latency(here: Ground, options: Options) -> list[Row]:
    """Time from field to field, against the same bytes over a connection of the robots' own."""
    here.pipe("one", "two", "/speed", NUMBER, "--field", "data=data*3.6")
    here.ready("one", "/speed")
    frame = here.robots["one"].sample("/speed", here.types.from_json(NUMBER, {"data": 0.25}, 0))
    piped, direct, note = _beside_direct(here, frame, options)
    return [
        Row("pipes", "field to field beyond a direct path, p50", "ms", piped - direct, bar=1.0, note=note)
    ]


def scan(here: Ground, options: Options) -> list[Row]:
    """Robot two uses the scan of robot one, by two pipes: time until it has it, and bytes of robot one."""
    here.pipe("one", "two", "/scan", SCAN)
    kinds = "--source-type", SCAN, "--target-type", SCAN
    here.relay.cli("pipe", "add", "again", "one:/scan", "two:/again", "--owner", "ann", *kinds)
    for name in ("one-scan", "again"):
        here.runs(name)
    here.ready("one", "/scan")
    body = here.types.from_json(SCAN, {"ranges": [1.5] * POINTS, "intensities": [0.0] * POINTS}, 0)
    frame = here.robots["one"].sample("/scan", body)
    before = here.robots["two"].received
    piped, direct, note = _beside_direct(here, frame, options, copies=2)
    sent = int(options.pick(20, 2000)) + 1
    came = here.robots["two"].received - before
    note += f"; {len(frame)} bytes sent once, {came / sent:g} copies came"
    return [
        Row(
            "pipes",
            f"scan of {POINTS} points by two pipes beyond a direct path, p50",
            "ms",
            piped - direct,
            note=note,
        )
    ]


def _beside_direct(here: Ground, frame: bytes, options: Options, copies: int = 1) -> tuple[float, float, str]:
    """Median milliseconds by a pipe, and by a connection of the robots' own; both in words.

    :param copies: that robot two gets of each frame
    """
    one, two = here.robots["one"], here.robots["two"]
    here.warm(frame, copies)
    assert one.channel is not None
    total = int(options.pick(20, 2000))
    piped = [_one(here.loop, one.channel.socket, frame, lambda: two.received, copies) for _ in range(total)]
    with contextlib.closing(socket.create_server(("127.0.0.1", 0))) as server:
        near = socket.create_connection(server.getsockname())
        near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        end = TcpEnd(here.loop, server.accept()[0], len(frame))
        direct = [_one(here.loop, near, frame, lambda: end.messages) for _ in range(total)]
        near.close()
        here.loop.drop(end)
    ours, other = statistics.median(piped) * 1000, statistics.median(direct) * 1000
    note = f"{ours:.3f} ms beside {other:.3f} ms; p99 {sorted(piped)[int(total * 0.99)] * 1000:.2f} ms"
    return ours, other, note


def _one(
    loop: Loop, sender: socket.socket, frame: bytes, received: Callable[[], int], copies: int = 1
) -> float:
    """Seconds until all copies of one message have come."""
    before, began = received(), time.perf_counter()
    sender.sendall(frame)
    while received() < before + copies:
        loop.turn(1.0)
    return time.perf_counter() - began


def many(here: Ground, options: Options) -> list[Row]:
    """Processor time of the relay with five hundred pipes, each ten times a second."""
    half = int(options.pick(5, PIPES // 2))
    seconds = options.pick(1, 20)
    topics = [f"/n{number}" for number in range(half)]
    body = here.types.from_json(NUMBER, {"data": 0.25}, 0)
    for source, target in (("one", "two"), ("two", "one")):
        for topic in topics:
            here.pipe(source, target, topic, NUMBER)
            here.loop.turn()
    for name in here.robots:
        here.ready(name, *topics)
    robots = list(here.robots.values())
    frames = [b"".join(robot.sample(topic, body) for topic in topics) for robot in robots]
    before, began = sum(each.received for each in robots), time.monotonic()
    turns = int(seconds * HERTZ)
    with measured(here.relay.pid) as watch:
        for turn in range(turns):
            for robot, frame in zip(robots, frames, strict=True):
                assert robot.channel is not None
                robot.channel.send(frame)
            while (left := began + (turn + 1) / HERTZ - time.monotonic()) > 0:
                here.loop.turn(left)
        took = time.monotonic() - began
    came = sum(each.received for each in robots) - before
    note = f"{came} of {turns * 2 * half} messages came"
    return [Row("pipes", f"{PIPES} pipes at 10 Hz", "% of a CPU", 100 * watch.seconds / took, note=note)]


def run(options: Options) -> list[Row]:
    """Whole, one field, a scan, many."""
    with ground() as here:
        return [
            *whole(here, options),
            *latency(here, options),
            *scan(here, options),
            *many(here, options),
        ]
