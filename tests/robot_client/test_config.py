"""Settings from defaults, file and environment."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from relay_protocol.errors import Invalid
from robot_client.config import RobotSettings, load
from robot_client.motion.rules import rules_of
from robot_client.motion.watchdog import CommandTimes

POSE = "geometry_msgs/msg/PoseStamped"


def test_defaults() -> None:
    settings = load(None, {})
    assert settings == RobotSettings()
    assert settings.safety.policy.stop_within_ms == 500
    assert settings.safety.ramp_ms == 0
    assert settings.safety.policy.types == [
        "geometry_msgs/msg/Twist",
        "geometry_msgs/msg/TwistStamped",
        "sensor_msgs/msg/Joy",
        "trajectory_msgs/msg/JointTrajectory",
        "trajectory_msgs/msg/MultiDOFJointTrajectory",
        "control_msgs/msg/JointJog",
    ]


def test_variables_override_the_file(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text('[safety]\nstop_within_ms = 300\nmotion_topics = ["/arm"]\n[ros]\nexecutor = "single"\n')
    settings = load(file, {"SWITCHBOARD_ROBOT_SAFETY_STOP_WITHIN_MS": "200", "PATH": "/bin"})
    assert settings.safety.stop_within_ms == 200
    assert settings.safety.motion_topics == ["/arm"]
    assert settings.ros.executor == "single"


def test_lists_in_variables_have_commas() -> None:
    settings = load(None, {"SWITCHBOARD_ROBOT_SAFETY_MOTION_TOPICS": "/a, /b"})
    assert settings.safety.motion_topics == ["/a", "/b"]


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[safety]\nstop_within = 3\n", "stop_within"),
        ("[safty]\n", "safty"),
        ("guard = false\n", "guard"),
        ("[safety]\nstop_within_ms = 1\n", "stop_within_ms"),
        ('[ros]\nexecutor = "fast"\n', "executor"),
        ("[safety\n", "not TOML"),
        ('[cameras]\n"a b" = "/film.mp4"\n', "a b"),
        ('[cameras]\nusb = "video0"\n', "v4l2:/dev/video0"),
        ('[cameras]\nusb = "v4l2:/dev/video0?width=1280"\n', "usb: set both width and height"),
        ("[video]\nmax_streams = 0\n", "max_streams"),
        ("[video]\nmax_streams = 17\n", "max_streams"),
        ("[video]\ntarget_delay_ms = 49\n", "target_delay_ms"),
        ("[video]\ntarget_delay_ms = 5001\n", "target_delay_ms"),
        ("[limits]\nlinear = 0\n", "linear"),
        ("[limits]\nviewer = { linear = 1 }\n", "viewer"),
        ("[limits.owner]\nlinar = 1\n", "linar"),
        ('[limits]\nunlimited = ["a b"]\n', "unlimited: 'a b'"),
        ('[limits.operator]\nunlimited = ["/joy"]\n', "unlimited"),
        ("[safety]\nstop_within_ms = 9000\nramp_ms = 2001\n", r"<= 2000.*safety\.ramp_ms"),
        ("[safety]\nramp_ms = 251\n", "at most half of stop_within_ms, which is 500"),
        ('[safety]\nramp_ms = 101\ntopic = [{name="a", stop_within_ms=200}]\n', "which is 200"),
        ('[[safety.topic]]\nname = "/arm"\nstop_within_ms = 501\n', "longer than the robot's"),
        ('[[safety.topic]]\nname = "/arm"\ndeadline_ms = 501\n', "longer than the robot's"),
        ('[[safety.topic]]\nname = "/arm"\n[[safety.topic]]\nname = "arm"\n', "twice"),
        ('[[safety.topic]]\nname = "a b"\n', "a b"),
    ],
)
def test_errors_name_the_wrong_setting(tmp_path: Path, text: str, named: str) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(text)
    with pytest.raises(Invalid, match=named):
        load(file, {})


def test_cameras_are_named_like_topics(tmp_path: Path) -> None:
    """A leading / may be missing."""
    file = tmp_path / "robot.toml"
    file.write_text(
        '[cameras]\nusb = "v4l2:/dev/video0"\n"/gate/left" = "rtsp://gate/1"\n'
        "[video]\nmax_streams = 3\ntarget_delay_ms = 150\n"
    )
    settings = load(file, {})
    assert settings.cameras == {"/usb": "v4l2:/dev/video0", "/gate/left": "rtsp://gate/1"}
    assert (settings.video.max_streams, settings.video.target_delay_ms) == (3, 150)


def test_device_may_have_a_requested_format(tmp_path: Path) -> None:
    source = "v4l2:/dev/video0?width=1280&height=720&fps=30&format=MJPG"
    file = tmp_path / "robot.toml"
    file.write_text(f'[cameras]\nusb = "{source}"\n')
    assert load(file, {}).cameras == {"/usb": source}


def test_address_of_a_camera_is_not_reported(tmp_path: Path) -> None:
    """It may contain a password."""
    file = tmp_path / "robot.toml"
    file.write_text('[cameras]\ngate = "RTSP://ann:s3cret@gate/1"\n')
    with pytest.raises(Invalid, match="source of gate") as caught:
        load(file, {})
    assert "s3cret" not in str(caught.value)


def test_unknown_variable_is_named() -> None:
    """With the known ones."""
    with pytest.raises(Invalid, match=r"SWITCHBOARD_ROBOT_SAFTY_GUARD.*SWITCHBOARD_ROBOT_SAFETY_GUARD"):
        load(None, {"SWITCHBOARD_ROBOT_SAFTY_GUARD": "1"})


def test_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(Invalid, match="can't be read"):
        load(tmp_path / "none.toml", {})


def test_short_names_of_types_and_topics_are_completed() -> None:
    settings = load(
        None,
        {
            "SWITCHBOARD_ROBOT_SAFETY_MOTION_TYPES": "geometry_msgs/Twist",
            "SWITCHBOARD_ROBOT_SAFETY_MOTION_TOPICS": "cmd_vel, arm/joints",
        },
    )
    assert settings.safety.policy.types == ["geometry_msgs/msg/Twist"]
    assert settings.safety.policy.topics == ["/cmd_vel", "/arm/joints"]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("motion_types", "Twist"),
        ("motion_types", "std_srvs/srv/Trigger"),
        ("motion_topics", "cmd vel"),
        ("motion_topics", "/cmd_vel/"),
        ("motion_topics", "//arm"),
        ("motion_services", "/arm/*/"),
        ("motion_services", "/arm/[xy"),
        ("motion_actions", "go there"),
        ("goal_topics", "/goal_pose/"),
    ],
)
def test_types_and_topics_that_match_nothing_are_refused(tmp_path: Path, key: str, value: str) -> None:
    """The robot would have no watchdog."""
    file = tmp_path / "robot.toml"
    file.write_text(f'[safety]\n{key} = ["{value}"]\n')
    with pytest.raises(Invalid, match=key):
        load(file, {})


def test_simulated_time_is_a_setting(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("[ros]\nuse_sim_time = true\n")
    assert not load(None, {}).ros.use_sim_time
    assert load(file, {}).ros.use_sim_time
    assert load(None, {"SWITCHBOARD_ROBOT_ROS_USE_SIM_TIME": "true"}).ros.use_sim_time


def test_topic_with_times_of_its_own_is_a_motion_topic(tmp_path: Path) -> None:
    """Missing times are the robot's."""
    file = tmp_path / "robot.toml"
    file.write_text(
        '[safety]\nmotion_topics = ["/arm"]\n'
        '[[safety.topic]]\nname = "arm"\nstop_within_ms = 200\n'
        '[[safety.topic]]\nname = "/gripper"\ndeadline_ms = 100\n'
    )
    safety = load(file, {}).safety
    assert safety.policy.topics == ["/arm", "/gripper"]
    assert safety.times("/arm") == CommandTimes(200, 500)
    assert safety.times("/gripper") == CommandTimes(500, 100)
    assert safety.times("/cmd_vel") == CommandTimes(500, 500)


