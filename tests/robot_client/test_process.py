"""The daemon as a process: real TCP, real ROS, real signals."""

from __future__ import annotations

import json
import os
import signal
import stat
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import pytest
from geometry_msgs.msg import Twist
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Joy

from relay_protocol import link
from tests.robot_client.robot_process import Robot, until
from tests.robot_client.ros import PATIENCE
from tests.robot_client.ros import Peer as Node
from tests.worlds.fake_relay import FakeRelay, Peer
from tests.worlds.machine_pauses import Pulse
from tests.worlds.waiting import freeze, thread_states

TWIST = "geometry_msgs/msg/Twist"
MS = 1_000_000


def command(x: float) -> bytes:
    twist = Twist()
    twist.linear.x = x
    return bytes(serialize_message(twist))


GO = command(1.0)


@pytest.fixture(scope="module")
def node(environment: dict[str, str]) -> Iterator[Node]:
    with closing(Node(environment)) as made:
        made.do("listen", "/cmd_vel", "twist")
        yield made


@pytest.fixture
def relay() -> Iterator[FakeRelay]:
    with closing(FakeRelay()) as made:
        yield made


@pytest.fixture
def robot(relay: FakeRelay, tmp_path: Path, environment: dict[str, str]) -> Iterator[Robot]:
    with closing(Robot(relay, tmp_path / "state", environment)) as made:
        yield made


@pytest.fixture
def enrolled(robot: Robot) -> Robot:
    robot.enroll()
    return robot


class Drive:
    """A daemon on a channel, with its guard running and a listening node.

    :param pulse: of the machine, whose stalls do not count
    """

    def __init__(self, robot: Robot, node: Node, pulse: Pulse) -> None:
        self._pulse = pulse
        self._held_up = 0.0
        self.robot = robot
        self.node = node
        self.process = robot.run()
        self.take()
        self.guard = robot.guards(self.process)[0]
        self.heard_by_node()

    def take(self) -> None:
        """Registers the robot, grants control to source 1, and opens a channel."""
        self.control = self.robot.relay.register()
        assert self.control.order(link.ControlGrant(id=1, holder=1, user="ann")).ok
        self.channel = self.open()

    def open(self) -> Peer:
        channel = self.robot.relay.channel(self.control)
        channel.send(link.Advertise(number=5, topic="/cmd_vel", type=TWIST))
        assert channel.expect(link.Advertised).motion
        return channel

    def heard_by_node(self) -> None:
        """Drives until both the node and the guard are matched."""
        start = len(self.node.heard("/cmd_vel"))
        until(lambda: self.channel.command(5, GO) or len(self.node.heard("/cmd_vel")) > start)
        self.channel.command(5, command(0.0))
        until(self._guard_is_known)

    def _guard_is_known(self) -> bool:
        cmdline = self.guard.cmdline()
        self.node.do("publishers", "/cmd_vel")
        known = [each["publishers"] for each in self.node.record if "publishers" in each]
        return cmdline[cmdline.index("--node") + 1] in known[-1]

    def drive(self) -> int:
        """Drives for half a second; returns when the last command arrived, nanoseconds.

        A zero may have come after it, where the machine held up the commands.
        """
        self._held_up = self._pulse.held_up()
        for _ in range(10):
            self.channel.command(5, GO)
            time.sleep(0.05)  # the driver's rate
        return max(int(each["at"]) for each in self.node.heard("/cmd_vel") if each["x"])

    def zero_after(self, since: int) -> float:
        """Waits for the first zero after a time; returns the delay in milliseconds, without the time for
        which the machine held it up.
        """

        def zeros() -> list[int]:
            return [
                each["at"] for each in self.node.heard("/cmd_vel") if each["at"] > since and each["x"] == 0.0
            ]

        until(zeros)
        return (zeros()[0] - since) / MS - 1000 * (self._pulse.held_up() - self._held_up)


@pytest.fixture
def drive(enrolled: Robot, node: Node) -> Iterator[Drive]:
    """Drives for half a second; returns when the last command arrived, nanoseconds."""
    with Pulse() as pulse:
        yield Drive(enrolled, node, pulse)


