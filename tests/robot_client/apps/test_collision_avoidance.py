"""Collision avoidance: the force of a scan, its effect in the simulated robot, and the messages to the relay."""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from robot_client.apps.collision_avoidance import (
    COMMANDS,
    SCAN_TIMEOUT,
    SCANS,
    WALL_FORCE,
    AvoidanceConfig,
    AvoidancePhase,
    AvoidanceProgram,
    CollisionAvoidance,
    ScanReading,
    main,
    repulsion,
)
from robot_client.apps.connection import Lost, Refused, RosbridgeConnection
from robot_client.apps.driver import VelocityCommand
from robot_client.sim.robot import SCAN_BEGIN, SCAN_RAYS, SCAN_STEP, MotionRecorder, SimRobot
from robot_client.sim.world import WORLDS
from tests.worlds.memory_socket import Socket

STEP = 0.02
SUPPRESS = "/relay/suppress"
LEANING = VelocityCommand(0.25, -0.15)
"""A circle that the room is too small for."""


def wall(distance: float, direction: float) -> ScanReading:
    """An endless flat wall.

    :param distance: metres
    :param direction: radians from straight ahead to the nearest point
    """
    ranges = []
    for number in range(SCAN_RAYS):
        facing = math.cos(SCAN_BEGIN + number * SCAN_STEP - direction)
        ranges.append(distance / facing if facing > 1e-3 else math.inf)
    return ScanReading(ranges, SCAN_BEGIN, SCAN_STEP)


@pytest.mark.parametrize("direction", [0.0, 1.0, -2.0, math.pi])
def test_a_wall_pushes_away_from_itself(direction: float) -> None:
    """Perpendicularly, with the inverse square of the distance."""
    force = repulsion(wall(0.5, direction))
    assert force.strength == pytest.approx(WALL_FORCE / 0.5**2, rel=0.02)
    assert (
        math.atan2(force.left, force.ahead)
        == pytest.approx(math.remainder(direction + math.pi, math.tau), abs=0.01)
        or abs(abs(math.atan2(force.left, force.ahead)) - math.pi) < 0.01
    )


def test_unmatched_change_pushes_nothing() -> None:
    """Nor do distant obstacles and invalid numbers."""
    for nothing in (math.inf, math.nan, None, 0.0, -1.0, 2.0):
        assert repulsion(ScanReading([nothing] * 8, 0.0, 0.5)).strength == 0.0


def test_it_watches_until_something_ahead_is_near() -> None:
    """Obstacles beside and behind do not count."""
    avoidance = CollisionAvoidance(AvoidanceConfig(near=0.5))
    assert avoidance.update(wall(0.55, 0.0)) is None
    assert avoidance.update(wall(0.3, math.pi)) is None
    assert avoidance.update(wall(0.3, math.radians(100))) is None
    assert avoidance.update(wall(0.45, 0.0)) is not None


def test_it_turns_to_the_side_that_is_free() -> None:
    """It keeps turning in that direction until it faces away, then leaves, then releases."""
    avoidance = CollisionAvoidance(AvoidanceConfig(near=0.5, clear=0.6, speed=0.2, turn=1.0))
    assert avoidance.update(wall(0.4, math.radians(30))) == VelocityCommand(0.0, -1.0)
    assert avoidance.update(wall(0.4, math.radians(-5))) == VelocityCommand(0.0, -1.0)
    assert avoidance.update(wall(0.4, math.radians(130))) == VelocityCommand(0.2, 0.0)
    assert avoidance.phase is AvoidancePhase.LEAVING
    assert avoidance.update(wall(0.4, math.radians(20))) == VelocityCommand(0.0, -1.0)
    assert avoidance.update(wall(0.65, math.radians(130))) is None


