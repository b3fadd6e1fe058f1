"""Samples from the robot's link: whose time they carry."""

from __future__ import annotations

import cbor2
import msgspec

from relay_server.channels.robot_clock import TYPE
from relay_server.recordings.recorder import HELD
from tests.relay_server.channels.test_robot_clock import tick
from tests.relay_server.recordings.test_recorder import RecorderWorld
from tests.worlds.relay import MOTION, TEXTS, World, text
from tests.worlds.robot_channel_link import RobotLink

TEXTS.setdefault(TYPE, "builtin_interfaces/Time clock\n")
SIMULATED = msgspec.structs.replace(MOTION, sim_time=True)
WALL = 1_700_000_000 * 10**9 + 7
SECOND = 10**9


def simulated(world: World) -> RobotLink:
    """A robot with simulated time and a subscription to ``/clock``."""
    robot = RobotLink(world)
    world.registry.described(world.robot, SIMULATED)
    return robot


def test_sample_frames_carry_the_simulated_time(world: World) -> None:
    """The frame's stamp is the robot's wall clock; ``cbor-raw`` carries the last value of ``/clock``."""
    robot = simulated(world)
    person = world.person()
    robot.joins()
    clock = robot.subscribed("/clock", TYPE)
    person.says("subscribe", topic="/chatter", compression="cbor-raw")
    chatter = robot.subscribed("/chatter")
    robot.sample(chatter, text("early"), WALL)
    robot.sample(clock, tick(77, 9), WALL)
    robot.sample(chatter, text("simulated"), WALL + 1)
    world.registry.described(world.robot, MOTION)
    robot.sample(chatter, text("real"), WALL)
    reported = [cbor2.loads(each)["msg"] for each in person.client.sent]
    assert [(each["secs"], each["nsecs"]) for each in reported] == [(0, 0), (77, 9), (1_700_000_000, 7)]
    assert [each["bytes"] for each in reported] == [text(word) for word in ("early", "simulated", "real")]


def recording(world: World) -> tuple[RobotLink, RecorderWorld, int, int]:
    """A recording on a robot with simulated time, with the subscription numbers of ``/clock`` and
    ``/chatter``.
    """
    robot = simulated(world)
    recording_world = RecorderWorld(world)
    recording_world.starts()
    robot.joins()
    return robot, recording_world, robot.subscribed("/clock", TYPE), robot.subscribed("/chatter")


def test_a_recording_has_one_clock(world: World) -> None:
    """Samples before the first ``/clock`` wait for it, also after the robot was away."""
    robot, recording_world, clock, chatter = recording(world)
    robot.sample(chatter, text("early"), WALL)
    robot.sample(clock, tick(5, 0), WALL)
    robot.sample(chatter, text("a"), WALL + SECOND)
    robot.sample(clock, tick(6, 0), WALL)
    robot.sample(chatter, text("b"), WALL + 2 * SECOND)
    robot.leaves()
    world.clock.advance(1)
    robot.joins()
    clock, chatter = robot.subscribed("/clock", TYPE), robot.subscribed("/chatter")
    robot.sample(chatter, text("back"), WALL + 3 * SECOND)
    robot.sample(clock, tick(7, 0), WALL)
    robot.sample(chatter, text("c"), WALL + 4 * SECOND)
    assert recording_world.memory_writer.bodies == [text(word) for word in ("early", "a", "b", "back", "c")]
    times = [
        (each.log_time // SECOND, each.publish_time // SECOND)
        for each in recording_world.memory_writer.written
    ]
    assert times == [(5, 5), (5, 5), (6, 6), (7, 7), (7, 7)]


def test_a_silent_clock_is_reported_and_costs_bounded_memory(world: World) -> None:
    """The recording says why it is empty, and counts the missing samples."""
    robot, recording_world, _, chatter = recording(world)
    for _ in range(HELD + 7):
        robot.sample(chatter, text("x"), WALL)
    assert recording_world.memory_writer.bodies == []
    recording_world.recorder.count()
    assert recording_world.entry.drops == 7
    assert any("/clock" in each for each in recording_world.entry.problems)
    recording_world.recorder.stop("enough")
    recording_world.recorder.count()
    assert recording_world.entry.drops == HELD + 7


def test_latched_samples_of_a_simulation_begin_the_recording(world: World) -> None:
    """Their log time is simulated, as for all others."""
    robot = simulated(world)
    person = world.person()
    robot.joins()
    clock = robot.subscribed("/clock", TYPE)
    person.says("subscribe", topic="/chatter")
    chatter = robot.subscribed("/chatter", latched=True, publishers=1)
    robot.sample(clock, tick(3, 0), WALL)
    robot.sample(chatter, text("map"), WALL)
    robot.sample(clock, tick(9, 0), WALL)
    recording_world = RecorderWorld(world)
    recording_world.starts()
    (message,) = recording_world.memory_writer.written
    assert (message.log_time, message.publish_time) == (9 * SECOND, 3 * SECOND)


def test_wall_clock_robots_keep_their_stamps(world: World) -> None:
    robot = RobotLink(world)
    recording_world = RecorderWorld(world)
    recording_world.starts()
    robot.joins()
    chatter = robot.subscribed("/chatter")
    robot.sample(chatter, text("a"), WALL)
    (message,) = recording_world.memory_writer.written
    assert (message.log_time, message.publish_time) == (WALL, WALL)
    assert robot.asked("subscribe", topic="/clock") == []
