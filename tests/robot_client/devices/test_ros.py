"""Modules as nodes in a real ROS 2 graph: a base, and targets by TCP."""

from __future__ import annotations

import os
import signal
import socket
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, Twist
from nav2_msgs.action import FollowWaypoints
from nav_msgs.msg import Odometry
from rclpy.action import ActionClient
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from robot_client.devices import RobotNode
from robot_client.devices.command_server import CONNECTIONS, UNPROVED_CONNECTIONS
from tests.worlds.command_client import CommandClient
from tests.worlds.processes import Process
from tests.worlds.python_module import PythonModule
from tests.worlds.ros_domains import free_domain
from tests.worlds.service_process import TopicWatcher
from tests.worlds.waiting import wait_for

HERE = "tests.robot_client.devices"
SECRET = b"a secret of the test"


class World:
    """A base, a navigator, and the modules that drive to targets and take commands by TCP."""

    def __init__(self, folder: Path, domain: int) -> None:
        self.folder = folder
        self.environment = {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        self.onlooker = TopicWatcher(domain)
        # Long before anything is announced.
        self.onlooker.watch("/say", String)
        self.modules: list[PythonModule] = []
        self.navigator = Process(
            [sys.executable, "-m", f"{HERE}.navigator_node"], folder, "navigator", self.environment_of_all()
        )
        self.navigator.wait_to_say("READY")
        self.base = self.module(f"{HERE}.example_base:Base", "base", command_limit=0.4)
        self.targets = self.module(
            "robot_client.devices.target_follower:TargetFollower", "targets", waypoints="follow_waypoints"
        )
        secret = folder / "secret"
        secret.write_bytes(SECRET)
        secret.chmod(0o600)
        self.server = self.module(
            "robot_client.devices.command_server:CommandServer",
            "commands",
            modules=["targets"],
            port=0,
            host="0.0.0.0",
            secret_file=str(secret),
        )
        for each in self.modules:
            each.ready()
        self.port = int(next(each for each in self.server.texts() if "listening" in each).rpartition(":")[2])

    def environment_of_all(self) -> dict[str, str]:
        return {**os.environ, **self.environment}

    def module(self, python: str, name: str, **settings: Any) -> PythonModule:
        made = PythonModule(self.folder, python, name=name, environment=self.environment, **settings)
        self.modules.append(made)
        return made

    def close(self) -> None:
        for each in self.modules:
            each.kill()
        self.navigator.kill()
        self.onlooker.close()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        made = World(tmp_path_factory.mktemp("world"), free_domain())
        yield made
        made.close()


def test_base_drives_by_cmd_vel_and_stands_still_without(world: World) -> None:
    looker, base = world.onlooker, world.base
    looker.watch("/odom", Odometry)
    looker.watch("/tf", TFMessage)
    publisher = looker.node.create_publisher(Twist, "/cmd_vel", 1)
    command = Twist()
    command.linear.x, command.angular.z = 0.5, 0.25

    def drive() -> None:
        publisher.publish(command)

    def moves(message: Odometry) -> bool:
        return bool(message.twist.twist.linear.x == 0.5 and message.twist.twist.angular.z == 0.25)

    base.daemon.send("stopped", stopped=False)
    looker.newest("/odom", moves, meanwhile=drive)
    # The commands end, and the last one is older than the limit.
    still = looker.newest("/odom", lambda message: message.twist.twist.linear.x == 0)
    assert (still.header.frame_id, still.child_frame_id) == ("odom", "base_link")
    transform = looker.newest("/tf").transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "base_link")
    looker.newest("/odom", moves, meanwhile=drive)
    base.daemon.send("stopped", stopped=True)
    looker.newest("/odom", lambda message: message.twist.twist.linear.x == 0, meanwhile=drive)


def test_bytes_that_mean_harm_end_their_own_connection_alone(world: World) -> None:
    """On the real socket."""
    with closing(CommandClient(world.port, SECRET)) as client:
        for data in (b"GET / HTTP/1.1\r\n\r\n", b"\xff" * 100_000, b"\0\0\0\3\0{}", b"\0\0\0\0"):
            assert refused(world.port, data)
        assert "go needs a list" in client.command({"go": 1})


