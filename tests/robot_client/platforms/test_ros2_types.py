"""Types of ROS 2 by name."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import pytest
from geometry_msgs.msg import Twist, TwistStamped
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.serialization import serialize_message
from sensor_msgs.msg import BatteryState, Image
from std_srvs.srv import Trigger

from relay_protocol.errors import Invalid, NotFound
from robot_client.platforms.base import Motion
from robot_client.platforms.ros2_types import Types, introspected
from tests.robot_client.platforms.ends import STAMPED, TWIST

KINDS = {
    "message": "std_msgs/msg/String",
    "service": "std_srvs/srv/Trigger",
    "action": "example_interfaces/action/Fibonacci",
}


@pytest.mark.parametrize(("kind", "other"), list(itertools.permutations(KINDS, 2)))
def test_a_type_known_as_one_kind_is_no_other(kind: str, other: str) -> None:
    """Its library would end the process where another kind is wanted."""
    types = Types()
    getattr(types, kind)(KINDS[kind])
    with pytest.raises(Invalid, match=f"{KINDS[kind]} is no type of "):
        getattr(types, other)(KINDS[kind])


@pytest.mark.parametrize("kind", ["msg", "srv", "action"])
def test_naming_a_type_runs_no_code_that_is_no_ros_interface(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """Clients choose the names, and Python runs a package to look into it: one that may even end the process."""
    (tmp_path / "switchboard_scripts").mkdir()
    (tmp_path / "switchboard_scripts" / "__init__.py").write_text("raise SystemExit('was run')")
    (tmp_path / "switchboard_script.py").write_text("raise SystemExit('was run')")
    monkeypatch.syspath_prepend(tmp_path)
    types = Types()
    for package in ("switchboard_scripts", "switchboard_script", "antigravity", "sys", "no_such_package"):
        with pytest.raises(NotFound, match="is not installed on this robot"):
            types.definition(f"{package}/{kind}/Type")
        find = {"msg": types.message, "srv": types.service, "action": types.action}[kind]
        with pytest.raises(NotFound, match="is not installed on this robot"):
            find(f"{package}/{kind}/Type")
    assert "antigravity" not in sys.modules


@pytest.mark.parametrize("name", ["std_srvs/srv/Trigger_Request", "std_srvs/srv/Trigger_Event"])
def test_a_part_of_a_service_has_no_definition_of_its_own(name: str) -> None:
    """Newer releases of ROS have classes of these names beside the service."""
    with pytest.raises(NotFound, match="is not installed on this robot"):
        Types().definition(name)


def test_definition_has_all_parts_and_hash() -> None:
    """A definition from the installed files holds every contained type, and the distribution's hash."""
    types = Types()
    found = types.definition(STAMPED)
    for part in (
        "std_msgs/Header",
        "builtin_interfaces/Time",
        "geometry_msgs/Twist",
        "geometry_msgs/Vector3",
    ):
        assert f"MSG: {part}\n" in found.text
    assert found.hash.startswith("RIHS01_")
    assert types.definition(KINDS["service"]).text.startswith("---\nbool success")


def test_introspection_says_the_same_as_the_file() -> None:
    """Where a robot has no .msg files, the class gives the same fields in the same order."""
    assert introspected(Twist, "msg") == "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n"
    assert "uint8[] data\n" in introspected(Image, "msg")
    assert "POWER_SUPPLY_STATUS_FULL=4\n" in introspected(BatteryState, "msg")
    assert "rcl_interfaces/FloatingPointRange[<=1] floating_point_range\n" in introspected(
        ParameterDescriptor, "msg"
    )
    assert introspected(Trigger, "srv") == "---\nbool success\nstring message\n"


def test_commands_are_judged() -> None:
    """Zero stands, anything else moves, NaN and garbage are no commands; a header does not move."""
    judge = Types().judge
    moving, nan, stamped = Twist(), Twist(), TwistStamped()
    moving.angular.z = -0.1
    nan.linear.x = float("nan")
    stamped.header.stamp.sec = 5
    stamped.header.frame_id = "base"
    assert judge(TWIST, bytes(serialize_message(Twist()))) is Motion.STILL
    assert judge(TWIST, bytes(serialize_message(moving))) is Motion.MOVING
    assert judge(TWIST, bytes(serialize_message(nan))) is Motion.INVALID
    assert judge(TWIST, b"garbage") is Motion.INVALID
    assert judge(STAMPED, bytes(serialize_message(stamped))) is Motion.STILL


def test_interfaces_of_the_robot_are_known() -> None:
    """All installed types are named, each with a definition: actions in three parts, with a hash."""
    types = Types()
    names = types.names()
    assert names == sorted(set(names))
    assert {KINDS["action"], KINDS["message"], "switchboard_test_interfaces/srv/Everything"} <= set(names)
    for name in names:
        assert types.definition(name).type == name
    found = types.definition(KINDS["action"])
    assert found.text == "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n"
    assert found.hash.startswith("RIHS01_")
