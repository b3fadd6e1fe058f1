"""A robot whose address changes, in a network namespace of its own: run by ``test_moved_network.py`` there.

The robot's machine has one interface. Its address changes while the daemon and the robot's nodes run, and then another
node starts. It prints what the relay shows.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from tests.worlds import robot_process
from tests.worlds.processes import Process
from tests.worlds.relay_process import Relay
from tests.worlds.sync_client import Client
from tests.worlds.waiting import PATIENCE, wait_for

NODE = """
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("late")
publisher = node.create_publisher(String, "/late", 1)
print("READY", flush=True)
rclpy.spin(node)
"""
BEFORE, AFTER = "10.9.0.1/24", "10.9.0.7/24"


def ip(*words: str) -> None:
    """Run the command ``ip``."""
    subprocess.run(["ip", *words], check=True)


def environment(domain: int) -> dict[str, str]:
    """Nodes find each other by the interface, and not by the loopback interface; nobody else is in this network."""
    return {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}


def topics(client: Client) -> list[str]:
    """Topics of the robot, as the relay lists them."""
    return list(client.call("/rosapi/topics")["values"]["topics"])


def main(folder: Path) -> None:
    """See the module."""
    robot_process.ros_environment = environment
    ip("link", "set", "lo", "up")
    ip("link", "add", "robot0", "type", "veth", "peer", "name", "robot1")
    for name in ("robot0", "robot1"):
        ip("link", "set", name, "up")
    ip("address", "add", BEFORE, "dev", "robot0")
    ip("route", "add", "224.0.0.0/4", "dev", "robot0")
    relay = Relay(folder)
    robot = robot_process.Robot(relay, "rover")
    late = None
    try:
        relay.user("ann", admin=True)
        with relay.connect("rover", relay.token("ann")) as client:
            wait_for("the robot's topics are known", lambda: "/odom" in topics(client))
            ip("address", "delete", BEFORE, "dev", "robot0")
            ip("address", "add", AFTER, "dev", "robot0")
            ip("route", "replace", "224.0.0.0/4", "dev", "robot0")
            wait_for("the daemon notices it", lambda: "10.9.0.7" in robot.daemon.log.read_text())
            late = Process([sys.executable, "-c", NODE], folder, "late", environment(robot.domain))
            late.wait_to_say("READY")
            client.send(op="subscribe", topic="/odom")
            client.until(op="publish", topic="/odom")
            print("THE FORMER NODES WORK", flush=True)
            robot.sim.stop()
            # A node whose farewell is lost is taken for alive for 20 s and more.
            made_again = "the daemon's ROS nodes were made again"
            wait_for(made_again, lambda: made_again in robot.daemon.log.read_text(), 3 * PATIENCE)
        with relay.connect("rover", relay.token("ann")) as client:
            wait_for("the new node is found", lambda: "/late" in topics(client))
        print("THE NEW NODE IS FOUND", flush=True)
    except AssertionError as error:
        raise AssertionError(f"{error}\n{robot.daemon.explanation()}") from None
    finally:
        if late is not None:
            late.stop()
        robot.stop()
        relay.stop()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
