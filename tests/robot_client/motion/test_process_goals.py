"""Goals of a daemon process that ends or freezes while they are active: real ROS, real signals."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from example_interfaces.action import Fibonacci
from rclpy.serialization import serialize_message

from relay_protocol import link
from robot_client.motion.stop_store import GOALS_FILE
from robot_client.platforms.base import CANCELED
from tests.robot_client.robot_process import Robot, until
from tests.robot_client.ros import Peer as Node
from tests.worlds.fake_relay import PATIENCE, FakeRelay, Peer
from tests.worlds.waiting import freeze

SPIN = "/robot1/spin"
"""One of Nav2's, which move the robot by default; here it goes on until it is cancelled."""

FIBONACCI = "example_interfaces/action/Fibonacci"


@pytest.fixture(scope="module")
def node(environment: dict[str, str]) -> Iterator[Node]:
    with closing(Node(environment)) as made:
        made.do("act", SPIN, "forever")
        yield made


@pytest.fixture
def robot(tmp_path: Path, environment: dict[str, str]) -> Iterator[Robot]:
    with closing(FakeRelay()) as relay, closing(Robot(relay, tmp_path / "state", environment)) as made:
        made.enroll()
        yield made


class SentProcessGoal:
    """A daemon whose client has an active goal.

    :param arguments: more for the daemon's command line
    """

    def __init__(self, robot: Robot, node: Node, *arguments: str) -> None:
        self.robot = robot
        self.node = node
        self.process = self.run(*arguments)
        self.begin("first")

    def run(self, *arguments: str) -> subprocess.Popen[str]:
        """Starts a daemon whose client has control, and waits until it has found the action."""
        process = self.robot.run(*arguments)
        self.control = self.robot.relay.register(heartbeat=5.0)  # it outlasts the tests' faults
        assert self.control.order(link.ControlGrant(id=1, holder=1, user="ann")).ok
        self.channel: Peer = self.robot.relay.channel(self.control)
        return process

    def begin(self, id: str) -> None:
        """Send a goal, again while it can't begin."""
        self.ended = len(self.node.reported("ended", SPIN))
        began = len(self.node.reported("began", SPIN))
        body = link.to_base64(bytes(serialize_message(Fibonacci.Goal(order=3))))

        def begun() -> bool:
            """Whether a goal has begun: an active goal sends feedback, an ended one a result."""
            self.channel.send(
                link.SendActionGoal(id=id, action=SPIN, type=FIBONACCI, source=1, feedback=True, cdr=body)
            )
            message = self.channel.expect(link.ActionFeedback | link.ActionResult)  # type: ignore[arg-type]
            return isinstance(message, link.ActionFeedback)

        until(begun)
        until(lambda: len(self.node.reported("began", SPIN)) == began + 1)

    @property
    def cancelled(self) -> bool:
        """Whether the latest goal was cancelled."""
        return len(self.node.reported("ended", SPIN)) > self.ended


def test_goals_of_a_killed_daemon_are_cancelled(robot: Robot, node: Node) -> None:
    """SIGKILL of the daemon: its guard has the action cancel its goals, and exits."""
    goal = SentProcessGoal(robot, node)
    (guard,) = robot.guards(goal.process)
    goal.process.kill()
    until(lambda: goal.cancelled)
    until(lambda: not guard.is_running())


def test_goals_of_a_frozen_daemon_are_cancelled(robot: Robot, node: Node) -> None:
    """SIGSTOP of the daemon: its guard has them cancelled."""
    goal = SentProcessGoal(robot, node)
    freeze(goal.process.pid)
    until(lambda: goal.cancelled)
    goal.process.send_signal(signal.SIGCONT)
    assert goal.channel.expect(link.ActionResult).status == CANCELED
    goal.begin("second")
    assert (robot.state / GOALS_FILE).exists()
    goal.process.terminate()
    assert goal.process.wait(PATIENCE) == 0
    until(lambda: goal.cancelled)
    assert not (robot.state / GOALS_FILE).exists()


def test_goals_of_a_briefly_stalled_daemon_continue(robot: Robot, node: Node) -> None:
    goal = SentProcessGoal(robot, node)
    freeze(goal.process.pid)
    time.sleep(0.8)  # longer than commands may cease
    goal.process.send_signal(signal.SIGCONT)
    time.sleep(1.5)  # shows absence
    assert not goal.cancelled
    (guard,) = robot.guards(goal.process)
    goal.process.kill()
    until(lambda: goal.cancelled)
    until(lambda: not guard.is_running())  # it would cancel the goals of the next test


def test_next_daemon_cancels_goals_that_no_guard_cancelled(robot: Robot, node: Node, tmp_path: Path) -> None:
    """Once, and before any goal begins."""
    config = tmp_path / "robot.toml"
    config.write_text("[safety]\nguard = false\n")
    goal = SentProcessGoal(robot, node, "--config", str(config))
    goal.process.kill()
    time.sleep(1.0)  # shows absence
    assert not goal.cancelled
    process = goal.run("--config", str(config))
    until(lambda: goal.cancelled)
    goal.begin("second")
    time.sleep(2.5)  # shows absence; longer than between two checks
    assert not goal.cancelled
    process.terminate()
    until(lambda: goal.cancelled)


def test_stop_is_not_confirmed_while_an_action_is_frozen(robot: Robot, node: Node) -> None:
    """SIGSTOP of the action: the answer names it, and it cancels its goal when it continues."""
    goal = SentProcessGoal(robot, node)
    with node.frozen():
        done = goal.control.order(link.Stop(id=2, by="eve"))
        assert (done.ok, SPIN in done.reason) == (False, True)
    until(lambda: goal.cancelled)
    alert = goal.control.expect(link.Alert)
    while not alert.over:
        alert = goal.control.expect(link.Alert)
    assert alert.kind == "stop"
    assert goal.control.order(link.Stop(id=3, by="eve")).ok


def test_action_of_a_goal_that_does_not_end_with_the_daemon_is_stored(robot: Robot, node: Node) -> None:
    """SIGTERM of the daemon while the action is frozen; the next daemon cancels the goal."""
    goal = SentProcessGoal(robot, node)
    with node.frozen():
        goal.process.terminate()
        assert goal.process.wait(PATIENCE) == 0
        assert (robot.state / GOALS_FILE).exists()
    process = goal.run()
    until(lambda: goal.cancelled)
    until(lambda: not (robot.state / GOALS_FILE).exists())
    process.terminate()
    assert process.wait(PATIENCE) == 0


def test_goals_of_a_silent_relay_are_cancelled(robot: Robot, node: Node) -> None:
    """It answers no pings; the link lasts longer than the goal."""
    goal = SentProcessGoal(robot, node)
    goal.control.answers = False
    assert goal.channel.expect(link.ActionResult).status == CANCELED
    until(lambda: goal.cancelled)
