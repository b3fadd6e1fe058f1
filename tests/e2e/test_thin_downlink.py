"""A slow downlink between the relay and a client: commands, pings and small topics pass beside too much data.

Everything is real except the robot, which the test plays. Ages are compared with the time that the line
itself needs.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import select
import ssl
import statistics
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from relay_protocol import PROTOCOL_VERSION, frames, identity, link
from robot_client.apps.blocking_websocket import BlockingWebsocket
from tests.worlds.certificates import Authority
from tests.worlds.chaos_proxy import ChaosProxy
from tests.worlds.fake_robot import FakeRobot
from tests.worlds.machine_pauses import Pulse
from tests.worlds.processes import running
from tests.worlds.relay_process import Relay
from tests.worlds.waiting import PATIENCE, wait_for

STRING, TWIST = "std_msgs/msg/String", "geometry_msgs/msg/Twist"
HEAVY_BYTES = 100_000

DRIVE_SECONDS = 12
COMMANDS = 100


class Robot:
    """A robot that speaks JSON: it offers every topic, and publishes a pose and large samples on request."""

    def __init__(
        self, relay: Relay, port: int, parts: bool = False, tls: ssl.SSLContext | None = None
    ) -> None:
        self._parts = parts
        self._tls = tls
        code = relay.cli("robot", "add", "rover")["enrolment_code"]
        key = identity.generate_key()
        with self._dial(relay.robots_port) as enrolling:
            assert enrolling.enroll("rover", code, key)["op"] == "enrolled"
        self._port = port
        self.control = self._dial(port)
        assert self.control.register("rover", key)["op"] == "welcome"
        self.control.send(link.Describe(platform="test", motion=link.MotionPolicy(types=[TWIST])))
        topics = {"/heavy": link.Topic(types=[STRING], publishers=["/camera"])}
        self.control.send(link.Graph(full=True, topics=topics, nodes={"/camera": {}}))
        self.channel: FakeRobot | None = None
        self.numbers: dict[str, int] = {}
        self.commands: list[dict[str, Any]] = []
        self.command_ages: list[float] = []
        self.command_stamps: list[int] = []
        self.samples: list[tuple[float, Any]] = []
        self._lock = threading.Lock()
        self._over = threading.Event()
        self._threads = [threading.Thread(target=self._serve_control, daemon=True)]
        self._threads[0].start()

    def _dial(self, port: int) -> FakeRobot:
        end = FakeRobot(port)
        if self._tls is not None:
            end.socket = self._tls.wrap_socket(end.socket, server_hostname="127.0.0.1")
        return end

    def stop(self) -> None:
        self._over.set()
        for each in self._threads:
            each.join(PATIENCE)
        for end in (self.control, self.channel):
            if end is not None:
                end.socket.close()

    def _serve_control(self) -> None:
        for message in self._messages(self.control):
            if message["op"] == "open_channel" and self.channel is None:
                self.channel = self._dial(self._port)
                self.channel.send(
                    link.Join(version=PROTOCOL_VERSION, ticket=message["ticket"], parts=self._parts)
                )
                self._threads.append(threading.Thread(target=self._serve_channel, daemon=True))
                self._threads[-1].start()

    def _messages(self, end: FakeRobot) -> Iterator[dict[str, Any]]:
        while not self._over.is_set():
            try:
                if not select.select([end.socket], [], [], 0.05)[0]:
                    continue
                # One thread at a time: a TLS connection is not thread-safe.
                with self._lock:
                    end.socket.settimeout(0.01)
                    data = end.socket.recv(1 << 20)
            except TimeoutError:
                continue
            except OSError:
                return
            if not data:
                return
            for frame in end._decoder.feed(data):
                if not isinstance(frame, frames.JsonFrame):
                    body = json.loads(frame.body)
                    if isinstance(frame, frames.CommandFrame):
                        self.commands.append(body)
                        self.command_stamps.append(frame.stamp)
                        self.command_ages.append(time.monotonic() - body["angular"]["z"])
                    else:
                        self.samples.append((time.monotonic(), body))
                    continue
                message = json.loads(frame.body)
                if message["op"] == "ping":
                    self._send(end, link.Pong(t=message["t"], at=time.monotonic_ns()))
                elif message["op"] == "control_grant":
                    self._send(end, link.OrderResult(id=message["id"]))
                else:
                    yield message

    def _send(self, end: FakeRobot, message: link.Message) -> None:
        self._send_bytes(end, link.frame(message))

    def _send_bytes(self, end: FakeRobot, data: bytes) -> None:
        with self._lock:
            end.socket.settimeout(PATIENCE)
            end.send_bytes(data)

    def _serve_channel(self) -> None:
        channel = self.channel
        assert channel is not None
        for message in self._messages(channel):
            named = {key: message.get(key) for key in ("number", "topic", "type")}
            if message["op"] == "subscribe":
                self._send(channel, link.Subscribed(**named, encoding="json"))
                self.numbers[message["topic"]] = message["number"]
            elif message["op"] == "advertise":
                self._send(channel, link.Advertised(**named, encoding="json"))

    def publish(self, topic: str, body: Any) -> None:
        """Publishes one sample."""
        assert self.channel is not None
        frame = frames.encode_sample(self.numbers[topic], time.time_ns(), json.dumps(body).encode())
        self._send_bytes(self.channel, frame)

    def check_order(self) -> None:
        """Commands arrived in the order of sending, each with its stamp."""
        numbers = [each["linear"]["x"] for each in self.commands]
        assert numbers == sorted(numbers), "commands overtook each other"
        assert self.command_stamps == sorted(self.command_stamps)


class Ground:
    """A relay, its robot, and an operator; clients come by a proxy."""

    def __init__(
        self, relay: Relay, robot: Robot, proxy: ChaosProxy, token: str, tls: ssl.SSLContext | None
    ) -> None:
        self.relay, self.robot, self.proxy, self.token, self._tls = relay, robot, proxy, token, tls

    def connect(self) -> Any:
        """A client's websocket over the slow line."""
        path = f"127.0.0.1:{self.proxy.port}/robots/rover"
        options: dict[str, Any] = {
            "additional_headers": {"Authorization": f"Bearer {self.token}"},
            "open_timeout": PATIENCE,
            "max_queue": None,
            "max_size": None,
            "compression": None,
        }
        if self._tls is None:
            return connect(f"ws://{path}", **options)
        return BlockingWebsocket(f"wss://{path}", ssl=self._tls, **options)


