"""ROS 2 types by name."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Transform, Twist, TwistStamped, Vector3
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import BatteryState, Image, Joy
from std_srvs.srv import Trigger
from trajectory_msgs.msg import (
    JointTrajectory,
    JointTrajectoryPoint,
    MultiDOFJointTrajectory,
    MultiDOFJointTrajectoryPoint,
)

from relay_protocol.errors import Invalid, NotFound
from robot_client.platforms.base import CommandEffect
from robot_client.platforms.ros2.command_classifier import JOY
from robot_client.platforms.ros2.types import Types, introspected
from tests.worlds.ros_endpoints import STAMPED, TWIST

TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
MULTI_DOF = "trajectory_msgs/msg/MultiDOFJointTrajectory"
KINDS = {
    "message": "std_msgs/msg/String",
    "service": "std_srvs/srv/Trigger",
    "action": "example_interfaces/action/Fibonacci",
}


@pytest.mark.parametrize(("kind", "other"), list(itertools.permutations(KINDS, 2)))
def test_type_of_one_kind_is_refused_as_another(kind: str, other: str) -> None:
    types = Types()
    getattr(types, kind)(KINDS[kind])
    with pytest.raises(Invalid, match=f"{KINDS[kind]} is not one of the "):
        getattr(types, other)(KINDS[kind])


@pytest.mark.parametrize(
    ("kind", "name", "fields"),
    [
        ("message", "std_srvs/srv/SetBool_Event", {"info", "request", "response"}),
        ("message", "std_srvs/srv/SetBool_Request", {"data"}),
        ("message", "example_interfaces/action/Fibonacci_FeedbackMessage", {"goal_id", "feedback"}),
        ("message", "example_interfaces/action/Fibonacci_Goal", {"order"}),
        ("message", "example_interfaces/action/Fibonacci_GetResult_Response", {"status", "result"}),
        ("message", "action_msgs/srv/CancelGoal_Event", {"info", "request", "response"}),
    ],
)
def test_derived_message_types_are_found(kind: str, name: str, fields: set[str]) -> None:
    assert set(getattr(Types(), kind)(name).get_fields_and_field_types()) == fields


@pytest.mark.parametrize("name", ["Fibonacci_SendGoal", "Fibonacci_GetResult"])
def test_services_of_an_action_are_found(name: str) -> None:
    full = f"example_interfaces/action/{name}"
    assert Types().service(full).Request
    for found, other in ((Types().message, full), (Types().service, f"{full}_Request")):
        with pytest.raises(Invalid, match="is not one of the "):
            found(other)


@pytest.mark.parametrize("kind", ["msg", "srv", "action"])
def test_only_packages_of_interfaces_are_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """Clients choose the names."""
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
def test_parts_of_a_service_have_no_definition(name: str) -> None:
    with pytest.raises(NotFound, match="is not installed on this robot"):
        Types().definition(name)


def test_definition_has_all_parts_and_hash() -> None:
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


def test_introspected_definition_equals_the_file() -> None:
    assert introspected(Twist, "msg") == "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n"
    assert "uint8[] data\n" in introspected(Image, "msg")
    assert "POWER_SUPPLY_STATUS_FULL=4\n" in introspected(BatteryState, "msg")
    assert "rcl_interfaces/FloatingPointRange[<=1] floating_point_range\n" in introspected(
        ParameterDescriptor, "msg"
    )
    assert introspected(Trigger, "srv") == "---\nbool success\nstring message\n"


def test_commands_are_classified() -> None:
    """Headers don't count."""
    judge = Types().classify_command
    moving, nan, stamped = Twist(), Twist(), TwistStamped()
    moving.angular.z = -0.1
    nan.linear.x = float("nan")
    stamped.header.stamp.sec = 5
    stamped.header.frame_id = "base"
    assert judge(TWIST, bytes(serialize_message(Twist()))) is CommandEffect.STILL
    assert judge(TWIST, bytes(serialize_message(moving))) is CommandEffect.MOVING
    assert judge(TWIST, bytes(serialize_message(nan))) is CommandEffect.INVALID
    assert judge(TWIST, b"garbage") is CommandEffect.INVALID
    assert judge(STAMPED, bytes(serialize_message(stamped))) is CommandEffect.STILL