class Drive:
    """The simulated robot, a driver with a constant command, and the program."""

    def __init__(self) -> None:
        self.now = 0.0
        self.record = io.BytesIO()
        self.robot = SimRobot(WORLDS["room"](), MotionRecorder(self.record), 1, lambda: self.now)
        self.avoidance: CollisionAvoidance | None = CollisionAvoidance(AvoidanceConfig())
        self.wanted: VelocityCommand | None = None
        self.distances: list[float] = []
        self.taken = 0

    def run(self, seconds: float, driver: VelocityCommand) -> None:
        for number in range(round(seconds / STEP)):
            if number % 5 == 0:
                before, self.wanted = self.wanted, None
                if self.avoidance is not None:
                    ranges: Any = self.robot.scan()
                    self.wanted = self.avoidance.update(ScanReading(ranges.tolist(), SCAN_BEGIN, SCAN_STEP))
                self.taken += self.wanted is not None and before is None
                self.robot.command(*(self.wanted or driver))
            self.now += STEP
            self.robot.step(STEP)
            pose = self.robot.body.pose
            self.distances.append(self.robot.world.nearest(pose.x, pose.y).distance)

    @property
    def bumps(self) -> int:
        return self.record.getvalue().count(b'"bump"')


def test_a_driver_without_avoidance_collides() -> None:
    """This shows that the next tests are meaningful."""
    drive = Drive()
    drive.avoidance = None
    drive.run(20, VelocityCommand(0.3, 0.0))
    assert drive.bumps == 1


def test_straight_at_a_wall_it_turns_the_robot_away_and_gives_it_back() -> None:
    """Repeatedly; the driver moves the robot most of the time."""
    drive = Drive()
    drive.run(60, VelocityCommand(0.3, 0.0))
    assert drive.bumps == 0
    assert drive.taken >= 3
    assert drive.wanted is None or drive.avoidance is not None
    assert drive.robot.body.travelled > 8


def test_leaning_on_a_wall_the_robot_follows_it() -> None:
    """The driver constantly turns right; at the wall this moves the robot along it, all around the room."""
    drive = Drive()
    drive.run(30, LEANING)
    drive.distances.clear()
    places = []
    for _ in range(200):
        drive.run(0.5, LEANING)
        places.append(drive.robot.body.pose[:2])
    assert drive.bumps == 0
    assert np.ptp(places, axis=0) == pytest.approx([5.0, 3.0], abs=0.2)
    assert min(drive.distances) > 0.4
    assert np.quantile(drive.distances, 0.95) < 0.9


# --- over the relay ----------------------------------------------------------------------------------------


class Scanner(Socket):
    """A websocket in memory that delivers scans."""

    def scan(self, scan: ScanReading) -> None:
        ranges = [each if each is not None and math.isfinite(each) else None for each in scan.ranges]
        message = {"ranges": ranges, "angle_min": scan.begin, "angle_increment": scan.step}
        self.coming.append({"op": "publish", "topic": "/scan", "msg": message})


class Scene:
    def __init__(self) -> None:
        self.now = 100.0
        self.reported: list[str] = []
        self.program = AvoidanceProgram(
            "/scan", "/cmd_vel", CollisionAvoidance(AvoidanceConfig()), self.reported.append, lambda: self.now
        )
        self.connect()

    def connect(self) -> None:
        """Makes a new connection."""
        self.socket = Scanner()
        self.socket.reached = True
        self.program.begin(RosbridgeConnection(self.socket))
        self.socket.sent.clear()

    def step(self, scan: ScanReading | None = None, seconds: float = 0.11) -> list[dict[str, Any]]:
        """One step of the program; returns the sent messages."""
        self.now += seconds
        if scan is not None:
            self.socket.scan(scan)
        self.socket.sent.clear()
        self.program.step()
        return list(self.socket.sent)


def suppressed(said: list[dict[str, Any]]) -> list[int]:
    """The duration of each suppression."""
    return [each["args"]["ms"] for each in said if each.get("service") == "/relay/suppress"]


def speeds(said: list[dict[str, Any]]) -> list[float]:
    return [each["msg"]["angular"]["z"] for each in said if each["op"] == "publish"]


def test_it_commands_only_when_the_robot_obeys_it() -> None:
    """First the suppression, then its confirmation, then the first command; it is renewed each time."""
    scene = Scene()
    assert scene.step(wall(1.0, 0.0)) == []
    said = scene.step(wall(0.4, 0.1))
    assert (suppressed(said), speeds(said)) == ([200], [])
    scene.socket.answer(service=SUPPRESS)
    said = scene.step(wall(0.4, 0.1))
    assert (suppressed(said), speeds(said)) == ([200], [-1.2])


