"""A robot that gets another address while clients are connected, with a real relay and ROS 2."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path

from tests.worlds.processes import Process, ros_environment
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.ros_peers import speakers
from tests.worlds.waiting import wait_for

DAEMON = Path(__file__).parent / "clients" / "moved_daemon.py"
STRING = "std_msgs/msg/String"
TWIST = "geometry_msgs/msg/Twist"


class MovedRobot(Robot):
    """Its daemon reads the machine's addresses from a file."""

    def has_addresses(self, *addresses: str) -> None:
        self.folder.joinpath("address").write_text(" ".join(addresses))

    def _daemon(self) -> Process:
        self.has_addresses("10.0.0.5")
        command = [sys.executable, str(DAEMON), str(self.folder / "address")]
        command += ["run", "--state", str(self.state)]
        return Process(command, self.folder, "daemon", ros_environment(self.domain))


def test_robot_with_another_address_finds_new_nodes_and_keeps_its_clients(tmp_path: Path) -> None:
    """One more, as by a VPN. The client does nothing: its topics go on, latched ones come once, and it drives."""
    relay = Relay(tmp_path)
    with ExitStack() as stack:
        stack.callback(relay.stop)
        robot = MovedRobot(relay, "rover")
        stack.callback(robot.stop)
        driver = relay.user("driver")
        relay.cli("right", "grant", "driver", "rover", "operator")
        nodes = stack.enter_context(speakers(robot.domain))
        nodes.publish("old", "/kept", "kept")
        client = stack.enter_context(relay.connect("rover", driver))
        for topic in ("/kept", "/fresh"):
            client.send(op="subscribe", topic=topic, type=STRING)
        client.send(op="advertise", topic="/cmd_vel", type=TWIST)
        assert client.until(op="publish", topic="/kept")["msg"]["data"] == "kept"
        robot.has_addresses("10.0.0.5", "10.9.0.7")
        wait_for("new nodes", lambda: "ROS nodes were made again" in robot.daemon.log.read_text())
        nodes.publish("new", "/fresh", "fresh")
        nodes.publish("old", "/kept", "kept too")
        came = [client.until(op="publish")["msg"]["data"] for _ in range(2)]
        assert sorted(came) == ["fresh", "kept too"]

        def moves() -> bool:
            client.send(op="publish", topic="/cmd_vel", msg={"linear": {"x": 0.2}})
            return robot.moving()

        wait_for("it moves", moves)
        client.send(op="publish", topic="/cmd_vel", msg={})
        wait_for("it stands still", lambda: not robot.moving())
