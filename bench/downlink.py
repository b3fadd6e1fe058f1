"""A thin downlink to a client: how old a small topic is beside a heavy one, and how many commands arrive.

A real relay, a robot that speaks JSON, and one client behind a proxy that passes so many bytes a second. On one
connection the client subscribes to a pose (20 Hz, few bytes) and to a heavy topic (100 kB at 10 Hz, more than the line
carries) and publishes commands at 10 Hz. Ages are from the robot's write to the client's read, by one clock.
"""

from __future__ import annotations

import contextlib
import tempfile
import time
from pathlib import Path
from typing import Any

from bench.messages import STRING, TWIST
from bench.relay import Relay
from bench.report import Options, Row
from bench.wire import Loop, PlainRobot, WebEnd
from relay_protocol import jsontext
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.processes import running

KILOBYTES = (300, 100)
"""A second, down to the client."""

HEAVY_BYTES = 100_000
HEAVY_SECONDS, POSE_SECONDS, COMMAND_SECONDS = 0.1, 0.05, 0.1
POSE, HEAVY, DRIVE = "/pose", "/heavy", "/cmd_vel"

P50_MS, P99_MS = 300.0, 600.0
"""Goals for the age of a pose."""


class Watcher(WebEnd):
    """A client that notes how old each pose is when it comes; fragmented messages are joined."""

    def _open(self, loop: Loop, connection: Any) -> None:
        self.ages: list[float] = []
        self.heavy = 0
        self._parts: list[bytearray] = []
        self.closed = ""
        super()._open(loop, connection)

    def readable(self) -> None:
        """Bytes, or the end, which is noted."""
        try:
            super().readable()
        except (AssertionError, OSError) as error:
            self.closed = self.closed or str(error)
            self._loop.drop(self)

    def frame(self, buffer: bytearray, start: int, payload: int, end: int) -> None:
        """A data frame: a message, or a part of one."""
        self._parts.append(buffer[payload:end])
        if not buffer[start] & 0x80:
            return
        message, self._parts = b"".join(self._parts), []
        if len(message) >= HEAVY_BYTES:
            self.heavy += 1
            return
        said = jsontext.decode_any(message)
        if said.get("topic") == POSE:
            self.ages.append(time.monotonic() - float(said["msg"]["data"]))


class Watched:
    """What was seen of one line."""

    def __init__(self, watcher: Watcher, sent: int, arrived: int, poses: int, seconds: float) -> None:
        self.ages = sorted(watcher.ages)
        self.heavy = watcher.heavy / seconds
        self.sent, self.arrived, self.poses = sent, arrived, poses
        self.closed = watcher.closed

    def age_ms(self, part: float) -> float:
        """A quantile of the age of a pose."""
        return 1000 * self.ages[min(len(self.ages) - 1, int(part * len(self.ages)))]


def watch(loop: Loop, relay: Relay, robot: PlainRobot, token: str, rate: int, seconds: float) -> Watched:
    """One connection over a line of so many bytes a second."""
    proxy = ChaosProxy(relay.http_port)
    with contextlib.closing(proxy):
        proxy.squeeze_down(rate * 8)
        watcher = Watcher(loop, proxy.port, f"/robots/{robot.name}", token)
        watcher.say(op="advertise", topic=DRIVE, type=TWIST)
        for topic in (POSE, HEAVY):
            watcher.say(op="subscribe", topic=topic, type=STRING)
        loop.until("both are subscribed", lambda: {POSE, HEAVY} <= robot.subscriptions.keys())
        _command(watcher)
        loop.until("the first command arrives", lambda: robot.received > 0)
        arrived, sent, poses = robot.received, 0, 0
        heavy = robot.sample(HEAVY, jsontext.encode({"data": "x" * HEAVY_BYTES}))
        begun = time.monotonic()
        due = {"heavy": begun, "pose": begun, "command": begun}
        channel = robot.channel
        assert channel is not None
        while (now := time.monotonic()) < begun + seconds and not watcher.closed:
            if now >= due["heavy"]:
                due["heavy"] += HEAVY_SECONDS
                channel.send(heavy)
            if now >= due["pose"]:
                due["pose"] += POSE_SECONDS
                poses += 1
                channel.send(robot.sample(POSE, jsontext.encode({"data": repr(time.monotonic())})))
            if now >= due["command"]:
                due["command"] += COMMAND_SECONDS
                sent += 1
                _command(watcher)
            loop.turn(max(0.0, min(due.values()) - time.monotonic()))
        end = time.monotonic() + 1
        while time.monotonic() < end and robot.received - arrived < sent and not watcher.closed:
            loop.turn(0.05)
        seen = Watched(watcher, sent, robot.received - arrived, poses, time.monotonic() - begun)
        if not watcher.closed:
            loop.drop(watcher)
        return seen


def _command(watcher: Watcher) -> None:
    with contextlib.suppress(OSError):
        watcher.say(op="publish", topic=DRIVE, msg={"linear": {"x": 0.1}, "angular": {"z": 0.0}})


def run(options: Options) -> list[Row]:
    """Each line in turn."""
    rows = []
    seconds = options.pick(1, 30)
    for kilobytes in KILOBYTES[:1] if options.quick else KILOBYTES:
        with tempfile.TemporaryDirectory(prefix="bench-") as name, contextlib.ExitStack() as stack:
            relay = Relay(Path(name), "--heartbeat", "60")
            stack.enter_context(running(relay))
            loop = Loop()
            stack.callback(loop.close)
            robot = PlainRobot(loop, relay, "plain", "json", {}, (TWIST,))
            token = relay.user("driver")
            relay.cli("right", "grant", "driver", "plain", "operator")
            seen = watch(loop, relay, robot, token, kilobytes * 1000, seconds)
        what = f"downlink of {kilobytes} kB/s beside 1 MB/s"
        note = (
            f"{what}: {len(seen.ages)} of {seen.poses} poses, {seen.heavy:.2f} heavy samples a second, "
            f"{seen.arrived} of {seen.sent} commands; {seen.closed or 'the connection stayed'}"
        )
        rows += [
            Row("thin", f"{what}: age of a pose, p50", "ms", seen.age_ms(0.5), bar=P50_MS),
            Row("thin", f"{what}: age of a pose, p99", "ms", seen.age_ms(0.99), bar=P99_MS, note=note),
            Row("thin", f"{what}: commands lost of 100", "", 100 * (1 - seen.arrived / seen.sent), bar=0),
        ]
        print(f"    {note}", flush=True)
    for row in rows:
        print(f"    {row.what}: {row.ours:.1f} {row.unit}", flush=True)
    return rows