@contextlib.contextmanager
def ground(
    folder: Path,
    *options: str,
    parts: bool = False,
    thin_robot: float | None = None,
    buffer: int | None = None,
    tls: ssl.SSLContext | None = None,
) -> Iterator[Ground]:
    """One, with an unlimited line at first.

    :param parts: whether the robot accepts samples in parts
    :param thin_robot: bytes per second of the robot's own downlink
    :param buffer: of the proxy; by default it acknowledges much that no client has
    """
    relay = Relay(folder, *options)
    with contextlib.ExitStack() as stack:
        stack.enter_context(running(relay))
        proxy = ChaosProxy(relay.http_port, buffer)
        stack.callback(proxy.close)
        far = ChaosProxy(relay.robots_port)
        stack.callback(far.close)
        if thin_robot is not None:
            far.squeeze_down(thin_robot * 8)
        robot = Robot(relay, far.port, parts, tls)
        stack.callback(robot.stop)
        token = relay.user("driver")
        relay.cli("right", "grant", "driver", "rover", "operator")
        wait_for("the robot is online", lambda: relay.state_of("rover") != "offline")
        yield Ground(relay, robot, proxy, token, tls)


class Seen:
    """Messages that arrived while a client drove beside a large topic."""

    def __init__(self) -> None:
        self.ages: list[float] = []
        self.heavy = self.sent = 0
        self.statuses: list[str] = []
        self.reported: list[dict[str, Any]] = []


def messages(socket: Any) -> Iterator[str]:
    """Messages until the connection ends in any way."""
    with contextlib.suppress(ConnectionClosed):
        yield from socket


