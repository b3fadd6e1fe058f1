"""A simulated robot with a navigator as its module, at a relay: goals by rosbridge, and the body's motion."""

from __future__ import annotations

import json
import math
import signal
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil

from tests.worlds.processes import BIN
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

ACTION = "/navigate_to_pose"
TYPE = "nav2_msgs/action/NavigateToPose"
NAVIGATOR = (str(BIN / "switchboard-robot-service"), "navigator")
FAR = (4.2, 0.1)
"""A goal some fifteen seconds from the start of the default world, straight ahead at first."""


def pose(x: float, y: float, heading: float = 0.0, frame: str = "map") -> dict[str, Any]:
    """A geometry_msgs/PoseStamped."""
    turn = {"z": math.sin(heading / 2), "w": math.cos(heading / 2)}
    return {"header": {"frame_id": frame}, "pose": {"position": {"x": x, "y": y}, "orientation": turn}}


class NavigatingRobot:
    """The robot ``rover`` with an operator and a viewer.

    :param modules: settings of further modules
    :param navigator: options of the navigator
    """

    def __init__(self, folder: Path, modules: str = "", navigator: tuple[str, ...] = ()) -> None:
        self._killed: set[int] = set()
        self._command = [*NAVIGATOR, *navigator]
        self.relay = Relay(folder, "--requests-per-second", "0")
        try:
            self.robot = Robot(
                self.relay,
                "rover",
                settings=self._settings() + modules,
                sim_options=("--command-timeout", "0.4"),
            )
        except BaseException:
            self.relay.stop()
            raise
        self.operator, self.viewer = self.relay.user("operator"), self.relay.user("viewer")
        self.relay.cli("right", "grant", "operator", "rover", "operator")
        self.relay.cli("right", "grant", "viewer", "rover", "viewer")

    def _settings(self) -> str:
        return f"""
[[module]]
name = "navigator"
command = {json.dumps(self._command)}
ready_log = "READY"
restarts = 1000
backoff_s = 0.1
"""

    def stop(self) -> None:
        self.robot.stop()
        self.relay.stop()

    def connect(self) -> Client:
        """An operator that acquires control by sending a goal."""
        client = self.relay.connect("rover", self.operator)
        client.send(op="set_level", level="error")
        wait_for("the relay knows the action", lambda: ACTION in self._actions(client))
        return client

    def _actions(self, client: Client) -> list[str]:
        return list(client.call("/rosapi/action_servers")["values"]["action_servers"])

    def take_control(self, client: Client) -> None:
        """Takes control and resets: the robot is resumed and at its start."""
        wait_for("control", lambda: client.call("/relay/take_control")["values"]["success"])
        wait_for("it is resumed", lambda: client.call("/relay/resume")["result"])
        wait_for("it is at its start", lambda: client.call("/reset")["result"])

    def give(
        self, client: Client, goal: tuple[float, float] = FAR, id: str = "g", heading: float = 0.0
    ) -> list[dict[str, Any]]:
        """Sends a goal, repeatedly while it is refused because the robot was just resumed.

        :param heading: at the goal, radians
        :returns: messages up to the first feedback
        """
        came: list[dict[str, Any]] = []

        def accepted() -> bool:
            client.send(
                op="send_action_goal",
                action=ACTION,
                id=id,
                feedback=True,
                args={"pose": pose(*goal, heading)},
            )
            while True:
                message = client.receive()
                came.append(message)
                if message.get("id") == id and message["op"] == "action_feedback":
                    return True
                if message.get("id") == id and message["op"] == "action_result":
                    return False

        wait_for("the goal is accepted", accepted)
        return came

    def until_moving(self) -> None:
        """Waits until the body moves at some speed."""

        def fast() -> bool:
            last = self.robot.events("command")[-1:]
            return self.robot.moving() and bool(last) and last[0]["v"] > 0.2

        wait_for("the robot drives", fast)

    def standstill_after(self, moment: int) -> float:
        """Milliseconds from a moment (monotonic ns), at which the body moved, until it stood."""
        wait_for("the robot stands", lambda: not self.robot.moving())
        stops = [each["t"] for each in self.robot.events("standstill", moment)]
        assert stops, "the robot stood before that moment, so nothing is measured"
        return (stops[-1] - moment) / 1e6

    def moved_since(self, moment: int) -> list[dict[str, Any]]:
        """Commands after a moment that were not zero."""
        return [each for each in self.robot.events("command", moment) if each["v"] or each["w"]]

    def navigator(self) -> psutil.Process:
        """The navigator's process."""
        return wait_for("a navigator runs", self._find_navigator)  # type: ignore[no-any-return]

    def _find_navigator(self) -> psutil.Process | None:
        for each in psutil.process_iter(["cmdline", "environ"]):
            with suppress(psutil.Error):
                command = each.info["cmdline"] or []
                mine = (each.info["environ"] or {}).get("ROS_DOMAIN_ID") == str(self.robot.domain)
                if mine and command[-len(self._command) :] == self._command and "python" in command[0]:
                    return each
        return None

    def kill_navigator(self) -> int:
        """By SIGKILL; returns the time before, monotonic ns."""
        navigator = self.navigator()
        self._killed.add(navigator.pid)
        began = time.monotonic_ns()
        navigator.send_signal(signal.SIGKILL)
        return began

    def wait_navigator(self) -> None:
        """Waits until a navigator other than the killed ones is ready.

        A goal sent before waits for the answer of the dead one, which DDS drops after 20 s.
        """
        wait_for("another navigator runs", lambda: self.navigator().pid not in self._killed)
        wait_for("it is ready", self._navigator_is_ready)

    def _navigator_is_ready(self) -> bool:
        modules = self.relay.cli("module", "list", "rover")["modules"]
        return [each["state"] for each in modules] == ["running"]


def press_stop(viewer: Client) -> int:
    """Stops the robot and waits for the confirmation; returns the time before, monotonic ns."""
    began = time.monotonic_ns()
    answer = viewer.call("/relay/stop")
    assert answer["result"], answer
    return began