def test_it_gives_the_robot_back_with_zero() -> None:
    """No message follows."""
    scene = Scene()
    scene.step(wall(0.4, 0.1))
    scene.socket.answer(service=SUPPRESS)
    scene.step()
    said = scene.step(wall(1.0, 0.0))
    assert (suppressed(said), speeds(said)) == ([0], [0.0])
    scene.socket.answer(service=SUPPRESS)
    assert scene.step(wall(1.0, 0.0)) == []
    assert scene.step() == []


def test_blind_client_releases_control() -> None:
    """A silent scanner ends it; until then suppressions are short."""
    scene = Scene()
    scene.step(wall(0.4, 0.1))
    scene.socket.answer(service=SUPPRESS)
    assert suppressed(scene.step()) == [200]
    said = scene.step(seconds=SCAN_TIMEOUT)
    assert (suppressed(said), speeds(said)) == ([0], [0.0])


def test_an_answer_that_comes_late_gives_nothing() -> None:
    """The robot was released meanwhile, so old scans must not move it."""
    scene = Scene()
    scene.step(wall(0.4, 0.1))
    scene.socket.answer(service=SUPPRESS)
    late = scene.socket.coming.pop()
    scene.step(wall(1.0, 0.0))
    scene.socket.coming.append(late)
    assert scene.step() == []
    said = scene.step(wall(0.4, 0.1))
    assert (suppressed(said), speeds(said)) == ([200], [])


def test_a_relay_that_refuses_is_believed() -> None:
    """With its reason."""
    scene = Scene()
    scene.step(wall(0.4, 0.1))
    scene.socket.answer(result=False, service=SUPPRESS)
    with pytest.raises(Refused, match="you may not"):
        scene.step()


def test_a_command_that_came_too_late_ends_nothing() -> None:
    """The robot may be offline; a command that was refused may be sent again later."""
    scene = Scene()
    scene.socket.coming.append({"op": "status", "level": "error", "msg": "the robot is offline"})
    assert scene.step() == []
    assert suppressed(scene.step(wall(0.4, 0.1))) == [200]


@pytest.mark.parametrize("id", [SCANS, COMMANDS])
def test_missing_right_to_subscribe_or_command_is_reported(id: str) -> None:
    """With the relay's reason."""
    scene = Scene()
    scene.socket.coming.append({"op": "status", "id": id, "level": "error", "msg": "no right to it"})
    with pytest.raises(Refused, match="no right"):
        scene.step()


def test_a_relay_that_is_silent_is_asked_and_then_given_up() -> None:
    """A network may drop everything; any answer is enough to go on."""
    scene = Scene()
    for _ in range(100):
        scene.step(seconds=0.5)
    scene.socket.reached = False
    with pytest.raises(Lost, match="6 s"):
        for _ in range(20):
            scene.step(seconds=0.5)


def test_a_new_connection_starts_from_nothing() -> None:
    """Neither the suppression nor the distances of the former connection count."""
    scene = Scene()
    scene.step(wall(0.4, 0.1))
    scene.socket.answer(service=SUPPRESS)
    scene.step(wall(0.4, 0.1))
    scene.program.lost("the cable", 1.0)
    scene.connect()
    assert scene.step() == []
    said = scene.step(wall(0.4, 0.1))
    assert (suppressed(said), speeds(said)) == ([200], [])
    assert scene.reported == [
        "READY",
        "too near: turning away",
        "the cable; again in 1.0 s",
        "READY",
        "too near: turning away",
    ]


@pytest.mark.parametrize(
    ("arguments", "token", "words"),
    [
        (["ws://127.0.0.1:1/robots/r"], "", "SWITCHBOARD_TOKEN"),
        (["http://127.0.0.1:1/robots/r"], "t", "not the address of a robot"),
        (["ws://127.0.0.1:1/robots/r", "--near", "0.6", "--clear", "0.5"], "t", "--clear"),
    ],
)
def test_error_is_explained(arguments: list[str], token: str, words: str) -> None:
    """No token, no relay, invalid distances."""
    done = CliRunner().invoke(main, arguments, env={"SWITCHBOARD_TOKEN": token})
    assert done.exit_code != 0
    assert words in done.output
