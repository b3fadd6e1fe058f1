"""The simulated robot without ROS: commands, timeout, reset, scan and record."""

import io
import json
import math

import numpy as np
import pytest

from robot_client.sim.robot import SCAN_FARTHEST, SCAN_RAYS, MotionRecorder, SimRobot
from robot_client.sim.world import WORLDS, Pose

STEP = 0.02


class Bench:
    """A robot with its clock and record."""

    def __init__(self, world: str = "open", seed: int | None = 1) -> None:
        self.now = 0.0
        self.stream = io.BytesIO()
        recorder = MotionRecorder(self.stream, clock=lambda: round(self.now * 1e9))
        self.robot = SimRobot(WORLDS[world](), recorder, seed, clock=lambda: self.now)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP)):
            self.now += STEP
            self.robot.step(STEP)

    @property
    def record(self) -> list[dict[str, object]]:
        return [json.loads(line) for line in self.stream.getvalue().splitlines()]


def test_record_has_commands_motion_and_standstill() -> None:
    bench = Bench()
    bench.robot.command(0.5, 0.0)
    bench.run(1.0)
    bench.robot.command(0.0, 0.0)
    bench.run(1.0)
    events = bench.record
    assert [event["event"] for event in events] == ["command", "moving", "command", "standstill"]
    times = [event["t"] for event in events]
    assert times[1] - times[0] <= 20_000_000
    assert times[3] - times[2] <= 60_000_000
    assert (events[0]["v"], events[0]["w"]) == (0.5, 0.0)


def test_without_timeout_the_last_command_holds() -> None:
    bench = Bench()
    bench.robot.command(0.3, 0.0)
    bench.run(10.0)
    assert bench.robot.body.velocity.speed == pytest.approx(0.3)


def test_timeout_stops_the_robot() -> None:
    bench = Bench()
    bench.robot.command_timeout = 0.5
    bench.robot.command(0.3, 0.0)
    bench.run(2.0)
    assert bench.record[-1]["event"] == "standstill"
    assert 0.5e9 < bench.record[-1]["t"] < 0.6e9


@pytest.mark.parametrize(("speed", "turn"), [(math.nan, 0.0), (0.2, math.inf)])
def test_values_that_are_not_finite_stop_the_robot(speed: float, turn: float) -> None:
    bench = Bench()
    bench.robot.command(0.3, 0.0)
    bench.run(0.5)
    bench.robot.command(speed, turn)
    bench.run(0.5)
    assert not bench.robot.body.moving
    assert None in (bench.record[2]["v"], bench.record[2]["w"])


def test_reset_restores_pose_and_charge() -> None:
    bench = Bench()
    bench.robot.command(0.5, 0.5)
    bench.run(3.0)
    bench.robot.reset()
    assert bench.robot.body.pose == bench.robot.world.start
    assert bench.robot.battery.charge == 1.0
    assert [event["event"] for event in bench.record[-2:]] == ["reset", "standstill"]


def test_scan_is_exact_up_to_its_noise() -> None:
    bench = Bench("default")
    scan = bench.robot.scan()
    start = bench.robot.world.start
    for index, direction in ((180, 0.0), (270, math.pi / 2), (90, -math.pi / 2)):
        true = bench.robot.world.cast(start.x, start.y, np.array([start.heading + direction])).distance[0]
        assert scan[index] == pytest.approx(true, abs=0.05)
    assert scan.shape == (SCAN_RAYS,)


def test_scan_of_the_open_field_is_infinite() -> None:
    assert np.isinf(Bench("open").robot.scan()).all()


def test_noise_depends_on_its_seed() -> None:
    one, same, other = (Bench("default", seed).robot.scan() for seed in (5, 5, 6))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)
    assert one[np.isfinite(one)].max() <= SCAN_FARTHEST


def test_battery_is_charged_at_the_charger_at_rest() -> None:
    place = Pose(-2.7, -4.0, -math.pi / 2)
    robot = SimRobot(WORLDS["default"](), MotionRecorder(None), 1, clock=lambda: 0.0, charge=0.15)
    robot.step(STEP)
    assert robot.battery.charge < 0.15 and not robot.battery.charging
    robot.body.reset(place)
    robot.command(0.0, 1.0)
    robot.step(STEP)
    assert not robot.battery.charging
    robot.body.reset(place)
    robot.step(STEP)
    before = robot.battery.charge
    robot.step(60.0)
    assert robot.battery.charging and robot.battery.charge > before
    robot.reset()
    assert (robot.battery.charge, robot.battery.charging) == (0.15, False)
