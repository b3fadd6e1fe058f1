"""A launch file that a module starts, with a program that prints and behaves as ``ros2 launch`` does."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from robot_client.devices import LaunchFile
from robot_client.modules import processes
from tests.worlds.module_daemon_process import has_ended
from tests.worlds.waiting import wait_for

FAKE = f"""#!{sys.executable}
import signal, subprocess, sys, time
print("[INFO] [launch]: arguments", *sys.argv[1:], flush=True)
arguments = dict(each.split(":=") for each in sys.argv[4:])
code, more = "import time; time.sleep(600)", dict()
if "session" in arguments:
    code = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN); signal.alarm(600); signal.pause()"
    more = dict(start_new_session=True)
nodes = [subprocess.Popen([sys.executable, "-c", code], **more) for _ in range(2)]
for number, node in enumerate(nodes, 1):
    print("[INFO] [node-%d]: process started with pid [%d]" % (number, node.pid), flush=True)
if "stubborn:=yes" in sys.argv:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("[INFO] [launch]: up", flush=True)
code = nodes[0].wait()
print("[ERROR] [node-1]: process has died [pid %d, exit code %d, cmd 'a']" % (nodes[0].pid, code), flush=True)
print("x" * int(arguments.get("writes", 0)), flush=True)
print("all is written", flush=True)
nodes[1].wait()
"""


class Launched:
    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        for name in ("TERM_SECONDS", "KILL_SECONDS"):
            monkeypatch.setattr(f"robot_client.modules.processes.{name}", 0.3)
        self.died: list[tuple[str, int]] = []
        self.ended: list[int] = []
        program = folder / "ros2"
        program.write_text(FAKE)
        program.chmod(0o700)
        monkeypatch.setenv("PATH", str(folder))
        self.made: list[LaunchFile] = []

    def __call__(self, **arguments: str) -> LaunchFile:
        self.made.append(LaunchFile("pack", "file.launch.py", arguments, self.note_death, self.ended.append))
        self.made[-1].start()
        wait_for("two nodes", lambda: len(self.made[-1].nodes) == 2)
        return self.made[-1]

    def note_death(self, node: str, code: int) -> None:
        self.died.append((node, code))


@pytest.fixture
def launched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Launched]:
    made = Launched(tmp_path, monkeypatch)
    yield made
    for each in made.made:
        each.stop()


def test_nodes_are_known_and_a_death_is_reported(
    launched: Launched, capfd: pytest.CaptureFixture[str]
) -> None:
    launch = launched(map="hall.yaml")
    assert launch.running
    psutil.Process(launch.nodes["node-1"]).kill()
    wait_for("its death is reported", lambda: launched.died == [("node-1", -9)])
    assert list(launch.nodes) == ["node-2"]
    assert "pack file.launch.py map:=hall.yaml" in capfd.readouterr().out


def test_callback_that_fails_is_printed_and_the_output_is_read_on(
    launched: Launched, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """More output than a pipe holds: the launch would stand still."""

    def fail(node: str, code: int) -> None:
        raise KeyError(f"no place for {node}")

    monkeypatch.setattr(launched, "note_death", fail)
    launch = launched(writes="200000")
    psutil.Process(launch.nodes["node-1"]).kill()
    printed = ""

    def read_on() -> bool:
        nonlocal printed
        out, err = capfd.readouterr()
        printed += out + err
        return "all is written" in printed

    wait_for("all output", read_on)
    assert "KeyError: 'no place for node-1'" in printed


@pytest.mark.parametrize("stubborn", ["yes", "no"])
def test_stop_leaves_no_process(launched: Launched, stubborn: str) -> None:
    launch = launched(stubborn=stubborn)
    pids = list(launch.nodes.values())
    launch.stop()
    assert not launch.running and launch.nodes == {}
    wait_for("all have ended", lambda: not any(psutil.pid_exists(each) for each in pids))
    launch.start()
    assert launch.running


def test_stop_ends_nodes_that_began_a_session(launched: Launched) -> None:
    launch = launched(session="own")
    pids = list(launch.nodes.values())
    launch.stop()
    assert [each for each in pids if not has_ended(each)] == []
    assert launched.ended == []


def test_launch_that_dies_is_reported_and_leaves_no_process(launched: Launched) -> None:
    launch = launched(session="own")
    node = psutil.Process(launch.nodes["node-1"])
    node.parent().kill()
    wait_for("its end is reported", lambda: launched.ended == [-9])
    assert has_ended(node.pid)
    assert not launch.running and launch.nodes == {}
    launch.start()
    wait_for("two nodes", lambda: len(launch.nodes) == 2)


def test_launch_is_not_started_beside_a_node_that_can_not_be_ended(
    launched: Launched, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SIGKILL does not reach the node, as one that waits for a driver in the kernel."""
    monkeypatch.setattr(processes, "UNKILLABLE_SECONDS", 0.3)
    launch = launched(session="own")
    node = psutil.Process(launch.nodes["node-1"])
    send = processes.send
    monkeypatch.setattr(
        processes, "send", lambda pids, number: send([each for each in pids if each != node.pid], number)
    )
    node.parent().kill()
    wait_for("its end is reported", lambda: launched.ended == [-9])
    assert not has_ended(node.pid)
    with pytest.raises(RuntimeError, match=rf"still run: {node.pid}; end them first"):
        launch.start()
    assert not launch.running
    node.kill()
    wait_for("the end of the node", lambda: has_ended(node.pid))
    launch.start()
    wait_for("two nodes", lambda: len(launch.nodes) == 2)


def test_missing_program_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FileNotFoundError):
        LaunchFile("pack", "file.launch.py").start()
