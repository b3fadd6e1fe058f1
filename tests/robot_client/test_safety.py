"""The watchdog and the age of commands, as functions of time."""

from __future__ import annotations

import pytest

from relay_protocol.link import MotionPolicy
from robot_client.link.clock_offset import ClockOffset
from robot_client.motion.safety import DAEMON_SHARE, GUARD_SHARE, CommandAge, Watchdog, freshness, is_motion
from robot_client.motion.typed_topic import TypedTopic

MS = 1_000_000
CMD = TypedTopic("/cmd_vel", "T")


@pytest.fixture
def offset() -> ClockOffset:
    made = ClockOffset()
    # The relay's clock is 7 s ahead, known to 5 ms, and to 1 ms more after a second.
    made.add(0, 7000 * MS + 5 * MS, 10 * MS)
    return made


@pytest.mark.parametrize(
    ("age", "verdict"),
    [
        (0, CommandAge.FRESH),
        (493, CommandAge.FRESH),
        (496, CommandAge.STALE),
        (60_000, CommandAge.STALE),
        (-4, CommandAge.FRESH),
        (-7, CommandAge.AHEAD),
    ],
)
def test_age_decides(offset: ClockOffset, age: int, verdict: CommandAge) -> None:
    """What may be older than 500 ms is stale; what lies ahead of all the clocks can explain is refused too."""
    now = 1000 * MS
    assert freshness(now + 7000 * MS - age * MS, now, offset, 500) is verdict


def test_without_an_offset_nothing_is_fresh() -> None:
    """A link whose clock is not known yet passes no motion command."""
    assert freshness(0, 0, ClockOffset(), 500) is CommandAge.STALE


def test_motion_is_by_type_or_by_name() -> None:
    """A topic moves the robot if its type or its name is in the policy."""
    policy = MotionPolicy(types=["geometry_msgs/msg/Twist"], topics=["/arm"])
    assert is_motion(policy, TypedTopic("/any", "geometry_msgs/msg/Twist"))
    assert is_motion(policy, TypedTopic("/arm", "x/msg/Y"))
    assert not is_motion(policy, TypedTopic("/other", "x/msg/Y"))


def test_silence_stops_once() -> None:
    """A moving topic is named when its time is over, once."""
    dog = Watchdog(500, DAEMON_SHARE)
    dog.command(CMD, "a", True, 100 * MS)
    assert dog.due() == 500 * MS
    assert dog.expired(499 * MS) == []
    assert dog.expired(500 * MS) == [CMD]
    assert dog.expired(900 * MS) == []
    assert dog.due() is None


def test_standing_topic_needs_no_stop() -> None:
    """After a command of zero nothing is due."""
    dog = Watchdog(500, DAEMON_SHARE)
    dog.command(CMD, "a", True, 0)
    dog.command(CMD, "a", False, 10 * MS)
    assert dog.due() is None
    assert dog.everything() == []


def test_only_the_driver_leaving_stops() -> None:
    """A publication that leaves stops its topic only if the last command was its own."""
    dog = Watchdog(500, DAEMON_SHARE)
    dog.command(CMD, "a", True, 0)
    dog.command(CMD, "b", True, 10 * MS)
    assert not dog.release(CMD, "a")
    assert dog.release(CMD, "b")
    assert not dog.release(CMD, "b")


def test_guard_is_later_than_the_daemon_and_in_time() -> None:
    """The guard acts after the daemon had its chance, and before the robot must stand."""
    assert DAEMON_SHARE < GUARD_SHARE < 1


def test_a_topic_may_have_a_shorter_time() -> None:
    """Each is stopped in its own; who waits is woken for the first."""
    dog, arm = Watchdog(500, DAEMON_SHARE), TypedTopic("/arm", "T")
    dog.within("/arm", 200)
    dog.command(CMD, "a", True, 0)
    dog.command(arm, "a", True, 100 * MS)
    assert dog.due() == 260 * MS
    assert dog.expired(399 * MS) == [arm]
    assert dog.expired(400 * MS) == [CMD]


def test_who_needs_time_to_stop_begins_earlier() -> None:
    """And knows when it must be over."""
    dog = Watchdog(500, DAEMON_SHARE, earlier_ms=150)
    dog.command(CMD, "a", True, 0)
    assert dog.due() == 250 * MS
    assert dog.latest(CMD, 100 * MS) == 500 * MS
    assert dog.expired(249 * MS) == []
    assert dog.expired(250 * MS) == [CMD]
