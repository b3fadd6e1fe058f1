"""The time of a robot with simulated time, by websocket bytes: ``time`` messages, and the stamps of samples."""

from __future__ import annotations

import struct
from typing import Any

import msgspec
import pytest

from relay_protocol import link
from relay_protocol.rights import Level
from tests.worlds.foxglove_client import Foxglove, FoxgloveWorld
from tests.worlds.relay import GRAPH, MOTION, text

SIMULATED = msgspec.structs.replace(MOTION, sim_time=True, started=1.7e9)
SECOND = 10**9


class Simulation(FoxgloveWorld):
    """A robot with simulated time, and a viewer."""

    def __init__(self) -> None:
        super().__init__()
        self.robot_comes()
        self.viewer = self.client(Level.VIEWER)
        self.settle(self.viewer)
        self.registry.described(self.robot, SIMULATED)
        self.subscribe_to_clock()

    def subscribe_to_clock(self) -> None:
        """The robot confirms the relay's subscription to ``/clock``."""
        self.clock_number = self._confirmed("/clock", "rosgraph_msgs/msg/Clock")

    def _confirmed(self, topic: str, type: str) -> int:
        number = next(each.number for each in self.link.all(link.Subscribe) if each.topic == topic)
        self.subscribed(number, type)
        return number

    def tick(self, sec: int) -> None:
        """A message on ``/clock``."""
        self.channel.sample(self.clock_number, b"\x00\x01\x00\x00" + struct.pack("<iI", sec, 0), 1)

    def passes(self, seconds: int) -> None:
        """Time passes, while the viewer answers pings; what it gets is discarded."""
        for _ in range(seconds):
            self.clock.advance(1)
            self.viewer.take()

    def follows_chatter(self) -> int:
        """The viewer subscribes to ``/chatter``; returns the number of the robot's subscription."""
        channel = self.viewer.channels()["/chatter"]["id"]
        self.viewer.sends("subscribe", subscriptions=[{"id": 7, "channelId": channel}])
        return self._confirmed("/chatter", "std_msgs/msg/String")

    def lose_link(self, description: link.Describe = SIMULATED) -> None:
        """The robot's link is lost and comes back."""
        self.robot_goes()
        self.control = self.control_link()
        self.registry.registered(self.robot, self.control)
        self.registry.described(self.robot, description)
        self.registry.graph(self.robot, GRAPH)
        self.robot_joins()
        self.subscribe_to_clock()


def times(messages: list[dict[str, Any] | bytes]) -> list[float]:
    """Seconds of the ``time`` messages."""
    found = [each for each in messages if isinstance(each, bytes) and each[0] == 2]
    return [struct.unpack_from("<Q", each, 1)[0] / SECOND for each in found]


def sessions(messages: list[dict[str, Any] | bytes]) -> list[str]:
    """The ``sessionId`` of each ``serverInfo``."""
    return [each["sessionId"] for each in messages if isinstance(each, dict) and each["op"] == "serverInfo"]


@pytest.fixture
def world() -> Simulation:
    """A simulation that has not begun."""
    return Simulation()


def test_only_the_newest_time_waits_for_a_client_that_does_not_read(world: Simulation) -> None:
    """It is no drop that others are replaced."""
    viewer = world.viewer
    world.tick(5)
    world.clock.advance(0.1)
    assert times(viewer.take()) == [5]
    viewer.end.pause()
    for sec in range(6, 30):
        world.tick(sec)
        world.clock.advance(0.1)
    assert times(viewer.take()) == []
    viewer.end.resume()
    world.clock.advance(2)
    messages = viewer.take()
    assert times(messages) == [29]
    assert not [each for each in messages if isinstance(each, dict) and each["op"] == "status"]
    assert world.people[0].port.dropped_samples == 0
    world.tick(30)
    world.clock.advance(0.1)
    assert times(viewer.take()) == [30]


def test_a_jump_back_begins_a_session_before_samples_of_the_new_time(world: Simulation) -> None:
    number = world.follows_chatter()
    world.tick(100)
    world.channel.sample(number, text("before"), 1)
    world.clock.advance(0.1)
    world.viewer.take()
    world.tick(3)
    world.channel.sample(number, text("after"), 1)
    info, time, sample = world.viewer.take()
    assert sessions([info])
    assert times([time]) == [3]
    assert sample == struct.pack("<BIQ", 1, 7, 3 * SECOND) + text("after")


