"""A module that is a Python class, in its own process: settings, commands, feedback, stop. A real runner."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from robot_client.devices import Module, host
from tests.worlds.python_module import PythonModule
from tests.worlds.waiting import wait_for

ECHO = "tests.robot_client.devices.example_modules:Echo"


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., PythonModule]]:
    made: list[PythonModule] = []

    def begin(python: str = ECHO, **settings: Any) -> PythonModule:
        made.append(PythonModule(tmp_path, python, name=f"m{len(made)}", **settings))
        return made[-1]

    yield begin
    for each in made:
        each.kill()


def test_settings_commands_feedback_and_stop(start: Callable[..., PythonModule]) -> None:
    echo = start(greeting="hi").ready()
    # It counts as stopped until the daemon reports that it is not.
    echo.feeds_back(["hi", True])
    echo.feeds_back("from a thread")
    echo.daemon.send("stopped", stopped=False)
    echo.feeds_back(["stopped", False])
    assert echo.daemon.command("go") == ""
    echo.feeds_back(["command", "go", 1])
    assert echo.daemon.command(7) == "7 is not a text"
    # Commands don't reach what the module reads by itself.
    assert echo.daemon.command("read") == ""
    echo.feeds_back(["command", "", 1])
    assert echo.stop()["code"] == 0
    assert echo.texts()[-2:] == ["stopped in order", "stopped: exit code 0"]


def test_sender_that_leaves_is_reported_and_a_lost_daemon_stops_the_robot(
    start: Callable[..., PythonModule],
) -> None:
    echo = start().ready()
    other, watcher = echo.connect(), echo.connect()
    echo.daemon.send("stopped", stopped=False)
    echo.feeds_back(["stopped", False])
    assert other.command("go") == ""
    other.close()
    echo.feeds_back(["left", 2])
    watcher.send("listen")
    wait_for("it listens", lambda: watcher.command("go") == "" and watcher.feedback())
    echo.daemon.close()
    wait_for("the robot counts as stopped", lambda: ["stopped", True] in watcher.feedback())
    watcher.close()


def test_error_in_a_command_ends_the_module_with_a_traceback(start: Callable[..., PythonModule]) -> None:
    echo = start().ready()
    echo.daemon.send("command", id=1, value="crash")
    assert echo.ended()["error"] == "RuntimeError: it crashes"
    assert "RuntimeError: it crashes" in echo.texts()


def test_error_in_a_thread_of_its_own_ends_the_module_with_a_traceback(
    start: Callable[..., PythonModule],
) -> None:
    module = start("tests.robot_client.devices.example_modules:FailingThread").ready()
    module.daemon.send("command", id=1, value="go")
    assert module.ended()["error"] == "RuntimeError: the thread fails"
    assert {"starting …", "RuntimeError: the thread fails", "stopped in order"} <= set(module.texts())


FAILING = """
from robot_client.devices import Module

class Failing(Module):
    def __init__(self, where):
        self.where = where
        self.fail("constructor")

    def start(self):
        self.fail("start")

    def stop(self):
        self.fail("stop")

    def fail(self, here):
        if here == self.where:
            {error}
"""


@pytest.mark.parametrize("where", ["constructor", "start", "stop"])
@pytest.mark.parametrize(
    ("error", "text"),
    [
        ("open('/no/such')", "FileNotFoundError: [Errno 2] No such file or directory: '/no/such'"),
        ("raise AssertionError", "AssertionError"),
        (r"raise RuntimeError('first\nsecond')", "RuntimeError: first"),
        ("raise RuntimeError('x' * 1000)", f"RuntimeError: {'x' * 286}"),
    ],
    ids=["system", "no text", "lines", "long"],
)
def test_exception_of_a_module_is_named_in_its_end(
    start: Callable[..., PythonModule], tmp_path: Path, where: str, error: str, text: str
) -> None:
    (tmp_path / "failing.py").write_text(FAILING.format(error=error))
    module = start("failing:Failing", where=where, cwd=tmp_path)
    if where == "stop":
        module.ready().daemon.send("stop")
    assert module.ended()["error"] == text
    assert "Traceback (most recent call last):" in module.texts()


FILES = {
    "broken.py": "class Broken(",
    "needs.py": "import no_such_driver",
    "arm.py": """
from robot_client.devices import Module, host

class Arm(Module):
    def __init__(self, port, speed=1):
        if speed > 5:
            raise ValueError(f"speed = {speed} is more than 5")

class NoModule:
    pass
""",
}


@pytest.mark.parametrize(
    ("python", "settings", "text"),
    [
        ("no_such.arm:Arm", {}, "No module named 'no_such'; modules are looked for in folder = '{folder}'"),
        ("arm:Leg", {}, "python = 'arm:Leg': arm has no class 'Leg'"),
        ("arm:NoModule", {}, "is not a class that inherits robot_client.devices.Module"),
        ("broken:Broken", {}, "python = 'broken:Broken': SyntaxError: "),
        ("needs:Arm", {}, "python = 'needs:Arm': ModuleNotFoundError: No module named 'no_such_driver'"),
        ("arm:Arm", {}, "settings: missing a required argument: 'port'; Arm takes port, speed"),
        (
            "arm:Arm",
            {"port": "a", "volume": 3},
            "got an unexpected keyword argument 'volume'; Arm takes port, speed",
        ),
        ("arm:Arm", {"port": "a", "speed": 6}, "settings: speed = 6 is more than 5"),
    ],
)
def test_wrong_setting_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, python: str, settings: dict[str, Any], text: str
) -> None:
    for name, content in FILES.items():
        (tmp_path / name).write_text(content)
        monkeypatch.delitem(sys.modules, name.removesuffix(".py"), raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    with pytest.raises(host.WrongSetting, match=re.escape(text.format(folder=tmp_path))):
        host.create(host.load_class(python), settings)


def test_busy_module_gets_a_bounded_number_of_commands(start: Callable[..., PythonModule]) -> None:
    echo = start(term_after_s=0.5).ready()
    for number in range(1, 1003):
        echo.daemon.send("command", id=number, value="slow")
    assert "busy" in echo.daemon.answer(1002)
    echo.daemon.send("stop")
    # The first signal asks, the second ends at once.
    assert echo.ended()["signal"] == 15


def test_idle_module_uses_no_cpu(start: Callable[..., PythonModule]) -> None:
    echo = start().ready()
    processes = [psutil.Process(echo.pid()), psutil.Process(echo.process.pid)]

    def used() -> list[tuple[float, int]]:
        return [
            (each.cpu_times().user + each.cpu_times().system, each.num_ctx_switches().voluntary)
            for each in processes
        ]

    def settled() -> bool:
        found = used()
        time.sleep(0.2)
        return used() == found

    wait_for("it has settled", settled)
    before = used()
    time.sleep(1.0)
    # Nothing polls: no process was even woken.
    assert used() == before


def test_module_has_no_public_names_beside_those_for_authors() -> None:
    """A gripper may have its own ``open`` and ``close``."""
    public = {name for name in dir(Module()) if not name.startswith("_")}
    override = {"start", "handle", "sender_left", "robot_stopped", "stop"}
    assert public == override | {"feedback", "call", "stopped", "sender"}


def test_feedback_that_is_no_json_or_too_long_is_refused() -> None:
    module = Module()
    for value in (object(), float("nan"), "x" * 70_000):
        with pytest.raises(ValueError, match=r"JSON|too long"):
            module.feedback(value)
