"""Modules of the real daemon: settings, processes, alerts, and modules that outlive it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path

import psutil
import pytest
from click.testing import CliRunner

from relay_protocol import link
from robot_client.cli import main
from robot_client.modules import processes
from robot_client.modules.log_ring import LogRing, ModuleLogLine, read
from tests.robot_client.robot_process import Robot, until
from tests.worlds.fake_relay import FakeRelay
from tests.worlds.module_daemon_process import marked, runners
from tests.worlds.private_mounts import with_private_mounts

SETTINGS = f"""
[[module]]
name = "base"
command = ["{sys.executable}", "-u", "-c", "import time; print('base is up'); time.sleep(600)"]
term_after_s = 0.5
kill_after_s = 0.5
backoff_s = 0.1

[[module]]
name = "broken"
command = ["/no/such/driver"]
restarts = 1
backoff_s = 0.1

[[module]]
name = "last"
command = ["/no/such/driver"]
after = ["broken"]
"""


@pytest.fixture
def robot(tmp_path: Path, environment: dict[str, str]) -> Iterator[Robot]:
    with closing(FakeRelay()) as relay, closing(Robot(relay, tmp_path / "state", environment)) as made:
        made.enroll()
        yield made
        for run in (made.state / "modules").glob("*/spec.json"):
            processes.send(marked(run_id(run)), signal.SIGKILL)


def run_id(spec: Path) -> str:
    return str(json.loads(spec.read_text()).get("run"))


def pids(robot: Robot) -> list[int]:
    spec = robot.state / "modules" / "base" / "spec.json"
    return marked(run_id(spec)) if spec.exists() else []


def ordered(robot: Robot, *arguments: str) -> tuple[int, str]:
    """Exit code and output of ``switchboard-robot module``."""
    done = CliRunner().invoke(main, ["module", *arguments, "--state", str(robot.state)])
    return done.exit_code, done.output


def test_modules_of_the_daemon(robot: Robot, tmp_path: Path) -> None:
    """They start with it, a failure raises an alert, they outlive its death, and end with it."""
    config = tmp_path / "robot.toml"
    config.write_text(SETTINGS)
    daemon = robot.run("--config", str(config))
    control = robot.relay.register()
    until(lambda: len(pids(robot)) == 1)
    # A local order does not need the relay.
    assert ordered(robot, "stop", "base") == (0, "The daemon has accepted: stop base.\n")
    until(lambda: "stopped" in ordered(robot, "list")[1].splitlines()[0])
    assert pids(robot) == []
    assert ordered(robot, "start", "base")[0] == 0
    until(lambda: len(pids(robot)) == 1)
    assert ordered(robot, "start", "arm") == (
        1,
        "Error: the robot has no module 'arm'; it has base, broken, last\n",
    )
    until(lambda: "base is up" in [each.text for each in read(robot.state / "modules/base/log").lines])
    alert = control.expect(link.Alert)
    while alert.about != "broken" or "stays down" not in alert.text:
        alert = control.expect(link.Alert)
    assert (alert.kind, alert.text) == (
        "module",
        "module broken stays down: /no/such/driver: No such file or directory",
    )
    why = "why: it waits for broken (stays down: /no/such/driver: No such file or directory)"
    assert ordered(robot, "list")[1].splitlines()[-1].endswith(why)
    (before,) = pids(robot)
    daemon.kill()
    daemon.wait(10)
    later = robot.run("--config", str(config))
    robot.relay.register()
    assert pids(robot) == [before]
    later.send_signal(signal.SIGTERM)
    assert later.wait(30) == 0
    until(lambda: not pids(robot))


SIGNALLED = """
import os
from robot_client import cli, run
from robot_client.modules.supervisor import ModuleSupervisor

begin, build = ModuleSupervisor.start, run.build_ros_platform

def begin_modules(supervisor):
    begin(supervisor)
    os.kill(os.getpid(), {number})

def build_platform(*arguments):
    os.kill(os.getpid(), {number})
    return build(*arguments)

if {when!r} == "modules have begun":
    ModuleSupervisor.start = begin_modules
else:
    run.build_ros_platform = build_platform