def test_two_clocks_begin_one_session_and_the_time_goes_on(world: Simulation) -> None:
    """Lichtblick has lasting work from each session. The last time counts."""
    world.tick(100)
    world.clock.advance(0.1)
    world.viewer.take()
    messages: list[dict[str, Any] | bytes] = []
    for sec in range(101, 601):
        world.tick(3)
        world.tick(sec)
        world.clock.advance(0.05)
        messages += world.viewer.take()
    world.tick(3)
    world.clock.advance(0.1)
    messages += world.viewer.take()
    assert len(sessions(messages)) == 1
    assert 240 <= len(times(messages)) <= 260
    assert times(messages)[-1] == 3


def test_a_recording_in_a_loop_begins_one_session_and_its_time_comes_before_its_samples(
    world: Simulation,
) -> None:
    number = world.follows_chatter()
    world.viewer.take()
    found: list[str] = []
    for _ in range(10):
        world.tick(100)
        world.passes(20)
        world.tick(3)
        world.channel.sample(number, text("first"), 1)
        *infos, time, sample = world.viewer.take()
        found += sessions(infos)
        assert times([time]) == [3]
        assert sample == struct.pack("<BIQ", 1, 7, 3 * SECOND) + text("first")
    assert len(found) == 1


def test_a_jump_after_a_calm_minute_begins_another_session(world: Simulation) -> None:
    world.viewer.take()
    found: list[str] = []
    for _ in range(3):
        world.tick(100)
        world.passes(60)
        world.tick(3)
        found += sessions(world.viewer.take())
    assert len(set(found)) == 3


def test_a_jump_between_two_times_begins_a_session_too(world: Simulation) -> None:
    """The time that is sent is later than the one before, but the simulation is another one."""
    world.tick(100)
    world.clock.advance(0.1)
    world.viewer.take()
    world.tick(3)
    world.tick(101)
    world.clock.advance(0.1)
    messages = world.viewer.take()
    assert len(sessions(messages)) == 1
    assert times(messages) == [3, 101]


def test_a_clock_that_was_lost_goes_on_from_an_earlier_time(world: Simulation) -> None:
    """The simulation began again while the link was lost; the daemon runs on."""
    world.tick(100)
    world.clock.advance(0.1)
    before = world.viewer.take()
    assert times(before) == [100]
    world.lose_link()
    world.clock.advance(1)
    assert times(world.viewer.take()) == []
    world.tick(3)
    world.tick(4)
    world.clock.advance(0.1)
    after = world.viewer.take()
    assert times(after) == [3, 4]
    (session,) = sessions(after)
    assert session not in sessions(before)


def test_a_clock_that_was_lost_and_goes_on_is_no_jump(world: Simulation) -> None:
    world.tick(100)
    world.clock.advance(0.1)
    known = set(sessions(world.viewer.take()))
    world.lose_link()
    world.tick(101)
    world.clock.advance(0.1)
    messages = world.viewer.take()
    assert times(messages) == [101]
    assert known.issuperset(sessions(messages))


def test_a_clock_that_stands_still_is_sent_again_in_a_new_session(world: Simulation) -> None:
    """Clients forget the time with the session of a daemon that was started again."""
    world.tick(100)
    world.clock.advance(0.1)
    world.viewer.take()
    world.lose_link(msgspec.structs.replace(SIMULATED, started=1.7e9 + 60))
    world.tick(100)
    world.clock.advance(0.1)
    messages = world.viewer.take()
    assert sessions(messages)
    assert times(messages) == [100]


def test_a_sample_that_waited_during_a_jump_has_no_time_beyond_the_clock(world: Simulation) -> None:
    number = world.follows_chatter()
    world.tick(100)
    world.clock.advance(0.1)
    world.viewer.take()
    world.viewer.end.pause()
    world.channel.sample(number, text("waits"), 1)
    world.tick(3)
    world.viewer.end.resume()
    (sample,) = world.viewer.samples()
    assert sample.time_ns == 3 * SECOND


def test_a_client_that_has_left_is_not_told_of_jumps(world: Simulation) -> None:
    world.tick(100)
    other: Foxglove = world.client(Level.VIEWER, "bob")
    assert len(world.channel.robot_clock.on_jump) == 2
    other.core.send_close()
    other.run()
    assert len(world.channel.robot_clock.on_jump) == 1
    world.tick(3)
    world.clock.advance(0.1)
    assert times(world.viewer.take())[-1] == 3
