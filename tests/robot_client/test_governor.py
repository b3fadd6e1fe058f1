"""Commands are made slower, never faster, and keep their direction."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol.link.motion import Limits
from robot_client.motion.governor import Governor
from robot_client.motion.typed_topic import TypedTopic
from robot_client.motion.velocity import TWIST, TWIST_STAMPED, Velocity, form

MS = 1_000_000
CMD = TypedTopic("/cmd_vel", TWIST)
JOY = TypedTopic("/joy", "sensor_msgs/msg/Joy")
SOME = st.floats(-1e9, 1e9, allow_nan=False)


def command(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: float = 0.0) -> bytes:
    return b"\0\1\0\0" + struct.pack("<6d", x, y, z, 0.0, 0.0, turn)


def speeds(body: bytes | None) -> Velocity:
    assert body is not None
    where = form(TWIST, "cdr")
    assert where is not None
    found = where.read(body)
    assert found is not None
    return found


def governor(**limits: float) -> Governor:
    return Governor({"operator": Limits(**limits)}, "cdr")


def test_what_is_slow_enough_passes_as_it_is() -> None:
    """The very same bytes, and nothing is counted."""
    rules, body = governor(linear=0.5, angular=1.0), command(0.5, turn=1.0)
    assert rules.tame(CMD, body, "operator", 0) is body
    assert rules.limited == 0


def test_what_is_too_fast_keeps_its_direction() -> None:
    """Linear speed is limited by its length over all axes, angular speed for itself."""
    rules = governor(linear=0.5, angular=1.0)
    slow = speeds(rules.tame(CMD, command(3.0, -4.0, turn=0.9), "operator", 0))
    assert slow.linear == pytest.approx((0.3, -0.4, 0.0))
    assert slow.angular == (0.0, 0.0, 0.9)
    assert speeds(rules.tame(CMD, command(turn=-7.0), "operator", 0)).angular == pytest.approx((0, 0, -1.0))
    assert rules.limited == 2


def test_speed_grows_no_faster_than_allowed() -> None:
    """From standing at once to what 100 ms allow at most, then with the time between the commands."""
    rules = governor(linear_acceleration=2.0)
    steps = [speeds(rules.tame(CMD, command(1.0), "operator", n * 50 * MS)).linear[0] for n in range(12)]
    assert steps[:4] == pytest.approx([0.2, 0.3, 0.4, 0.5])
    assert steps[-2:] == [1.0, 1.0]


def test_a_pause_is_no_run_up() -> None:
    """After a pause, or after zero was said, one begins like everybody."""
    rules = governor(linear_acceleration=2.0)
    rules.tame(CMD, command(0.1), "operator", 0)
    assert speeds(rules.tame(CMD, command(5.0), "operator", 60_000 * MS)).linear[0] == pytest.approx(0.3)
    rules.stood(CMD, 60_010 * MS)
    assert speeds(rules.tame(CMD, command(5.0), "operator", 60_020 * MS)).linear[0] == pytest.approx(0.02)


def test_to_slow_down_is_not_limited() -> None:
    """At once to any lower speed; the other way only from zero on."""
    rules = governor(linear_acceleration=1.0, angular_acceleration=1.0)
    for n in range(30):
        rules.tame(CMD, command(2.0, turn=2.0), "operator", n * 100 * MS)
    body = command(0.1, turn=0.0)
    assert rules.tame(CMD, body, "operator", 3_000 * MS) is body
    for n in range(31, 60):
        rules.tame(CMD, command(2.0), "operator", n * 100 * MS)
    back = speeds(rules.tame(CMD, command(-2.0), "operator", 6_000 * MS))
    assert back.linear[0] == pytest.approx(-0.1)


def test_a_turn_of_direction_starts_from_what_goes_that_way_already() -> None:
    """Sideways nothing does: what went ahead ends at once, the rest begins like from standing."""
    rules = governor(linear_acceleration=1.0)
    for n in range(30):
        rules.tame(CMD, command(2.0), "operator", n * 100 * MS)
    sideways = speeds(rules.tame(CMD, command(0.0, 2.0), "operator", 3_000 * MS))
    assert sideways.linear == pytest.approx((0.0, 0.1, 0.0))


def test_each_topic_counts_for_itself_and_is_forgotten() -> None:
    """What one topic does is no run-up for another."""
    rules, other = governor(linear_acceleration=1.0), TypedTopic("/other", TWIST)
    for n in range(30):
        rules.tame(CMD, command(2.0), "operator", n * 100 * MS)
    assert speeds(rules.tame(other, command(2.0), "operator", 3_000 * MS)).linear[0] == pytest.approx(0.1)
    rules.forget(CMD)
    assert speeds(rules.tame(CMD, command(2.0), "operator", 3_001 * MS)).linear[0] == pytest.approx(0.1)


def test_who_has_no_limits_is_not_looked_at() -> None:
    """An owner without limits, a robot without limits: the bytes pass unread, of whatever type."""
    rules, free = governor(linear=0.1), Governor({}, "cdr")
    for on in (CMD, JOY):
        assert rules.tame(on, b"anything", "owner", 0) == b"anything"
        assert free.tame(on, b"anything", "", 0) == b"anything"
        assert rules.covers(on, "owner")
        assert not rules.closed(on)
        assert not free.closed(on)


def test_what_has_no_speeds_to_read_is_not_followed_where_there_are_limits() -> None:
    """Of a limited level, and of one that is not known; where all levels are limited, of nobody."""
    rules = governor(linear=0.1)
    for level in ("operator", ""):
        assert not rules.covers(JOY, level)
        assert rules.covers(CMD, level)
        assert rules.tame(JOY, b"anything", level, 0) is None
    assert not rules.closed(JOY)
    all_limited = Governor({"operator": Limits(linear=0.1), "owner": Limits(angular=1.0)}, "cdr")
    assert all_limited.closed(JOY)
    assert not all_limited.closed(CMD)


def test_what_is_listed_passes_without_speeds() -> None:
    """By names and patterns, whoever commands; what has speeds is held to them all the same."""
    told = {"operator": Limits(linear=0.1), "owner": Limits(linear=0.1)}
    rules = Governor(told, "cdr", ["*/joy", "/cmd_vel"])
    assert rules.covers(JOY, "operator")
    assert not rules.closed(JOY)
    assert rules.tame(JOY, b"anything", "operator", 0) == b"anything"
    assert rules.closed(TypedTopic("/joystick", JOY.type))
    assert speeds(rules.tame(CMD, command(5.0), "operator", 0)).linear[0] == pytest.approx(0.1)


def test_of_an_unknown_level_the_strictest_limits_hold() -> None:
    """A suppressor's level, which the robot is not told, is such a one."""
    told = {"operator": Limits(linear=0.2), "owner": Limits(linear=1.0)}
    assert speeds(Governor(told, "cdr").tame(CMD, command(5.0), "", 0)).linear[0] == pytest.approx(0.2)


