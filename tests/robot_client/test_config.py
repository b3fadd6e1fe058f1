"""Settings from file and environment."""

from __future__ import annotations

from pathlib import Path

import pytest

from relay_protocol.errors import Invalid
from robot_client.config import Settings, load


def test_without_anything_the_defaults_hold() -> None:
    """No file and no variables give the defaults: stop within 500 ms, Twist and TwistStamped are motion."""
    settings = load(None, {})
    assert settings == Settings()
    assert settings.safety.policy.stop_within_ms == 500
    assert settings.safety.policy.types == ["geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"]


def test_environment_beats_file(tmp_path: Path) -> None:
    """A variable overrides the same key of the file, other keys stay."""
    file = tmp_path / "robot.toml"
    file.write_text('[safety]\nstop_within_ms = 300\nmotion_topics = ["/arm"]\n[ros]\nexecutor = "single"\n')
    settings = load(file, {"SWITCHBOARD_ROBOT_SAFETY_STOP_WITHIN_MS": "200", "PATH": "/bin"})
    assert settings.safety.stop_within_ms == 200
    assert settings.safety.motion_topics == ["/arm"]
    assert settings.ros.executor == "single"


def test_lists_in_variables_have_commas() -> None:
    """A list in a variable is divided by commas."""
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
        ("[video]\nstreams = 0\n", "streams"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, named: str) -> None:
    """An unknown key, a value out of range, or a text that is no TOML is named in the error."""
    file = tmp_path / "robot.toml"
    file.write_text(text)
    with pytest.raises(Invalid, match=named):
        load(file, {})


def test_cameras_are_named_like_topics(tmp_path: Path) -> None:
    """With a leading / or without; what they are is kept as it is written."""
    file = tmp_path / "robot.toml"
    file.write_text(
        '[cameras]\nusb = "v4l2:/dev/video0"\n"/gate/left" = "rtsp://gate/1"\n[video]\nstreams = 3\n'
    )
    settings = load(file, {})
    assert settings.cameras == {"/usb": "v4l2:/dev/video0", "/gate/left": "rtsp://gate/1"}
    assert settings.video.streams == 3


def test_unknown_variable_is_named() -> None:
    """A variable of ours that is no setting is an error, with those that are."""
    with pytest.raises(Invalid, match=r"SWITCHBOARD_ROBOT_SAFTY_GUARD.*SWITCHBOARD_ROBOT_SAFETY_GUARD"):
        load(None, {"SWITCHBOARD_ROBOT_SAFTY_GUARD": "1"})


def test_missing_file_is_said(tmp_path: Path) -> None:
    """A settings file that is not there is an error in words."""
    with pytest.raises(Invalid, match="can't be read"):
        load(tmp_path / "none.toml", {})


def test_short_spellings_of_motion_are_made_full() -> None:
    """A type without its middle part and a topic without its slash count as what they mean."""
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
        ("motion_topics", "*"),
    ],
)
def test_motion_that_could_match_nothing_is_refused(tmp_path: Path, key: str, value: str) -> None:
    """A type or topic that no robot can have is refused by name: it would leave the robot without a watchdog."""
    file = tmp_path / "robot.toml"
    file.write_text(f'[safety]\n{key} = ["{value}"]\n')
    with pytest.raises(Invalid, match=key):
        load(file, {})


def test_simulated_time_is_a_setting(tmp_path: Path) -> None:
    """``use_sim_time`` can be set in the file and by a variable, and is off by default."""
    file = tmp_path / "robot.toml"
    file.write_text("[ros]\nuse_sim_time = true\n")
    assert not load(None, {}).ros.use_sim_time
    assert load(file, {}).ros.use_sim_time
    assert load(None, {"SWITCHBOARD_ROBOT_ROS_USE_SIM_TIME": "true"}).ros.use_sim_time
