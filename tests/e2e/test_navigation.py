"""Goals of the simulated robot through the relay: its navigator is a module, and obeys stops as Nav2 does."""

from __future__ import annotations

import json
import os
import signal
import struct
import time
from collections.abc import Iterator
from typing import Any

import pytest
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from relay_server.common.freshness_tokens import HEADER
from tests.worlds.http_requests import Answer, ask
from tests.worlds.navigating_robot import ACTION, FAR, NavigatingRobot, pose, press_stop
from tests.worlds.sync_client import Client
from tests.worlds.waiting import PATIENCE, freeze, wait_for

GRID = "nav_msgs/msg/OccupancyGrid"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[NavigatingRobot]:
    made = NavigatingRobot(tmp_path_factory.mktemp("navigation"))
    yield made
    made.stop()


@pytest.fixture
def client(world: NavigatingRobot) -> Iterator[Client]:
    """An operator with control of a robot at its start, without a goal."""
    with world.connect() as client:
        world.take_control(client)
        yield client


def result(client: Client, id: str = "g") -> dict[str, Any]:
    return client.until(op="action_result", id=id)


def drive_by_goal_pose(world: NavigatingRobot, client: Client) -> None:
    client.send(op="advertise", topic="/goal_pose", type="geometry_msgs/msg/PoseStamped")

    def driving() -> bool:
        client.send(op="publish", topic="/goal_pose", msg=pose(4.2, 0.1))
        time.sleep(0.3)
        return world.robot.moving()

    wait_for("the robot drives", driving)


def test_goal_with_map_path_and_costmaps(world: NavigatingRobot, client: Client) -> None:
    topics = {"/map": GRID, "/local_costmap/costmap": GRID, "/global_costmap/costmap": GRID}
    for topic, type in topics.items():
        client.send(op="subscribe", id=topic, topic=topic, type=type)
        grid = client.until(op="publish", topic=topic)["msg"]
        assert grid["header"]["frame_id"] == "map"
        assert len(grid["data"]) == grid["info"]["width"] * grid["info"]["height"]
    client.send(op="subscribe", topic="/plan", type="nav_msgs/msg/Path")
    came = world.give(client, (-1.4, -0.2))
    assert 0.0 < came[-1]["values"]["distance_remaining"] < 1.5
    plans = [each for each in came if each.get("topic") == "/plan"]
    path = (plans[-1] if plans else client.until(op="publish", topic="/plan"))["msg"]["poses"]
    assert path[-1]["pose"]["position"]["x"] == pytest.approx(-1.4)
    end = result(client)
    assert (end["status"], end["result"], end["values"]["error_code"]) == (4, True, 0)
    for topic in topics:
        client.send(op="unsubscribe", id=topic, topic=topic)


def test_goal_behind_the_table_is_reached_without_a_collision(world: NavigatingRobot, client: Client) -> None:
    began = time.monotonic_ns()
    # From there the straight path leads under the plate, which is on no map and seen by the depth camera alone.
    for goal in (FAR, (4.2, -2.1)):
        world.give(client, goal)
        end = result(client)
        assert (end["status"], end["result"], end["values"]["error_code"]) == (4, True, 0)
    assert world.robot.events("bump", began) == []


def test_stop_ends_goals_and_refuses_new_ones(world: NavigatingRobot, client: Client) -> None:
    world.give(client)
    world.until_moving()
    with world.relay.connect("rover", world.viewer) as viewer:
        press_stop(viewer)
    confirmed = time.monotonic_ns()
    assert result(client)["status"] == 5
    wait_for("the robot stands", lambda: not world.robot.moving())
    client.send(op="send_action_goal", action=ACTION, id="h", args={"pose": pose(0.0, 0.0)})
    assert "stopped" in result(client, "h")["values"]
    client.send(op="advertise", topic="/goal_pose", type="geometry_msgs/msg/PoseStamped")
    client.send(op="publish", topic="/goal_pose", msg=pose(0.0, 0.0))
    time.sleep(1.0)  # no motion within
    assert world.moved_since(confirmed) == []


def test_frozen_navigator_moves_nothing_when_it_is_thawed_after_a_stop(
    world: NavigatingRobot, client: Client
) -> None:
    world.give(client)
    world.until_moving()
    navigator = world.navigator()
    freeze(navigator.pid)
    with world.relay.connect("rover", world.viewer) as viewer:
        press_stop(viewer)
    wait_for("the robot stands", lambda: not world.robot.moving())
    thawed = time.monotonic_ns()
    os.kill(navigator.pid, signal.SIGCONT)
    result(client)
    time.sleep(0.5)  # no motion within
    assert world.moved_since(thawed) == []


