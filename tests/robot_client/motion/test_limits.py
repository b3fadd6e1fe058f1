"""The stricter of the robot's limits and the level's."""

from __future__ import annotations

from pathlib import Path

from relay_protocol.link.motion import Limits
from robot_client.config import RobotSettings, load
from robot_client.motion.limits import NO_LIMITS, limits_by_level, limits_of, stricter

FILE = """
[limits]
linear = 1.0
angular = 2.0
[limits.operator]
linear = 0.5
angular = 3.0
linear_acceleration = 0.4
"""


def test_stricter_of_robot_and_level_counts(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(FILE)
    assert limits_by_level(load(file, {})) == {
        "operator": Limits(linear=0.5, angular=2.0, linear_acceleration=0.4),
        "owner": Limits(linear=1.0, angular=2.0),
    }


def test_level_without_limits_is_left_out() -> None:
    assert limits_by_level(RobotSettings()) == {}
    only = load(None, {"SWITCHBOARD_ROBOT_LIMITS_OPERATOR_LINEAR": "0.3"})
    assert limits_by_level(only) == {"operator": Limits(linear=0.3)}


def test_of_two_limits_the_lower_one_counts() -> None:
    """``None`` is higher than any number."""
    one, other = Limits(linear=1.0, angular=1.0), Limits(linear=2.0, linear_acceleration=0.1)
    assert stricter(one, other) == Limits(linear=1.0, angular=1.0, linear_acceleration=0.1)
    assert stricter(NO_LIMITS, NO_LIMITS) == NO_LIMITS


def test_unknown_level_has_the_strictest_limits() -> None:
    """A known level without limits has none."""
    limits = {"operator": Limits(linear=0.5), "owner": Limits(linear=1.0, angular=0.2)}
    assert limits_of(limits, "owner") == limits["owner"]
    assert limits_of(limits, "") == Limits(linear=0.5, angular=0.2)
    assert limits_of(limits, "viewer") == Limits(linear=0.5, angular=0.2)
    assert limits_of({"operator": Limits(linear=0.5)}, "owner") == NO_LIMITS
