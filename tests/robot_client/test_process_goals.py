"""Goals of a daemon that is a process, and ends or stands still while they are pursued: real ROS, real signals."""

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
from switchboard_waiting import freeze

from relay_protocol import link
from robot_client.motion.stop_store import GOALS
from robot_client.platforms.base import CANCELED
from tests.robot_client.fake_relay import PATIENCE, FakeRelay, Peer
from tests.robot_client.robot_process import Robot, until
from tests.robot_client.ros import Peer as Node

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


class Errand:
    """A daemon whose client has a goal pursued.

    :param arguments: more for the daemon's command line
    """

    def __init__(self, robot: Robot, node: Node, *arguments: str) -> None:
        self.robot = robot
        self.node = node
        self.process = self.run(*arguments)
        self.begin("first")

    def run(self, *arguments: str) -> subprocess.Popen[str]:
        """Start a daemon whose client holds control, and wait until it has found the action."""
        process = self.robot.run(*arguments)
        self.control = self.robot.relay.register(heartbeat=5.0)  # it outlasts what the tests do to the daemon
        assert self.control.order(link.Control(id=1, holder=1, user="ann")).ok
        self.channel: Peer = self.robot.relay.channel(self.control)
        return process

    def begin(self, id: str) -> None:
        """Give a goal, again where it can't begin yet."""
        self.ended = len(self.node.told("ended", SPIN))
        began = len(self.node.told("began", SPIN))
        body = link.to_base64(bytes(serialize_message(Fibonacci.Goal(order=3))))

        def begun() -> bool:
            """Feedback comes from a goal that is pursued, a result from one that is not."""
            self.channel.say(
                link.SendActionGoal(id=id, action=SPIN, type=FIBONACCI, source=1, feedback=True, cdr=body)
            )
            message = self.channel.expect(link.ActionFeedback | link.ActionResult)  # type: ignore[arg-type]
            return isinstance(message, link.ActionFeedback)

        until(begun)
        until(lambda: len(self.node.told("began", SPIN)) == began + 1)

    @property
    def cancelled(self) -> bool:
        """Whether the latest goal was."""
        return len(self.node.told("ended", SPIN)) > self.ended


def test_goals_of_a_killed_daemon_are_cancelled(robot: Robot, node: Node) -> None:
    """kill -9 of the daemon: its guard has the action cancel what it pursues, and leaves."""
    errand = Errand(robot, node)
    (guard,) = robot.guards(errand.process)
    errand.process.kill()
    until(lambda: errand.cancelled)
    until(lambda: not guard.is_running())


def test_goals_of_a_frozen_daemon_are_cancelled(robot: Robot, node: Node) -> None:
    """SIGSTOP of the daemon: its guard has them cancelled; it goes on when it may, and leaves none when it ends."""
    errand = Errand(robot, node)
    freeze(errand.process.pid)
    until(lambda: errand.cancelled)
    errand.process.send_signal(signal.SIGCONT)
    assert errand.channel.expect(link.ActionResult).status == CANCELED
    errand.begin("second")
    assert (robot.state / GOALS).exists()
    errand.process.terminate()
    assert errand.process.wait(PATIENCE) == 0
    until(lambda: errand.cancelled)
    assert not (robot.state / GOALS).exists()


def test_goals_of_a_stalled_daemon_go_on(robot: Robot, node: Node) -> None:
    """What a driver would hardly notice does not end a long way."""
    errand = Errand(robot, node)
    freeze(errand.process.pid)
    time.sleep(0.8)  # longer than commands may cease
    errand.process.send_signal(signal.SIGCONT)
    time.sleep(1.5)  # proves absence
    assert not errand.cancelled
    errand.process.kill()
    until(lambda: errand.cancelled)


def test_goals_are_cancelled_by_the_next_daemon_at_the_latest(
    robot: Robot, node: Node, tmp_path: Path
) -> None:
    """Where nobody was left to do it the next daemon does before anything new begins, and does it once."""
    config = tmp_path / "robot.toml"
    config.write_text("[safety]\nguard = false\n")
    errand = Errand(robot, node, "--config", str(config))
    errand.process.kill()
    time.sleep(1.0)  # proves absence
    assert not errand.cancelled
    process = errand.run("--config", str(config))
    until(lambda: errand.cancelled)
    errand.begin("second")
    time.sleep(2.5)  # proves absence; longer than between two looks
    assert not errand.cancelled
    process.terminate()
    until(lambda: errand.cancelled)


def test_stop_is_not_confirmed_while_an_action_is_frozen(robot: Robot, node: Node) -> None:
    """SIGSTOP of the action: the stop is answered with its name, and it cancels its goal when it goes on."""
    errand = Errand(robot, node)
    with node.frozen():
        done = errand.control.order(link.Stop(id=2, by="eve"))
        assert (done.ok, SPIN in done.reason) == (False, True)
    until(lambda: errand.cancelled)
    told = errand.control.expect(link.Alert)
    while not told.over:
        told = errand.control.expect(link.Alert)
    assert told.kind == "stop"
    assert errand.control.order(link.Stop(id=3, by="eve")).ok


def test_goal_that_does_not_end_with_the_daemon_is_noted(robot: Robot, node: Node) -> None:
    """SIGTERM of the daemon while the action is frozen: the note outlasts it, and the next daemon leaves none."""
    errand = Errand(robot, node)
    with node.frozen():
        errand.process.terminate()
        assert errand.process.wait(PATIENCE) == 0
        assert (robot.state / GOALS).exists()
    process = errand.run()
    until(lambda: errand.cancelled)
    until(lambda: not (robot.state / GOALS).exists())
    process.terminate()
    assert process.wait(PATIENCE) == 0


def test_goals_of_a_silent_relay_are_cancelled(robot: Robot, node: Node) -> None:
    """It answers no pings; the link lasts for longer than the goal."""
    errand = Errand(robot, node)
    errand.control.answers = False
    assert errand.channel.expect(link.ActionResult).status == CANCELED
    until(lambda: errand.cancelled)