def test_limits_of_a_level_have_variables_too(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("[limits]\nlinear = 1\n[limits.operator]\nlinear = 0.5\nangular = 1.5\n")
    limits = load(file, {"SWITCHBOARD_ROBOT_LIMITS_OPERATOR_LINEAR": "0.25"}).limits
    assert (limits.linear, limits.operator.linear, limits.operator.angular) == (1.0, 0.25, 1.5)
    file.write_text("[limits]\noperator = 3\n")
    with pytest.raises(Invalid, match="operator"):
        load(file, {"SWITCHBOARD_ROBOT_LIMITS_OPERATOR_LINEAR": "0.25"})


def test_exempt_topics_are_given_like_motion_topics(tmp_path: Path) -> None:
    """By name or pattern."""
    file = tmp_path / "robot.toml"
    file.write_text('[limits]\nlinear = 1\nunlimited = ["joy", "*/arm"]\n')
    assert rules_of(load(file, {})).unlimited == ["/joy", "*/arm"]
    variable = {"SWITCHBOARD_ROBOT_LIMITS_UNLIMITED": "/a, /b"}
    assert rules_of(load(file, variable)).unlimited == ["/a", "/b"]
    assert rules_of(load(None, {})).unlimited == []


def test_tables_have_no_variables() -> None:
    with pytest.raises(Invalid, match="SAFETY_TOPIC is not a setting"):
        load(None, {"SWITCHBOARD_ROBOT_SAFETY_TOPIC": "/arm"})


def test_motion_may_be_named_by_patterns(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(
        '[safety]\nmotion_topics = ["arm/*", "*/cmd_vel"]\nmotion_services = ["/gripper/[oc]*"]\n'
    )
    policy = load(file, {}).safety.policy
    assert policy.moves_by_topic("/arm/left", "std_msgs/msg/String")
    assert policy.moves_by_topic("/base/cmd_vel", "x/msg/Y")
    assert policy.moves_by_service("/gripper/open")
    assert not policy.moves_by_service("/gripper/state")
    assert policy.moves_by_action("/navigate_to_pose")
    assert policy.moves_by_action("/left/follow_joint_trajectory")
    assert not policy.moves_by_action("/dock_is_free")


@pytest.mark.parametrize("namespace", ["", "/robot1", "/fleet/robot1"])
def test_actions_of_nav2_move_the_robot_in_every_namespace(namespace: str) -> None:
    """Not those that only compute or wait."""
    policy = load(None, {}).safety.policy
    for name in [
        "navigate_to_pose",
        "navigate_through_poses",
        "navigate_complete_coverage",
        "follow_waypoints",
        "follow_gps_waypoints",
        "follow_path",
        "follow_object",
        "drive_on_heading",
        "spin",
        "backup",
        "assisted_teleop",
        "dock_robot",
        "undock_robot",
        "follow_joint_trajectory",
    ]:
        assert policy.moves_by_action(f"{namespace}/{name}")
    for name in ("compute_path_to_pose", "compute_route", "smooth_path", "wait", "my_spin", "spin/state"):
        assert not policy.moves_by_action(f"{namespace}/{name}")


def test_goal_topics_are_reported_as_motion_but_not_stopped_by_zero(tmp_path: Path) -> None:
    safety = load(None, {}).safety
    for name in ("/goal_pose", "/robot1/goal_pose"):
        assert safety.reported_policy.moves_by_topic(name, POSE)
        assert not safety.policy.moves_by_topic(name, POSE)
    assert not safety.reported_policy.moves_by_topic("/initialpose", POSE)
    reported, own = safety.reported_policy, safety.policy
    assert (reported.actions, reported.types) == (own.actions, own.types)
    file = tmp_path / "robot.toml"
    file.write_text('[safety]\nmotion_topics = ["/arm"]\ngoal_topics = ["arm", "target"]\n')
    assert load(file, {}).safety.reported_policy.topics == ["/arm", "/target"]


def test_example_settings_keep_all_defaults(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs/operate/robot_settings.md").read_text()
    example = next(each for each in re.findall(r"```toml\n(.*?)```", text, re.DOTALL) if "[safety]" in each)
    file = tmp_path / "robot.toml"
    file.write_text(example)
    shown, default = load(file, {}).safety, load(None, {}).safety
    for key in ("motion_types", "motion_actions", "goal_topics"):
        assert getattr(shown, key) == getattr(default, key)


def test_hardware_switches_are_settings() -> None:
    """Programs need an absolute path."""
    settings = load(
        None,
        {
            "SWITCHBOARD_ROBOT_SAFETY_STOP_SERVICE": "estop",
            "SWITCHBOARD_ROBOT_SAFETY_STOP_COMMAND": "/usr/bin/relay, off",
        },
    )
    assert tuple(settings.safety.switches) == ("/estop", ["/usr/bin/relay", "off"], [])
    with pytest.raises(Invalid, match="stop_command"):
        load(None, {"SWITCHBOARD_ROBOT_SAFETY_STOP_COMMAND": "relay,off"})
    with pytest.raises(Invalid, match="stop_service"):
        load(None, {"SWITCHBOARD_ROBOT_SAFETY_STOP_SERVICE": "e stop"})


def test_directories_of_assets_are_absolute_paths() -> None:
    assert load(None, {}).assets.roots == []
    name = "SWITCHBOARD_ROBOT_ASSETS_ROOTS"
    assert load(None, {name: "/ws/src, /opt/meshes/"}).assets.roots == ["/ws/src", "/opt/meshes/"]
    for wrong in ("src", "~/ws/src", "/ws/../etc", "/", "//", "/.", "/a\0b"):
        with pytest.raises(Invalid, match="must be the absolute path of a directory"):
            load(None, {name: f"/ws/src,{wrong}"})
