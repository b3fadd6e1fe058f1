"""Scans that ``avoidance`` reads and decides upon: one that is always there, and those of a simulated robot.

The first tells what the program itself takes. The second begins with the time that the robot writes into a scan before
it looks, and goes by ROS 2, daemon, relay and websocket into the same parts of the program, on the same clock.
"""

from __future__ import annotations

import json
import math
import time
from typing import Any

from bench.relay import Relay
from robot_client.apps.collision_avoidance import AvoidanceConfig, AvoidanceLink, CollisionAvoidance
from robot_client.apps.connection import RosbridgeConnection
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

SCAN, COMMAND = "/scan", "/cmd_vel"
RAYS = 360
PATIENCE = 60.0
"""Seconds for a scan of a robot that has ten a second."""

FIRST = 5
"""Scans that are not counted: with them the robot's daemon begins to send, and the program to decide."""


class Constant:
    """A websocket by which the same scan comes for ever."""

    def __init__(self) -> None:
        ranges = [1.4 + 0.1 * math.sin(number) for number in range(RAYS)]
        scan = {"ranges": ranges, "angle_min": -math.pi, "angle_increment": math.tau / RAYS}
        self._text = json.dumps({"op": "publish", "topic": SCAN, "msg": scan})

    def send(self, text: str) -> None:
        """Nobody listens."""

    def recv(self, timeout: float) -> str:
        """The scan."""
        return self._text


class Kept:
    """A websocket, and what came by it last: the program drops the time that is in a scan.

    :param connection: of the ``websockets`` library
    """

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self._last: str | bytes = ""

    def send(self, text: str) -> None:
        """Hand it on."""
        self._connection.send(text)

    def recv(self, timeout: float) -> str | bytes:
        """Hand it on, and keep it.

        :param timeout: seconds
        :raises TimeoutError: nothing came
        """
        self._last = self._connection.recv(timeout=timeout)
        return self._last

    def stamp(self) -> int:
        """The time in the header of the message that came last, Unix nanoseconds."""
        stamp = json.loads(self._last)["msg"]["header"]["stamp"]
        return int(stamp["sec"]) * 10**9 + int(stamp["nanosec"])


def program(connection: Any) -> tuple[AvoidanceLink, CollisionAvoidance]:
    """The parts of ``avoidance`` that read and decide, on a websocket."""
    return AvoidanceLink(RosbridgeConnection(connection), SCAN, COMMAND), CollisionAvoidance(
        AvoidanceConfig()
    )


def constant(runs: int) -> list[float]:
    """Milliseconds to read a scan that is there and to decide."""
    link, avoidance = program(Constant())
    took = []
    for _ in range(runs):
        began = time.perf_counter()
        scan = link.scan(1.0)
        assert scan is not None
        avoidance.update(scan)
        took.append((time.perf_counter() - began) * 1000)
    return took


def _topics(client: Client) -> set[str]:
    return set(client.call("/rosapi/topics")["values"]["topics"])


def of_a_robot(relay: Relay, robot: str, token: str, runs: int) -> list[float]:
    """Milliseconds from the time in a simulated robot's scan to the decision.

    :param token: of who may operate it
    """
    took = []
    with relay.connect(robot, token) as client:
        wait_for("its topics are known", lambda: {SCAN, COMMAND} <= _topics(client))
        kept = Kept(client.connection)
        link, avoidance = program(kept)
        for number in range(FIRST + runs):
            scan = link.scan(PATIENCE)
            assert scan is not None, f"no scan within {PATIENCE:g} s"
            avoidance.update(scan)
            decided = time.time_ns()
            if number >= FIRST:
                took.append((decided - kept.stamp()) / 1e6)
    return took