def test_silent_connections_lock_no_client_out(world: World) -> None:
    """On the real socket; the first of them receives a reason."""
    with ExitStack() as stack:
        silent = [
            stack.enter_context(socket.create_connection(("127.0.0.1", world.port), timeout=60))
            for _ in range(CONNECTIONS + UNPROVED_CONNECTIONS)
        ]
        with closing(CommandClient(world.port, SECRET)) as client:
            assert "go needs a list" in client.command({"go": 1})
        assert b'"error": "8 newer connections' in b"".join(iter(lambda: silent[0].recv(1000), b""))


def refused(port: int, data: bytes) -> bool:
    """Whether the server closes the connection."""
    with socket.create_connection(("127.0.0.1", port), timeout=60) as connection, suppress(ConnectionError):
        connection.sendall(data)
        while connection.recv(1000):
            pass
    return True


def test_targets_by_tcp_are_driven_in_turn_and_announced(world: World) -> None:
    world.onlooker.until(
        "its announcements are received", lambda: world.onlooker.node.count_publishers("/say")
    )
    client = CommandClient(world.port, SECRET)
    assert "the robot is stopped" in client.targets({"x": 0, "y": 0})
    world.targets.daemon.send("stopped", stopped=False)
    start = {"x": 0, "y": 0, "name": "start"}
    wait_for("a target is taken", lambda: client.targets(start) == "")
    client.until("done")

    def drive_again() -> None:
        # The announcements are lost until the node has discovered who listens.
        assert client.targets(start) == ""
        client.until("done")

    world.onlooker.until(
        "an announcement is received", lambda: world.onlooker.heard["/say"], meanwhile=drive_again
    )
    before = world.navigator.said().count("drives to 0 in map")
    targets = [{"x": 0, "y": 1, "name": "kitchen"}, {"x": 0, "y": 2, "heading": 1.0, "name": "hall"}]
    assert client.targets(*targets) == ""
    assert client.until("done")["of"] == 2
    wait_for("they came", lambda: world.navigator.said().count("drives to 0 in map") == before + 2)
    world.onlooker.until(
        "both arrivals are announced",
        lambda: (
            [each.data for each in world.onlooker.heard["/say"] if "start" not in each.data]
            == ["I have arrived at kitchen.", "I have arrived at hall."]
        ),
    )
    assert client.targets({"x": 99, "y": 0}) == ""
    assert client.until("ended")["why"] == "the navigator has refused it"
    assert client.targets({"x": 98, "y": 0}, {"x": 0, "y": 0}) == ""
    assert client.until("ended")["why"] == "the navigator gave up"
    assert "go needs a list" in client.command({"go": []})
    client.socket.close()


def waypoints(*xs: float, frame: str = "map", **more: int) -> FollowWaypoints.Goal:
    """A goal with these poses."""
    goal = FollowWaypoints.Goal(**more)
    for x in xs:
        pose = PoseStamped()
        pose.header.frame_id, pose.pose.position.x, pose.pose.position.y = (
            frame,
            float(x),
            float(len(goal.poses)),
        )
        goal.poses.append(pose)
    return goal


class Route:
    """A goal of follow_waypoints, and its result."""

    def __init__(self, world: World, client: ActionClient, goal: FollowWaypoints.Goal) -> None:
        self.current: list[int] = []
        self._world = world
        self.handle = self._done(client.send_goal_async(goal, lambda each: self._heard(each.feedback)))

    def _heard(self, feedback: Any) -> None:
        self.current.append(feedback.current_waypoint)

    def _done(self, future: Any) -> Any:
        self._world.onlooker.until("it answers", future.done)
        return future.result()

    def result(self) -> Any:
        """The result with the status, once the goal has ended."""
        return self._done(self.handle.get_result_async())

    def cancel(self) -> None:
        self._done(self.handle.cancel_goal_async())


@pytest.fixture
def route(world: World) -> Iterator[Any]:
    """Begins a route."""
    world.targets.daemon.send("stopped", stopped=False)
    client = ActionClient(world.onlooker.node, FollowWaypoints, "follow_waypoints")
    world.onlooker.until("the action is there", client.server_is_ready)

    def begin(goal: FollowWaypoints.Goal) -> Route:
        made = Route(world, client, goal)
        while not made.handle.accepted and goal.poses and not goal.number_of_loops:
            # Until the module knows that the robot is resumed, and has found the navigator.
            made = Route(world, client, goal)
        return made

    yield begin
    client.destroy()


