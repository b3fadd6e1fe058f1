"""The stricter of the robot's limits and the level's."""

from __future__ import annotations

from pathlib import Path

from relay_protocol.link.motion import Limits
from robot_client.config import RobotSettings, load
from robot_client.motion.limits import NONE, limits_of, limits_told, stricter

FILE = """
[limits]
linear = 1.0
angular = 2.0
[limits.operator]
linear = 0.5
angular = 3.0
linear_acceleration = 0.4
"""


def test_the_stricter_of_robot_and_level_is_told(tmp_path: Path) -> None:
    """A level's own limit can only be lower than the robot's."""
    file = tmp_path / "robot.toml"
    file.write_text(FILE)
    assert limits_told(load(file, {})) == {
        "operator": Limits(linear=0.5, angular=2.0, linear_acceleration=0.4),
        "owner": Limits(linear=1.0, angular=2.0),
    }


def test_without_limits_none_are_told() -> None:
    """A level without a limit is left out."""
    assert limits_told(RobotSettings()) == {}
    only = load(None, {"SWITCHBOARD_ROBOT_LIMITS_OPERATOR_LINEAR": "0.3"})
    assert limits_told(only) == {"operator": Limits(linear=0.3)}


def test_of_two_limits_the_lower_one_counts() -> None:
    """None is higher than any number."""
    one, other = Limits(linear=1.0, angular=1.0), Limits(linear=2.0, linear_acceleration=0.1)
    assert stricter(one, other) == Limits(linear=1.0, angular=1.0, linear_acceleration=0.1)
    assert stricter(NONE, NONE) == NONE


def test_who_is_of_no_known_level_has_the_strictest_limits() -> None:
    """What is lowest anywhere; a known level without limits has none."""
    told = {"operator": Limits(linear=0.5), "owner": Limits(linear=1.0, angular=0.2)}
    assert limits_of(told, "owner") == told["owner"]
    assert limits_of(told, "") == Limits(linear=0.5, angular=0.2)
    assert limits_of(told, "viewer") == Limits(linear=0.5, angular=0.2)
    assert limits_of({"operator": Limits(linear=0.5)}, "owner") == NONE