STOP_MS = 1500
"""When the robot has had its zero at the latest after the last valid command.

Promised are 500 ms, which ``make bench BENCH=standstill`` measures; a computer full of tests is late at times. Without
what is tested here there would be no zero at all.
"""


def test_enrolment_sends_the_code_and_stores_the_key(robot: Robot) -> None:
    robot.enroll()
    assert (robot.asked.robot, robot.asked.code) == ("r1", "code-1")
    assert len(robot.relay.public_key) == 32
    assert stat.S_IMODE((robot.state / "robot.key").stat().st_mode) == 0o600
    assert robot.relay.public_key not in (robot.state / "robot.key").read_bytes()


def test_refused_enrolment_gives_the_reason_and_leaves_nothing(robot: Robot) -> None:
    """Exit code 1; the relay's text is escaped."""
    process = robot.start("enroll", "--relay", robot.relay.address, "--robot", "r1", "--code", "old")
    peer = robot.relay.accept()
    peer.expect(link.Enroll)
    peer.send(link.Refused(reason="this code was used \x1b[31malready"))
    assert process.wait(PATIENCE) == 1
    assert r"this code was used \x1b[31malready" in robot.log.read_text()
    assert not robot.state.exists()


def test_second_enrolment_needs_replace(enrolled: Robot) -> None:
    process = enrolled.start("enroll", "--relay", enrolled.relay.address, "--robot", "r2", "--code", "x")
    assert process.wait(PATIENCE) == 1
    assert "--replace" in enrolled.log.read_text()


def test_unreachable_relay_is_reported(robot: Robot) -> None:
    robot.relay.close()
    process = robot.start("enroll", "--relay", robot.relay.address, "--robot", "r1", "--code", "x")
    assert process.wait(PATIENCE) == 1
    assert "refuses connections" in robot.log.read_text()
    assert not robot.state.exists()


def test_run_without_an_enrolment_names_the_command(robot: Robot) -> None:
    assert robot.run().wait(PATIENCE) == 1
    assert "switchboard-robot enroll" in robot.log.read_text()


def test_unknown_setting_is_named(enrolled: Robot, tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text("[safety]\nstop_after = 3\n")
    assert enrolled.run("--config", str(tmp_path / "c.toml")).wait(PATIENCE) == 1
    assert "stop_after" in enrolled.log.read_text()


def test_daemon_registers_and_describes_the_robot(enrolled: Robot) -> None:
    enrolled.run("--log-json")
    control = enrolled.relay.register()
    assert control.expect(link.Describe).platform == "ros2"
    assert control.expect(link.Graph).full
    assert control.expect(link.Health).memory is not None
    until(lambda: "registered as" in enrolled.log.read_text())
    lines = [json.loads(each) for each in enrolled.log.read_text().splitlines() if each.startswith("{")]
    assert "registered as r1 at relay-1" in [each["text"] for each in lines]


def test_robot_registers_again_at_a_restarted_relay(enrolled: Robot) -> None:
    enrolled.run()
    enrolled.relay.register()
    enrolled.relay.close()
    time.sleep(1.0)  # the robot's attempts to connect fail meanwhile
    enrolled.relay.open()
    enrolled.relay.register()


def test_other_relay_is_refused(enrolled: Robot) -> None:
    """It gets no proof, and the log gives the reason."""
    enrolled.relay.name = "relay-2"
    enrolled.run()
    peer = enrolled.relay.accept()
    enrolled.relay.challenge(peer)
    assert peer.expect_end() == []
    until(lambda: "enrolled at 'relay-1'" in enrolled.log.read_text())


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"\xff\xff\xff\xff", "frame of 4294967295 bytes"),
        (b"\0\0\0\x05\0\xff\xfe\xfd\xfc", "UTF-8"),
        (b"\0\0\0\x06\x09hello", "frame kind 9"),
    ],
)
def test_protocol_violations_end_the_link(enrolled: Robot, data: bytes, words: str) -> None:
    """A frame over the limit, invalid UTF-8, an unknown kind; the daemon continues."""
    enrolled.run()
    control = enrolled.relay.register()
    control.raw(data)
    control.expect_end()
    until(lambda: words in enrolled.log.read_text())
    assert "Traceback" not in enrolled.log.read_text()
    enrolled.relay.register()


def test_robot_stops_when_commands_end(drive: Drive) -> None:
    assert drive.zero_after(drive.drive()) < STOP_MS


