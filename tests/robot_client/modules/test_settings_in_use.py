"""What the settings of a module do to its process, and what happens at the limit of memory: real processes."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.worlds.module_daemon_process import Daemon
from tests.worlds.waiting import wait_for

REPORT = """
import json, os, resource
names = "OWN", "ROS_DOMAIN_ID", "RMW_IMPLEMENTATION", "OF_THE_DAEMON"
print(json.dumps({
    **{name: os.environ.get(name) for name in names},
    "folder": os.getcwd(),
    "cpus": sorted(os.sched_getaffinity(0)),
    "nice": os.nice(0),
    "memory": resource.getrlimit(resource.RLIMIT_AS),
}))
"""


def test_settings_reach_the_process(
    start: Callable[..., Daemon], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of each module its own; without settings those of the daemon."""
    monkeypatch.setenv("OF_THE_DAEMON", "inherited")
    monkeypatch.setenv("ROS_DOMAIN_ID", "1")
    monkeypatch.delenv("RMW_IMPLEMENTATION", raising=False)
    command = [sys.executable, "-u", "-c", REPORT]
    cpu = max(os.sched_getaffinity(0))
    settings = {
        "environment": {"OWN": "a value"},
        "domain": 7,
        "rmw": "rmw_cyclonedds_cpp",
        "folder": str(tmp_path),
        "cpus": [cpu],
        "nice": 3,
        "memory_mb": 2048,
    }
    daemon = start({"name": "plain", "command": command}, {"name": "set", "command": command, **settings})
    for name in ("plain", "set"):
        wait_for(f"{name} has ended", lambda name=name: daemon.texts(name)[-1:] == ["exit code 0"])
    plain, own = json.loads(daemon.texts("plain")[0]), json.loads(daemon.texts("set")[0])
    inherited = {"OF_THE_DAEMON": "inherited"}
    assert plain == {
        **inherited,
        "OWN": None,
        "ROS_DOMAIN_ID": "1",
        "RMW_IMPLEMENTATION": None,
        "folder": str(Path.cwd()),
        "cpus": sorted(os.sched_getaffinity(0)),
        "nice": os.nice(0),
        "memory": [-1, -1],
    }
    assert own == {
        **inherited,
        "OWN": "a value",
        "ROS_DOMAIN_ID": "7",
        "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp",
        "folder": str(tmp_path),
        "cpus": [cpu],
        "nice": min(os.nice(0) + 3, 19),
        "memory": [2048 * 2**20] * 2,
    }
    daemon.end()


def test_exceeded_memory_limit_is_named_and_not_blamed_for_other_crashes(
    start: Callable[..., Daemon],
) -> None:
    limited = {"memory_mb": 2048, "restart": "never"}
    daemon = start(
        {"name": "eats", "command": [sys.executable, "-c", "print(len(bytearray(2**32)))"], **limited},
        {"name": "other", "command": [sys.executable, "-c", "raise SystemExit(3)"], **limited},
    )
    daemon.is_("failed", "eats")
    daemon.is_("failed", "other")
    short = "it reported that memory is short, of which it has memory_mb = 2048"
    assert set(daemon.alerts()) == {
        f"module eats stays down: exit code 1; {short}",
        "module other stays down: exit code 3",
    }
    daemon.end()


NOT_FOUND = "Package 'lidar' not found: no such package"
ECHO = "tests.robot_client.devices.example_modules:Echo"


def test_wrong_settings_of_each_kind_are_named_in_alerts(
    start: Callable[..., Daemon], tmp_path: Path
) -> None:
    """A program stands for ``ros2``, which prints this and ends with 1."""
    ros2 = tmp_path / "bin" / "ros2"
    ros2.parent.mkdir()
    ros2.write_text(f"#!{sys.executable}\nraise SystemExit({NOT_FOUND!r})\n")
    ros2.chmod(0o700)
    wrong: dict[str, tuple[dict[str, Any], str]] = {
        "program": ({"command": ["/no/such"]}, "/no/such: No such file or directory"),
        "folder": (
            {"command": ["true"], "folder": "/no/such"},
            "folder = '/no/such': No such file or directory",
        ),
        "class": (
            {"python": f"{ECHO}2"},
            f"python = '{ECHO}2': {ECHO.partition(':')[0]} has no class 'Echo2'",
        ),
        "argument": (
            {"python": ECHO, "settings": {"volume": 3}},
            "settings: got an unexpected keyword argument 'volume'; Echo takes greeting",
        ),
        "ros": (
            {"launch": ["lidar", "a.launch.py"], "environment": {"PATH": "/no/such"}},
            "ros2: No such file or directory; source ROS 2 before the daemon starts, or set PATH in its environment",
        ),
        "package": (
            {"launch": ["lidar", "a.launch.py"], "environment": {"PATH": str(ros2.parent)}},
            f"launch = ['lidar', 'a.launch.py']: {NOT_FOUND}",
        ),
    }
    daemon = start(*({"name": name, "restart": "never", **each} for name, (each, _) in wrong.items()))
    for name, (_, text) in wrong.items():
        daemon.is_("failed", name)
        assert f"module {name} stays down: {text}" in daemon.alerts()
    daemon.end()
