"""Commands are slowed, never sped up, and keep their direction."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol.link.motion import Limits
from robot_client.motion.speed_limiter import SpeedLimiter
from robot_client.motion.typed_topic import TypedTopic
from robot_client.motion.velocity import TWIST, TWIST_STAMPED, Velocity, velocity_access

MS = 1_000_000
CMD = TypedTopic("/cmd_vel", TWIST)
JOY = TypedTopic("/joy", "sensor_msgs/msg/Joy")
SOME = st.floats(-1e9, 1e9, allow_nan=False)


def command(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: float = 0.0) -> bytes:
    return b"\0\1\0\0" + struct.pack("<6d", x, y, z, 0.0, 0.0, turn)


def speeds(body: bytes | None) -> Velocity:
    assert body is not None
    where = velocity_access(TWIST, "cdr")
    assert where is not None
    found = where.read(body)
    assert found is not None
    return found


def limiter(**limits: float) -> SpeedLimiter:
    return SpeedLimiter({"operator": Limits(**limits)}, "cdr")


def test_slow_command_passes_unchanged() -> None:
    rules, body = limiter(linear=0.5, angular=1.0), command(0.5, turn=1.0)
    assert rules.limit(CMD, body, "operator", 0) is body
    assert rules.limited == 0


def test_fast_command_keeps_its_direction() -> None:
    """Linear and angular speed are limited separately, by length."""
    rules = limiter(linear=0.5, angular=1.0)
    slow = speeds(rules.limit(CMD, command(3.0, -4.0, turn=0.9), "operator", 0))
    assert slow.linear == pytest.approx((0.3, -0.4, 0.0))
    assert slow.angular == (0.0, 0.0, 0.9)
    assert speeds(rules.limit(CMD, command(turn=-7.0), "operator", 0)).angular == pytest.approx((0, 0, -1.0))
    assert rules.limited == 2


def test_acceleration_is_limited() -> None:
    """From rest by at most what 100 ms allow, then by the time between commands."""
    rules = limiter(linear_acceleration=2.0)
    steps = [speeds(rules.limit(CMD, command(1.0), "operator", n * 50 * MS)).linear[0] for n in range(12)]
    assert steps[:4] == pytest.approx([0.2, 0.3, 0.4, 0.5])
    assert steps[-2:] == [1.0, 1.0]


def test_pause_counts_100_ms_at_most() -> None:
    """So does the time after zero."""
    rules = limiter(linear_acceleration=2.0)
    rules.limit(CMD, command(0.1), "operator", 0)
    assert speeds(rules.limit(CMD, command(5.0), "operator", 60_000 * MS)).linear[0] == pytest.approx(0.3)
    rules.zero_published(CMD, 60_010 * MS)
    assert speeds(rules.limit(CMD, command(5.0), "operator", 60_020 * MS)).linear[0] == pytest.approx(0.02)


def test_deceleration_is_not_limited() -> None:
    rules = limiter(linear_acceleration=1.0, angular_acceleration=1.0)
    for n in range(30):
        rules.limit(CMD, command(2.0, turn=2.0), "operator", n * 100 * MS)
    body = command(0.1, turn=0.0)
    assert rules.limit(CMD, body, "operator", 3_000 * MS) is body
    for n in range(31, 60):
        rules.limit(CMD, command(2.0), "operator", n * 100 * MS)
    back = speeds(rules.limit(CMD, command(-2.0), "operator", 6_000 * MS))
    assert back.linear[0] == pytest.approx(-0.1)


def test_change_of_direction_counts_the_speed_along_the_new_direction() -> None:
    rules = limiter(linear_acceleration=1.0)
    for n in range(30):
        rules.limit(CMD, command(2.0), "operator", n * 100 * MS)
    sideways = speeds(rules.limit(CMD, command(0.0, 2.0), "operator", 3_000 * MS))
    assert sideways.linear == pytest.approx((0.0, 0.1, 0.0))


def test_topics_are_independent_and_can_be_forgotten() -> None:
    rules, other = limiter(linear_acceleration=1.0), TypedTopic("/other", TWIST)
    for n in range(30):
        rules.limit(CMD, command(2.0), "operator", n * 100 * MS)
    assert speeds(rules.limit(other, command(2.0), "operator", 3_000 * MS)).linear[0] == pytest.approx(0.1)
    rules.forget(CMD)
    assert speeds(rules.limit(CMD, command(2.0), "operator", 3_001 * MS)).linear[0] == pytest.approx(0.1)


def test_commands_without_limits_pass_unread() -> None:
    rules, free = limiter(linear=0.1), SpeedLimiter({}, "cdr")
    for topic in (CMD, JOY):
        assert rules.limit(topic, b"anything", "owner", 0) == b"anything"
        assert free.limit(topic, b"anything", "", 0) == b"anything"
        assert rules.allows(topic, "owner")
        assert not rules.refuses_every_level(topic)
        assert not free.refuses_every_level(topic)


def test_types_without_speeds_are_refused_under_limits() -> None:
    """Also for an unknown level."""
    rules = limiter(linear=0.1)
    for level in ("operator", ""):
        assert not rules.allows(JOY, level)
        assert rules.allows(CMD, level)
        assert rules.limit(JOY, b"anything", level, 0) is None
    assert not rules.refuses_every_level(JOY)
    all_limited = SpeedLimiter({"operator": Limits(linear=0.1), "owner": Limits(angular=1.0)}, "cdr")
    assert all_limited.refuses_every_level(JOY)
    assert not all_limited.refuses_every_level(CMD)


def test_exempt_topics_pass_without_speeds() -> None:
    """By name or pattern; types with speeds are limited there too."""
    limits = {"operator": Limits(linear=0.1), "owner": Limits(linear=0.1)}
    rules = SpeedLimiter(limits, "cdr", ["*/joy", "/cmd_vel"])
    assert rules.allows(JOY, "operator")
    assert not rules.refuses_every_level(JOY)
    assert rules.limit(JOY, b"anything", "operator", 0) == b"anything"
    assert rules.refuses_every_level(TypedTopic("/joystick", JOY.type))
    assert speeds(rules.limit(CMD, command(5.0), "operator", 0)).linear[0] == pytest.approx(0.1)


def test_unknown_level_has_the_strictest_limits() -> None:
    limits = {"operator": Limits(linear=0.2), "owner": Limits(linear=1.0)}
    assert speeds(SpeedLimiter(limits, "cdr").limit(CMD, command(5.0), "", 0)).linear[0] == pytest.approx(0.2)


def test_unreadable_speeds_are_refused_under_limits() -> None:
    rules = limiter(linear=0.1)
    assert rules.limit(CMD, b"\0\7" + command(1.0)[2:], "operator", 0) is None
    assert rules.limit(CMD, command(math.inf), "operator", 0) is None
    assert rules.limit(CMD, command(math.nan), "operator", 0) is None


def test_a_stamped_command_keeps_its_header() -> None:
    topic = TypedTopic("/cmd_vel", TWIST_STAMPED)
    head = b"\0\1\0\0" + struct.pack("<iII", 5, 6, 5) + b"base\0" + bytes(7)
    body = head + struct.pack("<6d", 2.0, 0, 0, 0, 0, 0)
    made = limiter(linear=1.0).limit(topic, body, "operator", 0)
    assert made == head + struct.pack("<6d", 1.0, 0, 0, 0, 0, 0)


def test_json_is_limited_too() -> None:
    rules = SpeedLimiter({"operator": Limits(linear=0.5)}, "json")
    made = rules.limit(CMD, b'{"linear":{"x":2},"angular":{"z":1}}', "operator", 0)
    where = velocity_access(TWIST, "json")
    assert where is not None
    assert made is not None
    assert where.read(made) == Velocity((0.5, 0, 0), (0, 0, 1))


@given(
    st.lists(st.tuples(SOME, SOME, SOME, SOME, st.integers(-5, 300)), min_size=1, max_size=20),
    st.floats(1e-3, 1e4),
    st.floats(1e-3, 1e4),
)
def test_limited_commands_are_never_faster_and_keep_their_direction(
    commands: list[tuple[float, float, float, float, int]], most: float, acceleration: float
) -> None:
    """For any sequence of commands."""
    rules = limiter(linear=most, angular=most, linear_acceleration=acceleration)
    now, before = 1_000 * MS, 0.0
    for x, y, z, turn, pause in commands:
        now += pause * MS
        asked, made = (
            speeds(command(x, y, z, turn)),
            speeds(rules.limit(CMD, command(x, y, z, turn), "operator", now)),
        )
        for one, other in zip((*asked.linear, *asked.angular), (*made.linear, *made.angular), strict=True):
            assert abs(other) <= abs(one)
            assert one * other >= 0
        speed = math.hypot(*made.linear)
        assert speed <= most * (1 + 1e-9)
        assert math.hypot(*made.angular) <= most * (1 + 1e-9)
        assert speed <= (before + acceleration * 0.1) * (1 + 1e-9)
        before = speed