def test_what_can_not_be_read_must_not_be_followed() -> None:
    """Where limits hold, a command whose speeds are not found, or are none, gives nothing to publish."""
    rules = governor(linear=0.1)
    assert rules.tame(CMD, b"\0\7" + command(1.0)[2:], "operator", 0) is None
    assert rules.tame(CMD, command(math.inf), "operator", 0) is None
    assert rules.tame(CMD, command(math.nan), "operator", 0) is None


def test_a_stamped_command_keeps_its_header() -> None:
    """Only the speeds change."""
    on = TypedTopic("/cmd_vel", TWIST_STAMPED)
    head = b"\0\1\0\0" + struct.pack("<iII", 5, 6, 5) + b"base\0" + bytes(7)
    body = head + struct.pack("<6d", 2.0, 0, 0, 0, 0, 0)
    made = governor(linear=1.0).tame(on, body, "operator", 0)
    assert made == head + struct.pack("<6d", 1.0, 0, 0, 0, 0, 0)


def test_json_is_limited_too() -> None:
    """For platforms that speak it."""
    rules = Governor({"operator": Limits(linear=0.5)}, "json")
    made = rules.tame(CMD, b'{"linear":{"x":2},"angular":{"z":1}}', "operator", 0)
    where = form(TWIST, "json")
    assert where is not None
    assert made is not None
    assert where.read(made) == Velocity((0.5, 0, 0), (0, 0, 1))


@given(
    st.lists(st.tuples(SOME, SOME, SOME, SOME, st.integers(-5, 300)), min_size=1, max_size=20),
    st.floats(1e-3, 1e4),
    st.floats(1e-3, 1e4),
)
def test_never_faster_and_always_the_same_way(
    commands: list[tuple[float, float, float, float, int]], most: float, acceleration: float
) -> None:
    """Whatever is commanded whenever: no part grows or turns, and neither limit is passed."""
    rules = governor(linear=most, angular=most, linear_acceleration=acceleration)
    now, before = 1_000 * MS, 0.0
    for x, y, z, turn, pause in commands:
        now += pause * MS
        asked, made = (
            speeds(command(x, y, z, turn)),
            speeds(rules.tame(CMD, command(x, y, z, turn), "operator", now)),
        )
        for one, other in zip((*asked.linear, *asked.angular), (*made.linear, *made.angular), strict=True):
            assert abs(other) <= abs(one)
            assert one * other >= 0
        speed = math.hypot(*made.linear)
        assert speed <= most * (1 + 1e-9)
        assert math.hypot(*made.angular) <= most * (1 + 1e-9)
        assert speed <= (before + acceleration * 0.1) * (1 + 1e-9)
        before = speed
