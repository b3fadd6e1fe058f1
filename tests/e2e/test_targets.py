"""Targets by TCP: the simulated robot drives to each and announces arrivals; a stop by the relay ends them."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, expect

from relay_server.common.freshness_tokens import HEADER
from robot_client.modules.log_ring import read
from tests.worlds.browser import checked_pages, open_session, portal, seen, take_control
from tests.worlds.command_client import CommandClient
from tests.worlds.http_requests import ask
from tests.worlds.navigating_robot import FAR, NavigatingRobot, pose, press_stop
from tests.worlds.processes import BIN
from tests.worlds.waiting import wait_for

ROUTE, ROUTE_TYPE = "/follow_waypoints", "nav2_msgs/action/FollowWaypoints"
SPEECH = [str(BIN / "switchboard-robot-service"), "speech", "--out"]
FAR_TARGET = {"x": FAR[0], "y": FAR[1], "name": "the far end"}
NEAR = [{"x": -1.4, "y": -0.2, "name": "kitchen"}, {"x": -1.6, "y": 0.0, "name": "hall"}]


def modules(folder: Path) -> str:
    return f"""
[[module]]
name = "speech"
command = {json.dumps([*SPEECH, str(folder / "said.wav")])}
ready_log = "READY"

[[module]]
name = "targets"
python = "robot_client.devices.target_follower:TargetFollower"
settings = {{ waypoints = "follow_waypoints" }}
after = ["navigator", "speech"]

[[module]]
name = "commands"
python = "robot_client.devices.command_server:CommandServer"
settings = {{ modules = ["targets"], port = 0 }}
"""


class World(NavigatingRobot):
    def __init__(self, folder: Path) -> None:
        super().__init__(folder, modules(folder))
        self.owner = self.relay.user("owner")
        self.relay.cli("right", "grant", "owner", "rover", "owner")

    def texts(self, module: str) -> list[str]:
        return [each.text for each in read(self.robot.state / "modules" / module / "log", most=10_000).lines]

    def client(self) -> CommandClient:
        """A client of the command server."""
        found = wait_for(
            "it listens", lambda: [each for each in self.texts("commands") if "listening" in each]
        )
        return CommandClient(int(found[-1].rpartition(":")[2]))

    def module_pid(self, name: str) -> int:
        listed = ask(
            self.relay.http_port, "GET", f"/api/v1/robots/rover/modules/{name}", token=self.owner
        ).json
        return int(listed["pid"])

    def x(self) -> float:
        """The robot's position, in metres from its start along its first heading."""
        with self.connect() as client:
            client.send(op="subscribe", topic="/odom", type="nav_msgs/msg/Odometry")
            return float(client.until(op="publish", topic="/odom")["msg"]["pose"]["pose"]["position"]["x"])

    def drive_off(self, client: CommandClient, *targets: dict[str, object]) -> None:
        """Sends targets, repeatedly while the robot stands: a part is still starting or was just resumed."""

        def driving() -> bool:
            if client.targets(*targets) == "":
                client.seen.clear()
            time.sleep(0.3)
            return self.robot.moving()

        wait_for("the robot drives", driving)
        self.until_moving()

    def drive_through(self, client: CommandClient, *targets: dict[str, object]) -> list[dict[str, Any]]:
        """Sends targets, repeatedly while they are refused as above; returns all feedback from the first to
        the last target.
        """
        seen: list[dict[str, Any]] = []

        def driven() -> bool:
            if client.targets(*targets) != "":
                return False
            seen.clear()
            while not seen or seen[-1]["state"] not in ("done", "ended"):
                seen.append(client.feedback())
            return bool(seen[-1]["state"] == "done")

        wait_for("the targets are reached", driven)
        return seen


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    made = World(tmp_path_factory.mktemp("targets"))
    wait_for("the module runs", lambda: "READY" in made.texts("targets"))
    yield made
    made.stop()


def test_targets_are_reached_in_turn_and_announced(world: World) -> None:
    with closing(world.client()) as client, world.connect() as listener:
        listener.send(op="subscribe", topic="/said", type="std_msgs/msg/String")
        seen = world.drive_through(client, *NEAR)
        arrived = [each["target"] for each in seen if each["state"] == "arrived"]
        assert (arrived, seen[-1]["of"]) == (["kitchen", "hall"], 2)
        said = [listener.until(op="publish", topic="/said")["msg"]["data"] for _ in NEAR]
        assert said == ["I have arrived at kitchen.", "I have arrived at hall."]
        # A goal through the relay is announced as well.
        with world.connect() as operator:
            world.take_control(operator)
            world.give(operator, (-1.4, -0.2))
            assert (
                listener.until(op="publish", topic="/said")["msg"]["data"] == "I have arrived at the target."
            )


LIST = {"poses": [pose(each["x"], each["y"]) for each in NEAR]}


def test_a_list_by_rosbridge_is_driven_and_announced_as_one_by_tcp(world: World) -> None:
    with world.connect() as operator, world.connect() as listener:
        listener.send(op="subscribe", topic="/said", type="std_msgs/msg/String")
        world.take_control(operator)
        sent = {
            "op": "send_action_goal",
            "action": ROUTE,
            "action_type": ROUTE_TYPE,
            "id": "l",
            "feedback": True,
        }

        def driven() -> bool:
            operator.send(**sent, args=LIST)
            began = operator.until(id="l")["op"] == "action_feedback"
            ended = operator.until(op="action_result", id="l") if began else {"status": 0}
            assert ended["status"] != 4 or ended["values"]["missed_waypoints"] == []
            return bool(ended["status"] == 4)

        # Refused while the module or the navigator has not seen the resume yet.
        wait_for("the list is driven", driven)
        said = [listener.until(op="publish", topic="/said")["msg"]["data"] for _ in NEAR]
        assert said == ["I have arrived at target 1.", "I have arrived at target 2."]