def drive(ground: Ground, socket: Any, seconds: float) -> Seen:
    """Commands at 10 Hz on a connection that has also subscribed to 100 kB at 10 Hz and to a pose at 20 Hz."""
    robot, seen = ground.robot, Seen()

    def say(**message: Any) -> None:
        socket.send(json.dumps(message))

    def read() -> None:
        for text in messages(socket):
            message = json.loads(text)
            if message["op"] == "status":
                seen.statuses.append(message["msg"])
            elif message.get("topic") == "/heavy":
                seen.heavy += 1
            elif message.get("topic") == "/pose":
                seen.ages.append(time.monotonic() - float(message["msg"]["data"]))
            elif message.get("topic") == "/relay/status":
                seen.reported.append(message["msg"])

    say(op="set_level", level="warning")
    say(op="advertise", topic="/cmd_vel", type=TWIST)
    say(op="subscribe", topic="/relay/status")
    for topic in ("/pose", "/heavy"):
        say(op="subscribe", topic=topic, type=STRING)
    wait_for("both are subscribed", lambda: {"/pose", "/heavy"} <= robot.numbers.keys())
    say(op="publish", topic="/cmd_vel", msg={"linear": {"x": 0.0}, "angular": {"z": time.monotonic()}})
    wait_for("the first command arrives", lambda: robot.commands)
    reading = threading.Thread(target=read, daemon=True)
    reading.start()
    heavy = {"data": "x" * HEAVY_BYTES}
    begun = time.monotonic()
    for tick in itertools.count():
        if (wait := begun + tick * 0.05 - time.monotonic()) > 0:
            time.sleep(wait)
        if time.monotonic() > begun + seconds:
            break
        robot.publish("/pose", {"data": repr(time.monotonic())})
        if tick % 2:
            robot.publish("/heavy", heavy)
            seen.sent += 1
            twist = {"linear": {"x": 1.0 + seen.sent}, "angular": {"z": time.monotonic()}}
            say(op="publish", topic="/cmd_vel", msg=twist)
    wait_for(
        "the last command arrives",
        lambda: any(each["linear"]["x"] == 1.0 + seen.sent for each in robot.commands),
    )
    assert reading.is_alive(), "the connection was closed"
    return seen


@pytest.mark.parametrize(("rate", "secure"), [(300_000, False), (100_000, False), (300_000, True)])
def test_a_heavy_topic_takes_neither_control_nor_the_small_topics_away(
    tmp_path: Path, rate: int, secure: bool
) -> None:
    """All commands arrive, the pose is at most as old as one large sample makes it, and the large topic still
    arrives.
    """
    options, tls = [], None
    if secure:
        authority = Authority(tmp_path, "ca")
        cert, key = tmp_path / "cert.pem", tmp_path / "key.pem"
        authority.certify(cert, key)
        options = ["--tls-cert", str(cert), "--tls-key", str(key)]
        tls = ssl.create_default_context(cafile=str(authority.path))
    with ground(tmp_path, *options, tls=tls) as at:
        at.proxy.squeeze_down(rate * 8)
        with at.connect() as socket, Pulse() as pulse:
            seen = drive(at, socket, DRIVE_SECONDS)
            held_up = pulse.held_up()
        assert secure or socket.protocol.close_rcvd is not None, "the answer to the close frame was lost"
    arrived = {each["linear"]["x"] for each in at.robot.commands}
    lost = [number for number in range(1, seen.sent + 1) if 1.0 + number not in arrived]
    at.robot.check_order()
    # A busy machine makes commands old, ten per second; the bench counts them on an idle one.
    assert len(lost) <= seen.sent / 3 + 10 * held_up, f"commands {lost} of {seen.sent} are lost"
    alone = HEAVY_BYTES / rate
    assert statistics.median(seen.ages) <= max(0.3, alone) + held_up
    # A busy machine may use any part of the line.
    assert seen.ages
    assert seen.heavy
    words = next(each for each in seen.statuses if each.startswith("/heavy: "))
    assert "throttle_rate" in words
    last = seen.reported[-1]
    assert last["downlink"]["thin"]
    # A busy machine carries less than the line does.
    rates = [each["downlink"]["bytes_per_second"] for each in seen.reported if each["downlink"]["thin"]]
    assert 0 < statistics.median(rates) <= 1.5 * rate
    assert "throttle_rate" in last["downlink"]["advice"]
    assert {each["topic"] for each in last["topic_drops"]} >= {"/heavy"}


