"""Settings of modules, and their errors."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from relay_protocol.errors import Invalid
from robot_client import config
from robot_client.modules.module_run import command_of, run_spec
from robot_client.modules.settings import ModuleSettings


def loaded(tmp_path: Path, text: str, environment: dict[str, str] | None = None) -> list[ModuleSettings]:
    path = tmp_path / "robot.toml"
    path.write_text(text)
    return config.load(path, environment or {}).module


def test_modules_are_read(tmp_path: Path) -> None:
    base, lidar = loaded(
        tmp_path,
        '[[module]]\nname = "base"\ncommand = ["/usr/bin/base", "--fast"]\ndomain = 7\n'
        '[[module]]\nname = "lidar"\nlaunch = ["lidar", "scan.launch.py", "rate:=10"]\nafter = ["base"]\n',
    )
    assert command_of(base) == ["/usr/bin/base", "--fast"]
    assert command_of(lidar) == ["ros2", "launch", "lidar", "scan.launch.py", "rate:=10"]
    assert run_spec(base, {"ROS_DOMAIN_ID": "1", "PATH": "/bin"}).environment == {
        "ROS_DOMAIN_ID": "7",
        "PATH": "/bin",
        "PYTHONUNBUFFERED": "1",
    }
    buffered = msgspec.structs.replace(base, environment={"PYTHONUNBUFFERED": ""})
    assert run_spec(buffered, {}).environment["PYTHONUNBUFFERED"] == ""


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ('name = "Base"\ncommand = ["a"]', "'Base' is not a name"),
        ('name = "../x"\ncommand = ["a"]', "is not a name"),
        *(
            (f'name = "{name}"\ncommand = ["a"]', f"'{name}' is reserved for a part of the robot itself")
            for name in ("daemon", "guard", "camera", "middleware", "processes")
        ),
        ('name = "a"', "give one of command, python and launch"),
        ('name = "a"\ncommand = ["a"]\nlaunch = ["p", "f"]', "give one of command, python and launch"),
        ('name = "a"\ncommand = ["a"]\npython = "a:B"', "give one of command, python and launch"),
        ('name = "a"\npython = "a.B"', "'a.B' is not a class; write 'package.module:Class'"),
        ('name = "a"\ncommand = ["a"]\nsettings = { a = 1 }', "settings are only for modules with python"),
        ('name = "a"\nlaunch = ["p"]', "a package and a launch file"),
        ('name = "a"\ncommand = ["a"]\nready_log = "("', "not a regular expression"),
        (
            'name = "a"\ncommand = ["a"]\nready_log = "x"\nready_topic = "/y"',
            "ready_log and ready_topic are given",
        ),
        ('name = "a"\ncommand = ["a"]\nready_topic = "x"', "ready_topic = 'x' is not absolute; write '/x'"),
        ('name = "a"\ncommand = ["a"]\nready_service = "x"', "ready_service = 'x' is not absolute"),
        ('name = "a"\ncommand = ["a"]\nready_lifecycle = "x"', "ready_lifecycle = 'x' is not absolute"),
        ('name = "a"\ncommand = ["a"]\nafter = ["b"]', "comes after 'b', which is missing"),
        ('name = "a"\ncommand = ["a"]\nafter = ["a"]', "wait for each other: a → a"),
        ('name = "a"\ncommand = ["a"]\n[[module]]\nname = "a"\ncommand = ["a"]', "module a is named twice"),
        ('name = "a"\ncommand = ["a"]\nnice = 20', "<= 19"),
        ('name = "a"\ncommand = ["a"]\nenvironment = { "A B" = "c" }', "'A B' is not the name of a variable"),
        ('name = "a"\ncommand = ["a"]\nspeed = 1', "speed"),
    ],
)
def test_errors_name_the_wrong_setting(tmp_path: Path, text: str, named: str) -> None:
    with pytest.raises(Invalid, match=named):
        loaded(tmp_path, f"[[module]]\n{text}\n")


TOPIC = 'ready_topic = "/scan"'


@pytest.mark.parametrize("ready", [TOPIC, 'ready_service = "/map"', 'ready_lifecycle = "/arm"'])
@pytest.mark.parametrize(
    ("setting", "daemon", "named"),
    [
        ("domain = 7", {}, "needs the domain of the daemon, 0, which looks for it; the module has domain 7"),
        ("domain = 7", {"ROS_DOMAIN_ID": "3"}, "domain of the daemon, 3, .* the module has domain 7"),
        ('environment = { ROS_DOMAIN_ID = "7" }', {}, "the module has domain 7"),
        ("domain = 0", {"ROS_DOMAIN_ID": "3"}, "domain of the daemon, 3, .* the module has domain 0"),
        (
            'rmw = "rmw_zenoh_cpp"',
            {},
            "needs the rmw of the daemon, rmw_fastrtps_cpp, .* has rmw rmw_zenoh_cpp",
        ),
        ('environment = { RMW_IMPLEMENTATION = "rmw_zenoh_cpp" }', {}, "the module has rmw rmw_zenoh_cpp"),
    ],
)
def test_module_is_refused_that_could_never_be_seen_to_be_ready(
    tmp_path: Path, setting: str, daemon: dict[str, str], ready: str, named: str
) -> None:
    with pytest.raises(Invalid, match=f"module a: {ready.split()[0]} .*{named}"):
        loaded(tmp_path, f'[[module]]\nname = "a"\ncommand = ["a"]\n{setting}\n{ready}\n', daemon)


@pytest.mark.parametrize(
    ("settings", "daemon"),
    [
        (f"domain = 7\n{TOPIC}", {"ROS_DOMAIN_ID": "7"}),
        (f"domain = 0\n{TOPIC}", {}),
        (f"domain = 0\n{TOPIC}", {"ROS_DOMAIN_ID": ""}),
        (f'rmw = "rmw_fastrtps_cpp"\n{TOPIC}', {}),
        (f'rmw = "rmw_zenoh_cpp"\n{TOPIC}', {"RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}),
        ('domain = 7\nready_log = "up"', {}),
        ("domain = 7", {}),
    ],
)
def test_module_may_have_a_domain_of_its_own_where_the_daemon_can_see_it(
    tmp_path: Path, settings: str, daemon: dict[str, str]
) -> None:
    loaded(tmp_path, f'[[module]]\nname = "a"\ncommand = ["a"]\n{settings}\n', daemon)
