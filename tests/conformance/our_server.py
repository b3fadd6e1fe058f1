"""The relay and a daemon with the fixture node and ROS 2, for the suite without ``--url``."""

from __future__ import annotations

import sys
from pathlib import Path

from conformance_suite import Server

from tests.worlds.processes import BIN, Process, ros_environment
from tests.worlds.relay_process import Relay
from tests.worlds.ros_domains import free_domain
from tests.worlds.waiting import wait_for

ROBOT = "conformance"


class OurServer:
    """A relay with one enrolled robot, and an owner's token."""

    def __init__(self, folder: Path) -> None:
        self._running: list[Process | Relay] = []
        try:
            self.server = self._start(folder)
        except BaseException:
            self.stop()
            raise

    def _start(self, folder: Path) -> Server:
        environment = ros_environment(free_domain())
        node = Process(
            [sys.executable, str(Path(__file__).with_name("fixture_node.py"))], folder, "node", environment
        )
        self._running.append(node)
        relay = Relay(folder)
        self._running.append(relay)
        token = relay.user("owner")
        state = folder / "state"
        code = relay.cli("robot", "add", ROBOT)["enrolment_code"]
        relay.cli("right", "grant", "owner", ROBOT, "owner")
        enroll = [str(BIN / "switchboard-robot"), "enroll", "--relay", f"127.0.0.1:{relay.robots_port}"]
        enroll += ["--robot", ROBOT, "--code", code, "--state", str(state)]
        enrolment = Process(enroll, folder, "enroll", environment)
        assert enrolment.popen.wait(60) == 0, enrolment.log.read_text()
        node.wait_to_say("READY")
        daemon = [str(BIN / "switchboard-robot"), "run", "--state", str(state)]
        self._running.append(Process(daemon, folder, "daemon", environment))
        wait_for("the robot is online", lambda: relay.state_of(ROBOT) != "offline")
        server = Server(relay.url(ROBOT), token)
        with server.connect() as client:
            known = lambda: "/conformance/do" in client.values("/rosapi/services")["services"]  # noqa: E731
            wait_for("the robot's graph is known", known)
        return server

    def stop(self) -> None:
        """Ends everything, last one first."""
        for each in reversed(self._running):
            each.stop()