def test_a_list_by_http_needs_control_and_ends_with_a_stop(world: World) -> None:
    robot, port = "/api/v1/robots/rover", world.relay.http_port
    far = {"goal": {"poses": [pose(*FAR), *LIST["poses"]]}}
    known = f"{robot}/actions{ROUTE}"
    wait_for(
        "the relay knows the action", lambda: ask(port, "GET", known, token=world.operator).status == 200
    )
    refused = ask(port, "POST", f"{robot}/actions{ROUTE}", far, token=world.operator)
    assert refused.status in (403, 428), refused.body

    def driving() -> bool:
        taken = ask(port, "PUT", f"{robot}/control", token=world.operator)
        if taken.status == 200 and taken.json["success"]:
            headers = {HEADER: taken.headers[HEADER]}
            ask(port, "POST", f"{robot}/actions{ROUTE}", far, headers=headers, token=world.operator)
        time.sleep(0.3)
        return world.robot.moving()

    # Refused while a part is still starting or was just resumed.
    wait_for("the robot drives", driving)
    with world.relay.connect("rover", world.viewer) as viewer:
        press_stop(viewer)
    wait_for("the robot stands", lambda: not world.robot.moving())
    ask(port, "DELETE", f"{robot}/control", token=world.operator)
    with world.connect() as operator:
        world.take_control(operator)
        assert not world.robot.moving()


def test_a_phone_sends_the_robot_by_touch_and_through_a_list(world: World, browser: Browser) -> None:
    portal()
    expect.set_options(timeout=60_000)
    with world.connect() as listener:
        world.take_control(listener)
        listener.call("/relay/release_control")
        listener.send(op="subscribe", topic="/said", type="std_msgs/msg/String")
        with checked_pages(browser, f"http://127.0.0.1:{world.relay.http_port}", 60) as new_page:
            page = new_page(390, 844, has_touch=True)
            open_session(page, "operator", "correct horse")
            page.goto("/cockpit/rover")
            take_control(page)
            seen(page, "map-canvas").scroll_into_view_if_needed()
            expect(seen(page, "map-canvas")).to_have_attribute("data-map", "drawn")

            def driving() -> bool:
                """By a tap, repeated if the robot was just resumed and refused it."""
                if seen(page, "goal-set").is_visible() and not seen(page, "goal-cancel").is_visible():
                    seen(page, "goal-set").click()
                    box = seen(page, "map-canvas").bounding_box()
                    assert box is not None
                    page.touchscreen.tap(box["x"] + box["width"] * 0.6, box["y"] + box["height"] * 0.5)
                return world.robot.moving()

            wait_for("the robot drives", driving)
            world.until_moving()
            expect(seen(page, "goal-progress")).to_contain_text("m left")
            seen(page, "goal-cancel").click()
            expect(seen(page, "goal-words")).to_have_text("The goal is cancelled.")
            wait_for("the robot stands", lambda: not world.robot.moving())
            seen(page, "goal-set").click()
            seen(page, "goal-list").check()
            for each in NEAR:
                for field, value in (("x", each["x"]), ("y", each["y"]), ("degrees", 0)):
                    seen(page, f"goal-{field}").fill(str(value))
                seen(page, "goal-send").click()
            seen(page, "goal-drive-list").click()
            expect(seen(page, "goal-words")).to_have_text("The robot has arrived.")
        said = [listener.until(op="publish", topic="/said")["msg"]["data"] for _ in NEAR]
        assert said == ["I have arrived at target 1.", "I have arrived at target 2."]


def test_stop_through_the_relay_ends_the_list_and_refuses_more(world: World) -> None:
    with closing(world.client()) as client, world.relay.connect("rover", world.viewer) as viewer:
        world.drive_off(client, FAR_TARGET, *NEAR)
        press_stop(viewer)
        assert client.until("ended")["why"] in ("the robot was stopped", "it was cancelled")
        wait_for("the robot stands", lambda: not world.robot.moving())
        assert "the robot is stopped" in client.targets(*NEAR)
        with world.connect() as operator:
            world.take_control(operator)
        assert not world.robot.moving()
        world.drive_through(client, NEAR[0])


@pytest.mark.parametrize("lost", ["client", "server", "daemon", "navigator"])
def test_robot_stands_when_those_are_lost_that_could_end_its_goal(world: World, lost: str) -> None:
    with world.connect() as operator:
        world.take_control(operator)
    with closing(world.client()) as client:
        world.drive_off(client, FAR_TARGET)
        if lost == "client":
            client.close()
        elif lost == "server":
            servers = [each for each in world.texts("commands") if "listening" in each]
            os.kill(world.module_pid("commands"), signal.SIGKILL)
            wait_for(
                "it is back",
                lambda: len([each for each in world.texts("commands") if "listening" in each]) > len(servers),
            )
        elif lost == "daemon":
            world.robot.daemon.kill()
        else:
            world.kill_navigator()
        wait_for("the robot stands", lambda: not world.robot.moving())
        if lost == "navigator":
            # Another one runs soon, but does not have the goal.
            assert client.until("ended")["why"] == "the navigator has left"
    if lost == "daemon":
        world.robot.start_daemon()
        world.robot.wait_online()
    assert world.x() < FAR[0] - 0.5, "it stands because it has arrived"
    with closing(world.client()) as client:
        world.drive_through(client, NEAR[0])