def test_killed_navigator_stops_the_robot_and_comes_back(world: NavigatingRobot, client: Client) -> None:
    world.give(client)
    world.until_moving()
    world.kill_navigator()
    wait_for("the robot stands", lambda: not world.robot.moving())
    world.wait_navigator()
    drive_by_goal_pose(world, client)


def test_goal_pose_is_a_goal_that_a_stop_ends(world: NavigatingRobot, client: Client) -> None:
    drive_by_goal_pose(world, client)
    with world.relay.connect("rover", world.viewer) as viewer:
        press_stop(viewer)
    wait_for("the robot stands", lambda: not world.robot.moving())
    stood = time.monotonic_ns()
    time.sleep(0.5)  # no motion within
    assert world.moved_since(stood) == []


@pytest.mark.parametrize("encoding", ["cdr", "json"])
def test_a_goal_pose_between_advertise_and_unadvertise_reaches_the_navigator(
    world: NavigatingRobot, encoding: str
) -> None:
    """A Foxglove client sends all three at once. The robot is free, so the goal acquires control."""
    with world.connect() as client:
        world.take_control(client)
        assert client.call("/relay/release_control")["values"]["success"]
    goal = pose(*FAR)
    body = json.dumps(goal).encode() if encoding == "json" else serialized_pose(goal)
    channel = {
        "id": 1,
        "topic": "/goal_pose",
        "encoding": encoding,
        "schemaName": "geometry_msgs/PoseStamped",
    }
    began = time.monotonic_ns()
    with connect(
        world.relay.url("rover"),
        additional_headers={"Authorization": f"Bearer {world.operator}"},
        subprotocols=[Subprotocol("foxglove.sdk.v1")],
        open_timeout=PATIENCE,
        max_queue=None,
    ) as foxglove:

        def driving() -> bool:
            """A busy machine may drop a goal as too old."""
            foxglove.send(json.dumps({"op": "advertise", "channels": [channel]}))
            foxglove.send(struct.pack("<BI", 1, 1) + body)
            foxglove.send(json.dumps({"op": "unadvertise", "channelIds": [1]}))
            time.sleep(0.5)
            return bool(world.moved_since(began))

        wait_for("the robot drives", driving)


def serialized_pose(goal: dict[str, Any]) -> bytes:
    """In CDR, as rclpy writes it."""
    from geometry_msgs.msg import PoseStamped
    from rclpy.serialization import serialize_message

    found = PoseStamped()
    found.header.frame_id = goal["header"]["frame_id"]
    for name, value in goal["pose"]["position"].items():
        setattr(found.pose.position, name, value)
    for name, value in goal["pose"]["orientation"].items():
        setattr(found.pose.orientation, name, value)
    return bytes(serialize_message(found))


def test_goal_over_http(world: NavigatingRobot) -> None:
    with world.connect() as client:
        world.take_control(client)
    done = wait_for("the goal is accepted", lambda: goal_by_http(world))
    assert (done.status, done.json["state"]) == (200, "succeeded"), done.body
    assert done.json["result"]["error_code"] == 0
    ask(world.relay.http_port, "DELETE", "/api/v1/robots/rover/control", token=world.operator)


def goal_by_http(world: NavigatingRobot) -> Answer | None:
    """A goal that has ended; None if it was refused because control is not free or the robot was just
    resumed.
    """
    robot, port = "/api/v1/robots/rover", world.relay.http_port
    taken = ask(port, "PUT", f"{robot}/control", token=world.operator)
    if taken.status != 200 or not taken.json["success"]:
        return None
    body = {"goal": {"pose": pose(-1.4, -0.2)}}
    headers = {HEADER: taken.headers[HEADER], "Prefer": "wait=60"}
    done = ask(port, "POST", f"{robot}/actions{ACTION}", body, headers=headers, token=world.operator)
    refused = done.status >= 400 or done.json["state"] == "refused"
    return None if refused else done


def test_without_control_a_goal_is_refused(world: NavigatingRobot) -> None:
    # Another user, since the same one has control by any of their connections.
    second = world.relay.user("second")
    world.relay.cli("right", "grant", "second", "rover", "operator")
    with world.connect() as holder, world.relay.connect("rover", second) as other:
        world.take_control(holder)
        other.send(op="set_level", level="error")
        other.send(op="send_action_goal", action=ACTION, id="g", args={"pose": pose(0.0, 0.0)})
        ended = result(other)
        assert ended["result"] is False
        assert "is controlled by operator" in ended["values"]