def test_robot_stops_when_its_channel_is_lost(drive: Drive) -> None:
    last = drive.drive()
    drive.channel.cut()
    assert drive.zero_after(last) < STOP_MS


def test_guard_stops_the_robot_of_a_killed_daemon(drive: Drive) -> None:
    """Then it exits."""
    last = drive.drive()
    drive.process.kill()
    assert drive.zero_after(last) < STOP_MS
    until(lambda: not drive.guard.is_running())


def test_guard_has_a_raised_priority_where_permitted(drive: Drive) -> None:
    assert drive.guard.nice() == (-10 if _may_be_raised() else os.getpriority(os.PRIO_PROCESS, 0))


def _may_be_raised() -> bool:
    """Whether processes of this user may have such a priority; tried by a thread, as Linux sets it per thread."""

    def attempt() -> bool:
        try:
            os.setpriority(os.PRIO_PROCESS, 0, -10)
        except PermissionError:
            return False
        return True

    with ThreadPoolExecutor(1) as one:
        return one.submit(attempt).result()


def test_guard_publishes_a_joystick_zero_of_the_same_shape(drive: Drive) -> None:
    drive.node.do("listen", "/joy", "joy")
    drive.channel.send(link.Advertise(number=6, topic="/joy", type="sensor_msgs/msg/Joy"))
    assert drive.channel.expect(link.Advertised).motion
    body = bytes(serialize_message(Joy(axes=[0.5, 0.0, -1.0], buttons=[1, 0])))
    until(lambda: drive.channel.command(6, body) or drive.node.heard("/joy"))
    drive.channel.command(6, body)
    drive.process.kill()
    until(lambda: not any(drive.node.heard("/joy")[-1]["axes"]))
    assert drive.node.heard("/joy")[-1]["axes"] == [0.0, 0.0, 0.0]
    assert drive.node.heard("/joy")[-1]["buttons"] == [0, 0]
    until(lambda: not drive.guard.is_running())


def test_guard_stops_the_robot_of_a_frozen_daemon(drive: Drive) -> None:
    """Commands that waited in the frozen daemon are not executed."""
    last = drive.drive()
    freeze(drive.process.pid)
    for _ in range(5):
        drive.channel.command(5, GO)
    assert drive.zero_after(last) < STOP_MS
    time.sleep(1.0)  # the commands expire
    thawed = time.monotonic_ns()
    drive.process.send_signal(signal.SIGCONT)
    drive.control.expect(link.Health)
    time.sleep(0.5)  # shows absence
    assert [each for each in drive.node.heard("/cmd_vel") if each["at"] > thawed and each["x"] != 0.0] == []


def test_sigterm_stops_the_robot_and_the_processes(drive: Drive) -> None:
    last = drive.drive()
    drive.process.terminate()
    assert drive.process.wait(PATIENCE) == 0
    assert drive.zero_after(last) < STOP_MS
    assert any(isinstance(each, link.Bye) for each in drive.control.expect_end())
    until(lambda: not drive.guard.is_running())


def test_stale_and_future_commands_are_refused_and_counted(drive: Drive) -> None:
    drive.channel.command(5, command(0.7), age=0.6)
    drive.channel.command(5, command(0.7), age=-0.6)
    until(lambda: drive.control.expect(link.Health).stale_commands >= 2)
    assert 0.7 not in [each["x"] for each in drive.node.heard("/cmd_vel")]


def test_killed_guard_is_restarted_and_raises_an_alert(drive: Drive) -> None:
    drive.guard.kill()
    alert = drive.control.expect(link.Alert)
    assert "guard" in alert.text
    until(lambda: [each for each in drive.robot.guards(drive.process) if each.pid != drive.guard.pid])
    drive.guard = drive.robot.guards(drive.process)[0]
    drive.heard_by_node()
    last = drive.drive()
    drive.process.kill()
    assert drive.zero_after(last) < STOP_MS
    until(lambda: not drive.guard.is_running())


WAKEUPS = 2000
"""In two seconds, at most."""


def wakeups(pid: int) -> int:
    """How often the threads of a process were given a CPU (proc(5), schedstat)."""
    return sum(int(each.read_text().split()[2]) for each in Path(f"/proc/{pid}/task").glob("*/schedstat"))