def test_stamped_commands_are_classified_like_plain_ones() -> None:
    moving, nan = TwistStamped(), TwistStamped()
    moving.header.frame_id = nan.header.frame_id = "base_link"
    moving.twist.linear.y = 0.1
    nan.twist.angular.x = float("inf")
    judge = Types().classify_command
    assert judge(STAMPED, bytes(serialize_message(moving))) is CommandEffect.MOVING
    assert judge(STAMPED, bytes(serialize_message(nan))) is CommandEffect.INVALID
    assert judge(STAMPED, bytes(serialize_message(moving))[:-8]) is CommandEffect.INVALID


def test_zero_of_a_joystick_has_as_many_axes_and_buttons() -> None:
    types = Types()
    joy = Joy(axes=[0.0, 0.5], buttons=[0, 1, 0])
    joy.header.frame_id = "pad"
    body = bytes(serialize_message(joy))
    assert types.classify_command(JOY, body) is CommandEffect.MOVING
    zero = types.zero_command(JOY, Time(sec=9), types.zero_template(JOY, body))
    assert types.classify_command(JOY, zero) is CommandEffect.STILL
    said = deserialize_message(zero, Joy)
    assert (list(said.axes), list(said.buttons)) == ([0.0, 0.0], [0, 0, 0])
    assert (said.header.frame_id, said.header.stamp.sec) == ("pad", 9)
    assert (
        types.classify_command(JOY, bytes(serialize_message(Joy(axes=[float("nan")]))))
        is CommandEffect.INVALID
    )
    assert (
        types.classify_command(JOY, bytes(serialize_message(Joy(axes=[0.0], buttons=[1]))))
        is CommandEffect.MOVING
    )


def test_trajectory_with_points_moves() -> None:
    """Also to zero."""
    types = Types()
    way = JointTrajectory(joint_names=["a"], points=[JointTrajectoryPoint(positions=[0.0])])
    body = bytes(serialize_message(way))
    assert types.classify_command(TRAJECTORY, body) is CommandEffect.MOVING
    zero = types.zero_command(TRAJECTORY, Time(), types.zero_template(TRAJECTORY, body))
    assert types.classify_command(TRAJECTORY, zero) is CommandEffect.STILL
    assert deserialize_message(zero, JointTrajectory).joint_names == ["a"]
    way.points[0].positions = [float("inf")]
    assert types.classify_command(TRAJECTORY, bytes(serialize_message(way))) is CommandEffect.INVALID


def test_multi_dof_trajectory_with_points_moves() -> None:
    """Numbers must be finite."""
    types = Types()
    way = MultiDOFJointTrajectory(joint_names=["base"], points=[MultiDOFJointTrajectoryPoint()])
    way.header.frame_id = "map"
    body = bytes(serialize_message(way))
    assert types.classify_command(MULTI_DOF, body) is CommandEffect.MOVING
    zero = types.zero_command(MULTI_DOF, Time(sec=9), types.zero_template(MULTI_DOF, body))
    assert types.classify_command(MULTI_DOF, zero) is CommandEffect.STILL
    said = deserialize_message(zero, MultiDOFJointTrajectory)
    assert (said.joint_names, list(said.points)) == (["base"], [])
    assert (said.header.frame_id, said.header.stamp.sec) == ("map", 9)
    way.points[0].velocities = [Twist(linear=Vector3(x=float("nan")))]
    assert types.classify_command(MULTI_DOF, bytes(serialize_message(way))) is CommandEffect.INVALID
    way.points[0].velocities = []
    way.points[0].transforms = [Transform(translation=Vector3(y=float("inf")))]
    assert types.classify_command(MULTI_DOF, bytes(serialize_message(way))) is CommandEffect.INVALID


def test_velocities_need_no_zero_template() -> None:
    assert Types().zero_template(TWIST, bytes(serialize_message(Twist()))) == b""


def test_all_installed_types_have_definitions() -> None:
    types = Types()
    names = types.names()
    assert names == sorted(set(names))
    assert {KINDS["action"], KINDS["message"], "switchboard_test_interfaces/srv/Everything"} <= set(names)
    for name in names:
        assert types.definition(name).type == name
    found = types.definition(KINDS["action"])
    assert found.text == "int32 order\n---\nint32[] sequence\n---\nint32[] sequence\n"
    assert found.hash.startswith("RIHS01_")