cli.main(prog_name="switchboard-robot")
"""
"""A daemon that receives a signal while it starts."""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("when", ["ROS is imported", "modules have begun"])
def test_daemon_that_is_ended_while_it_starts_leaves_no_module(
    robot: Robot, tmp_path: Path, when: str, number: int
) -> None:
    """None of its own, and none of a daemon that was killed before it."""
    config, program = tmp_path / "robot.toml", tmp_path / "signalled.py"
    config.write_text(SETTINGS)
    if when == "ROS is imported":
        killed = robot.run("--config", str(config))
        until(lambda: "base is up" in [each.text for each in read(robot.state / "modules/base/log").lines])
        killed.kill()
        killed.wait(10)
        assert len(pids(robot)) == 1
    program.write_text(SIGNALLED.format(number=int(number), when=when))
    daemon = robot.start("run", "--config", str(config), program=str(program))
    assert daemon.wait(60) == 0, robot.log.read_text()
    until(lambda: not runners(robot.state))
    assert pids(robot) == []
    assert "Traceback" not in robot.log.read_text()


def test_second_daemon_of_a_state_folder_is_refused_and_disturbs_nothing(
    robot: Robot, tmp_path: Path
) -> None:
    """Other commands that use the folder work beside a daemon; after its death its modules hold no lock."""
    config = tmp_path / "robot.toml"
    config.write_text(SETTINGS)
    daemon = robot.run("--config", str(config))
    robot.relay.register()
    until(lambda: "base is up" in [each.text for each in read(robot.state / "modules/base/log").lines])
    (before,) = pids(robot)
    second = robot.run("--config", str(config))
    assert second.wait(60) == 1
    refusal = f"Error: another daemon runs with the state folder {robot.state}; stop it first"
    assert refusal in robot.log.read_text()
    assert pids(robot) == [before]
    assert f"PID {before}" in ordered(robot, "list")[1]
    shown = CliRunner().invoke(main, ["log", "base", "--state", str(robot.state)])
    assert "base is up" in shown.stdout
    process = robot.start(
        "enroll",
        *("--relay", robot.relay.address, "--robot", "r1", "--code", "-", "--replace"),
        stdin="code-2\n",
    )
    assert robot.relay.enroll().code == "code-2"
    assert process.wait(60) == 0
    third = robot.run("--config", str(config))
    assert third.wait(60) == 1
    children = psutil.Process(daemon.pid).children(recursive=True)
    assert before in [each.pid for each in children]
    for each in children:
        assert str(robot.state) not in open_paths(each.pid)
    daemon.kill()
    daemon.wait(10)
    assert pids(robot) == [before]
    later = robot.run("--config", str(config))
    robot.relay.register()
    assert pids(robot) == [before]
    later.send_signal(signal.SIGTERM)
    assert later.wait(30) == 0
    until(lambda: not pids(robot))


def open_paths(pid: int) -> list[str]:
    """What a process has open; nothing if it has ended."""
    paths = []
    with suppress(OSError):
        for each in Path(f"/proc/{pid}/fd").iterdir():
            with suppress(FileNotFoundError):  # closed meanwhile
                paths.append(str(each.readlink()))
    return paths


READ_ONLY = """
mkdir "$1" && cp -p "$0"/robot.* "$1" && mount -t tmpfs tmpfs "$0" && mount --make-private "$0" || exit 1
cp -p "$1"/robot.* "$0" && mount -o remount,ro "$0" || exit 1
for each in /tmp /var/tmp; do mount --bind "$each" "$each" && mount -o remount,ro,bind "$each" || exit 1; done
cd "$0"
export HOME="$0" ROS_LOG_DIR="$0/log"
shift
exec "$@"
"""
"""Runs a program whose state folder, temporary folders, home and folder of logs are read-only."""


def test_daemon_on_a_read_only_disk_dials_out_obeys_stop_and_reports_it(robot: Robot, tmp_path: Path) -> None:
    config = tmp_path / "robot.toml"
    config.write_text(SETTINGS)
    folders = [str(robot.state), str(tmp_path / "copy")]
    run = [
        sys.executable,
        "-m",
        "robot_client.cli",
        "run",
        "--state",
        str(robot.state),
        "--config",
        str(config),
    ]
    with subprocess.Popen(
        [*with_private_mounts(), "sh", "-c", READ_ONLY, *folders, *run],
        env=robot.environment,
    ) as daemon:
        try:
            control = robot.relay.register()
            texts: list[str] = []
            wanted = {
                f"the daemon can't write into its state folder {robot.state}: Read-only file system",
                "module base crashed: it can't be started: Read-only file system",
            }
            while not wanted <= set(texts):
                texts.append(control.expect(link.Alert).text)
            stopped = control.order(link.Stop(id=1, by="eve"))
            assert stopped.reason == "the stop can't be stored for the next start: Read-only file system"
            daemon.send_signal(signal.SIGTERM)
            assert daemon.wait(30) == 0
        finally:
            daemon.kill()


def test_a_log_is_shown(tmp_path: Path) -> None:
    """With levels; control characters are escaped."""
    folder = tmp_path / "modules" / "base" / "log"
    ring = LogRing(folder, 100_000)
    for number in range(3):
        ring.write(ModuleLogLine(0.0, "out", "warn", f"line {number}\x1b[2J"))
    done = CliRunner().invoke(main, ["log", "base", "--lines", "2", "--state", str(tmp_path)])
    assert done.exit_code == 0
    assert [each.split(maxsplit=2)[2] for each in done.stdout.splitlines()] == [
        "out warn  line 1\\x1b[2J",
        "out warn  line 2\\x1b[2J",
    ]


def test_cli_shows_earlier_lines_and_lines_of_a_level(tmp_path: Path) -> None:
    ring = LogRing(tmp_path / "modules" / "base" / "log", 100_000)
    for level in ("info", "error", "info", "warn", "info"):
        ring.write(ModuleLogLine(1_700_000_000.0, "out", level, f"line of {level}"))

    def shown(*more: str) -> tuple[list[str], str]:
        done = CliRunner().invoke(main, ["log", "base", "--state", str(tmp_path), *more])
        assert done.exit_code == 0, done.output
        return [each.split()[-1] for each in done.stdout.splitlines()], done.stderr

    assert shown("--level", "warn") == (["error", "warn"], "")
    lines, hint = shown("--lines", "2")
    assert lines == ["warn", "info"]
    assert hint.startswith("earlier lines: --before ")
    assert shown("--before", hint.split()[-1]) == (["info", "error", "info"], "")


@pytest.mark.parametrize("name", ["other", "../base", "base/log"])
def test_module_without_a_log_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / "modules" / "base" / "log").mkdir(parents=True)
    done = CliRunner().invoke(main, ["log", name, "--state", str(tmp_path)])
    assert done.exit_code == 1
    assert f"there is no log of '{name}'; modules with logs: base" in done.output