def test_idle_guard_rests(drive: Drive) -> None:
    """It is woken rarely, and does nothing between."""
    before, rested = wakeups(drive.guard.pid), 0
    for _ in range(40):
        time.sleep(0.05)  # the time of the measurement
        rested += set(thread_states(drive.guard.pid)) == {"S"}
    assert rested
    assert wakeups(drive.guard.pid) - before < WAKEUPS
    assert os.getsid(drive.guard.pid) != os.getsid(drive.process.pid)


def test_no_command_passes_while_the_guard_is_frozen(drive: Drive) -> None:
    drive.drive()
    drive.guard.suspend()
    try:
        held_back = time.monotonic() + PATIENCE
        while not drive.channel.command(5, GO) and drive.node.heard("/cmd_vel")[-1]["x"] != 0.0:
            assert time.monotonic() < held_back
            time.sleep(0.05)  # the driver's rate
        stood = len(drive.node.heard("/cmd_vel"))
        for _ in range(10):
            drive.channel.command(5, GO)
            time.sleep(0.05)  # the driver's rate
        assert {each["x"] for each in drive.node.heard("/cmd_vel")[stood:]} <= {0.0}
    finally:
        drive.guard.resume()
    until(lambda: drive.channel.command(5, GO) or drive.node.heard("/cmd_vel")[-1]["x"] != 0.0)


def test_topic_advertised_with_a_wrong_type_can_be_driven_later(drive: Drive) -> None:
    """The guard can stop it."""
    drive.channel.send(link.Advertise(number=6, topic="/base", type="geometry_msgs/msg/TwistStamped"))
    assert drive.channel.expect(link.Advertised).motion
    drive.channel.send(link.Unadvertise(number=6))
    drive.node.do("listen", "/base", "twist")
    drive.channel.send(link.Advertise(number=7, topic="base", type="geometry_msgs/Twist"))
    assert drive.channel.expect(link.Advertised).motion
    until(lambda: drive.channel.command(7, GO) or drive.node.heard("/base"))
    drive.process.kill()
    until(lambda: drive.node.heard("/base")[-1]["x"] == 0.0)
    until(lambda: not drive.guard.is_running())


def test_simulated_time_is_reported(enrolled: Robot, relay: FakeRelay) -> None:
    process = enrolled.run("--use-sim-time")
    control = relay.register()
    assert control.expect(link.Describe).sim_time is True
    until(lambda: enrolled.guards(process))
    assert "--sim-time" in enrolled.guards(process)[0].cmdline()


def test_daemon_killed_after_a_stop_starts_stopped(drive: Drive) -> None:
    drive.drive()
    assert drive.control.order(link.Stop(id=2, by="eve", why="test")).ok
    drive.process.kill()
    drive.process.wait()
    until(lambda: not drive.guard.is_running())
    since = time.monotonic_ns()
    drive.process = drive.robot.run()
    drive.take()
    # It was sent when the robot registered, before the order was answered.
    stopped = next(each for each in drive.control.skipped if isinstance(each, link.MotionState)).stopped
    assert stopped is not None
    assert (stopped.by, stopped.why) == ("eve", "test")
    for _ in range(20):
        drive.channel.command(5, GO)
        time.sleep(0.05)  # the driver's rate
    assert [each for each in drive.node.heard("/cmd_vel") if each["at"] > since and each["x"] != 0.0] == []
    assert drive.control.order(link.Resume(id=3, by="ann")).ok
    time.sleep(0.8)  # a pause counts as a release
    drive.guard = drive.robot.guards(drive.process)[0]
    drive.heard_by_node()


def test_stop_while_driving_publishes_zero_at_once(drive: Drive) -> None:
    """Later commands are refused."""
    drive.drive()
    assert drive.control.order(link.Stop(id=2, by="eve")).ok
    reported = time.monotonic_ns()
    for _ in range(10):
        drive.channel.command(5, GO)
        time.sleep(0.05)  # the driver's rate
    settled = reported + 100 * MS  # earlier messages are still under way
    assert [each for each in drive.node.heard("/cmd_vel") if each["at"] > settled and each["x"] != 0.0] == []
    assert drive.control.order(link.Resume(id=3, by="eve")).ok
