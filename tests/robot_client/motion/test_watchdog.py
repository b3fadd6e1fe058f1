"""The watchdog, as a function of time."""

from __future__ import annotations

from robot_client.motion.typed_topic import TypedTopic
from robot_client.motion.watchdog import DAEMON_SHARE, GUARD_SHARE, Watchdog

MS = 1_000_000
CMD = TypedTopic("/cmd_vel", "T")


def test_topic_expires_once() -> None:
    dog = Watchdog(500, DAEMON_SHARE)
    dog.note_command(CMD, "a", True, 100 * MS)
    assert dog.due() == 500 * MS
    assert dog.take_expired(499 * MS) == []
    assert dog.take_expired(500 * MS) == [CMD]
    assert dog.take_expired(900 * MS) == []
    assert dog.due() is None


def test_still_topic_does_not_expire() -> None:
    dog = Watchdog(500, DAEMON_SHARE)
    dog.note_command(CMD, "a", True, 0)
    dog.note_command(CMD, "a", False, 10 * MS)
    assert dog.due() is None
    assert dog.take_all() == []


def test_end_of_a_publication_stops_only_the_topic_it_moved() -> None:
    dog = Watchdog(500, DAEMON_SHARE)
    dog.note_command(CMD, "a", True, 0)
    dog.note_command(CMD, "b", True, 10 * MS)
    assert not dog.remove_publication(CMD, "a")
    assert dog.remove_publication(CMD, "b")
    assert not dog.remove_publication(CMD, "b")


def test_guard_is_later_than_the_daemon_and_in_time() -> None:
    assert DAEMON_SHARE < GUARD_SHARE < 1


def test_a_topic_may_have_a_shorter_time() -> None:
    """``due`` gives the earliest."""
    dog, arm = Watchdog(500, DAEMON_SHARE), TypedTopic("/arm", "T")
    dog.set_time_to_stop("/arm", 200)
    dog.note_command(CMD, "a", True, 0)
    dog.note_command(arm, "a", True, 100 * MS)
    assert dog.due() == 260 * MS
    assert dog.take_expired(399 * MS) == [arm]
    assert dog.take_expired(400 * MS) == [CMD]


def test_watchdog_acts_earlier_by_the_length_of_a_ramp() -> None:
    dog = Watchdog(500, DAEMON_SHARE, earlier_ms=150)
    dog.note_command(CMD, "a", True, 0)
    assert dog.due() == 250 * MS
    assert dog.latest_stop(CMD, 100 * MS) == 500 * MS
    assert dog.take_expired(249 * MS) == []
    assert dog.take_expired(250 * MS) == [CMD]
