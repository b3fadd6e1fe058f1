"""Types of ROS 2 by name."""

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
from robot_client.platforms.base import Motion
from robot_client.platforms.ros2.motion import JOY
from robot_client.platforms.ros2.types import Types, introspected
from tests.robot_client.platforms.ends import STAMPED, TWIST

TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
MULTI_DOF = "trajectory_msgs/msg/MultiDOFJointTrajectory"
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
def test_what_is_made_of_a_service_or_an_action_is_a_message(kind: str, name: str, fields: set[str]) -> None:
    """As its publishers name it."""
    assert set(getattr(Types(), kind)(name).get_fields_and_field_types()) == fields


@pytest.mark.parametrize("name", ["Fibonacci_SendGoal", "Fibonacci_GetResult"])
def test_an_action_has_services(name: str) -> None:
    """They are no messages, and a message is none of them."""
    full = f"example_interfaces/action/{name}"
    assert Types().service(full).Request
    for found, other in ((Types().message, full), (Types().service, f"{full}_Request")):
        with pytest.raises(Invalid, match="is no type of "):
            found(other)


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


def test_a_stamped_command_is_judged_like_a_plain_one() -> None:
    """Its header may be any; a number that is none is no command."""
    moving, nan = TwistStamped(), TwistStamped()
    moving.header.frame_id = nan.header.frame_id = "base_link"
    moving.twist.linear.y = 0.1
    nan.twist.angular.x = float("inf")
    judge = Types().judge
    assert judge(STAMPED, bytes(serialize_message(moving))) is Motion.MOVING
    assert judge(STAMPED, bytes(serialize_message(nan))) is Motion.INVALID
    assert judge(STAMPED, bytes(serialize_message(moving))[:-8]) is Motion.INVALID


def test_a_joystick_rests_with_as_many_axes_and_buttons() -> None:
    """Whatever is pressed moves; zero has all of it let go, and the stamp of now."""
    types = Types()
    joy = Joy(axes=[0.0, 0.5], buttons=[0, 1, 0])
    joy.header.frame_id = "pad"
    body = bytes(serialize_message(joy))
    assert types.judge(JOY, body) is Motion.MOVING
    zero = types.zero(JOY, Time(sec=9), types.resting(JOY, body))
    assert types.judge(JOY, zero) is Motion.STILL
    said = deserialize_message(zero, Joy)
    assert (list(said.axes), list(said.buttons)) == ([0.0, 0.0], [0, 0, 0])
    assert (said.header.frame_id, said.header.stamp.sec) == ("pad", 9)
    assert types.judge(JOY, bytes(serialize_message(Joy(axes=[float("nan")])))) is Motion.INVALID
    assert types.judge(JOY, bytes(serialize_message(Joy(axes=[0.0], buttons=[1])))) is Motion.MOVING


def test_a_trajectory_moves_wherever_it_leads() -> None:
    """Also to zero; one without points does not, and that is what follows it."""
    types = Types()
    way = JointTrajectory(joint_names=["a"], points=[JointTrajectoryPoint(positions=[0.0])])
    body = bytes(serialize_message(way))
    assert types.judge(TRAJECTORY, body) is Motion.MOVING
    zero = types.zero(TRAJECTORY, Time(), types.resting(TRAJECTORY, body))
    assert types.judge(TRAJECTORY, zero) is Motion.STILL
    assert deserialize_message(zero, JointTrajectory).joint_names == ["a"]
    way.points[0].positions = [float("inf")]
    assert types.judge(TRAJECTORY, bytes(serialize_message(way))) is Motion.INVALID


def test_a_trajectory_of_bodies_moves_wherever_it_leads() -> None:
    """As that of joints does, though no number in it is any but zero; none of them may be endless."""
    types = Types()
    way = MultiDOFJointTrajectory(joint_names=["base"], points=[MultiDOFJointTrajectoryPoint()])
    way.header.frame_id = "map"
    body = bytes(serialize_message(way))
    assert types.judge(MULTI_DOF, body) is Motion.MOVING
    zero = types.zero(MULTI_DOF, Time(sec=9), types.resting(MULTI_DOF, body))
    assert types.judge(MULTI_DOF, zero) is Motion.STILL
    said = deserialize_message(zero, MultiDOFJointTrajectory)
    assert (said.joint_names, list(said.points)) == (["base"], [])
    assert (said.header.frame_id, said.header.stamp.sec) == ("map", 9)
    way.points[0].velocities = [Twist(linear=Vector3(x=float("nan")))]
    assert types.judge(MULTI_DOF, bytes(serialize_message(way))) is Motion.INVALID
    way.points[0].velocities = []
    way.points[0].transforms = [Transform(translation=Vector3(y=float("inf")))]
    assert types.judge(MULTI_DOF, bytes(serialize_message(way))) is Motion.INVALID


def test_zeros_of_a_velocity_are_all_alike() -> None:
    """Nothing of the command is needed for them."""
    assert Types().resting(TWIST, bytes(serialize_message(Twist()))) == b""


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