def test_waypoints_are_driven_in_turn(world: World, route: Any) -> None:
    said = world.navigator.said().count("drives to 0 in map")
    made = route(waypoints(5, 0, 0, goal_index=1))
    ended = made.result()
    assert ended.status == GoalStatus.STATUS_SUCCEEDED
    assert list(ended.result.missed_waypoints) == []
    assert world.navigator.said().count("drives to 0 in map") == said + 2
    world.onlooker.until("the last feedback has come", lambda: made.current[-1:] == [2])


def test_waypoints_end_with_one_that_can_not_be_reached(world: World, route: Any) -> None:
    ended = route(waypoints(0, 98, 0)).result()
    assert ended.status == GoalStatus.STATUS_ABORTED
    assert [each.index for each in ended.result.missed_waypoints] == [1, 2]
    assert ended.result.error_code == FollowWaypoints.Result.TASK_EXECUTOR_FAILED


@pytest.mark.parametrize("by", ["client", "stop"])
def test_waypoints_are_cancelled(world: World, route: Any, by: str) -> None:
    x = {"client": 41, "stop": 42}[by]
    made = route(waypoints(x, 0))
    world.navigator.wait_to_say(f"drives to {x}")
    cancelled = world.navigator.said().count("cancelled")
    if by == "client":
        made.cancel()
    else:
        world.targets.daemon.send("stopped", stopped=True)
    expected = GoalStatus.STATUS_CANCELED if by == "client" else GoalStatus.STATUS_ABORTED
    assert made.result().status == expected
    wait_for("the navigator was cancelled", lambda: world.navigator.said().count("cancelled") > cancelled)


def test_waypoints_that_can_not_be_driven_are_refused(world: World, route: Any) -> None:
    first = route(waypoints(43))
    for goal in (waypoints(), waypoints(0, number_of_loops=1)):
        assert not route(goal).handle.accepted
    client = ActionClient(world.onlooker.node, FollowWaypoints, "follow_waypoints")
    world.onlooker.until("the action is there", client.server_is_ready)
    for goal in (waypoints(0, frame="odom"), waypoints(0, goal_index=1), waypoints(0)):
        assert not Route(world, client, goal).handle.accepted
    client.destroy()
    first.cancel()


@pytest.mark.parametrize(("end", "x"), [("stop", 21), ("disconnect", 22), ("cancel", 23), ("module", 24)])
def test_goal_under_way_is_cancelled_and_the_next_does_not_begin(world: World, end: str, x: int) -> None:
    world.targets.daemon.send("stopped", stopped=False)
    client = CommandClient(world.port, SECRET)
    cancelled = world.navigator.said().count("cancelled")
    wait_for("resumed", lambda: client.targets({"x": x, "y": 0}, {"x": 30, "y": 0}) == "")
    world.navigator.wait_to_say(f"drives to {x}")
    if end == "stop":
        world.targets.daemon.send("stopped", stopped=True)
        assert client.until("ended")["why"] == "the robot was stopped"
    elif end == "disconnect":
        client.socket.close()
    elif end == "cancel":
        assert client.command({"cancel": True}) == ""
        assert client.until("ended")["why"] == "cancelled by a client"
    else:
        world.targets.stop()
    wait_for("it is cancelled", lambda: world.navigator.said().count("cancelled") > cancelled)
    assert "drives to 30" not in world.navigator.said()
    client.socket.close()


def test_goal_of_a_killed_module_is_cancelled_by_the_next(world: World) -> None:
    def begin() -> PythonModule:
        made = world.module("robot_client.devices.target_follower:TargetFollower", "again").ready()
        made.daemon.send("stopped", stopped=False)
        return made

    first = begin()
    go = {"go": [{"x": 7, "y": 7}]}
    wait_for("it is taken", lambda: first.daemon.command(go) == "")
    wait_for("it drives", lambda: "drives to 7" in world.navigator.said())
    cancelled = world.navigator.said().count("cancelled")
    os.kill(first.pid(), signal.SIGKILL)
    first.ended()
    begin()
    wait_for("it is cancelled", lambda: world.navigator.said().count("cancelled") > cancelled)


def test_transforms_of_a_base_are_in_its_namespace() -> None:
    """As those of the simulated robot, and as the navigator reads them."""
    base = RobotNode(Mock())
    base.node = Mock()
    base.start()
    topics = {call.args[1] for call in base.node.create_publisher.call_args_list}
    assert topics == {"odom", "tf"}