def test_a_client_that_takes_nothing_learns_from_a_close_frame_why_it_is_cut(tmp_path: Path) -> None:
    """When it reads again, it finds the frame behind the few bytes that were under way."""
    with ground(tmp_path) as at:
        at.proxy.squeeze_down(300_000 * 8)
        with at.connect() as socket:
            for topic in ("/pose", "/heavy"):
                socket.send(json.dumps({"op": "subscribe", "topic": topic, "type": STRING}))
            wait_for("both are subscribed", lambda: {"/pose", "/heavy"} <= at.robot.numbers.keys())
            over = threading.Event()

            def publish() -> None:
                while not over.wait(0.1):
                    at.robot.publish("/heavy", {"data": "x" * HEAVY_BYTES})

            publishing = threading.Thread(target=publish, daemon=True)
            publishing.start()
            for _ in range(5):
                socket.recv(timeout=PATIENCE)
            at.proxy.forward_down.clear()
            wait_for("it is cut", lambda: "no answer to pings" in at.relay.log)
            # Longer than other clients have to answer a close frame.
            time.sleep(3)
            at.proxy.forward_down.set()
            with pytest.raises(ConnectionClosed) as closed:
                while True:
                    socket.recv(timeout=PATIENCE)
            over.set()
            publishing.join(PATIENCE)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 4408
    assert "no answer to pings" in closed.value.rcvd.reason


@pytest.mark.parametrize("parts", [True, False])
def test_uploads_do_not_delay_commands_on_a_thin_downlink(tmp_path: Path, parts: bool) -> None:
    """If the robot accepts samples in parts, commands are sent between them; otherwise each waits for a
    sample or two.
    """
    rate = 300_000
    with ground(tmp_path, parts=parts, thin_robot=rate) as at, at.connect() as socket:
        robot = at.robot

        def say(**message: Any) -> None:
            socket.send(json.dumps(message))

        say(op="advertise", topic="/cmd_vel", type=TWIST)
        say(op="advertise", topic="/upload", type=STRING)
        say(op="publish", topic="/cmd_vel", msg={"linear": {"x": 0.0}, "angular": {"z": time.monotonic()}})
        wait_for("the first command arrives", lambda: robot.commands)
        robot.command_ages.clear()
        begun = time.monotonic()
        with Pulse() as pulse:
            for tick in range(COMMANDS):
                if (wait := begun + tick * 0.1 - time.monotonic()) > 0:
                    time.sleep(wait)
                say(op="publish", topic="/upload", msg={"data": "x" * HEAVY_BYTES})
                twist = {"linear": {"x": 1.0 + tick}, "angular": {"z": time.monotonic()}}
                say(op="publish", topic="/cmd_vel", msg=twist)
            wait_for(
                "the last command arrives",
                lambda: any(each["linear"]["x"] == COMMANDS for each in robot.commands),
            )
            held_up = pulse.held_up()
        robot.check_order()
        assert statistics.median(robot.command_ages) <= (1 if parts else 3) * HEAVY_BYTES / rate + held_up
        # A busy machine makes commands old, ten per second.
        assert len(robot.command_ages) >= (0.9 if parts else 0.25) * COMMANDS - 10 * held_up
        assert robot.samples
        assert robot.samples[-1][1]["data"] == "x" * HEAVY_BYTES


def test_an_event_stream_sends_new_events_before_old_ones(tmp_path: Path) -> None:
    """A large topic over HTTP: a message is as old as the line needs for one or two, not for the kernel's
    buffers.
    """
    rate = 300_000
    with ground(tmp_path, buffer=16_384) as at:
        at.proxy.squeeze_down(rate * 8)
        ages: list[float] = []
        statuses: list[str] = []
        event = ""
        over = threading.Event()

        def publish() -> None:
            while not over.wait(0.1):
                if "/heavy" in at.robot.numbers:
                    at.robot.publish("/heavy", {"data": f"{time.monotonic()!r} " + "x" * HEAVY_BYTES})

        publishing = threading.Thread(target=publish, daemon=True)
        publishing.start()
        url = f"http://localhost:{at.proxy.port}/api/v1/robots/rover/topics/heavy"
        headers = {"Authorization": f"Bearer {at.token}", "Accept": "text/event-stream"}
        with httpx.stream("GET", url, headers=headers, timeout=PATIENCE) as answer, Pulse() as pulse:
            assert answer.status_code == 200, answer.read()
            for line in answer.iter_lines():
                if line.startswith("event: "):
                    event = line
                elif line.startswith("data: {") and event == "event: message":
                    data = json.loads(line[6:])
                    ages.append(time.monotonic() - float(data["data"].split()[0]))
                elif line.startswith("data: {"):
                    statuses.append(json.loads(line[6:])["msg"])
                if len(ages) == 20:
                    break
            held_up = pulse.held_up()
        over.set()
        publishing.join(PATIENCE)
    assert statistics.median(ages) <= 4 * HEAVY_BYTES / rate + held_up
    assert any("you read them too slowly" in each for each in statuses)
