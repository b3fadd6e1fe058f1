"""Measurements of real processes."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from relay_protocol import limits
from relay_protocol.link import ProcessInfo
from robot_client.modules import process_table as module
from robot_client.modules import processes
from robot_client.modules.process_table import ProcessTable, program_name

PARENT = """
import subprocess, sys
program = "print(flush=True); input()"
child = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
child.stdout.readline()
print(child.pid, flush=True)
input()
child.stdin.close()
child.wait()
"""


@contextmanager
def family() -> Iterator[tuple[int, int]]:
    """A process and its child."""
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert parent.stdout is not None
    try:
        yield parent.pid, int(parent.stdout.readline())
    finally:
        parent.communicate("\n")


def test_descendants_belong_to_the_part_of_their_root() -> None:
    with family() as (parent, child):
        rows, more = ProcessTable().measure({parent: "base"})
    assert {each.pid: (each.part, each.parent) for each in rows} == {
        parent: ("base", os.getpid()),
        child: ("base", parent),
    }
    assert more == 0
    assert all(each.memory > 0 and each.threads >= 1 and each.created > 1.6e9 for each in rows)


def test_a_descendant_may_be_a_root_of_its_own() -> None:
    with family() as (parent, child):
        rows, _ = ProcessTable().measure({parent: "daemon", child: "base"})
    assert {each.pid: each.part for each in rows} == {parent: "daemon", child: "base"}


def test_the_time_that_a_process_was_busy_comes_with_the_time_of_the_reading() -> None:
    table, me = ProcessTable(), os.getpid()

    def mine() -> ProcessInfo:
        return next(each for each in table.measure({me: "me"})[0] if each.pid == me)

    began, before = time.clock_gettime(time.CLOCK_BOOTTIME), mine()
    until = os.times().user + 0.2
    while os.times().user < until:
        pass
    after, ended = mine(), time.clock_gettime(time.CLOCK_BOOTTIME)
    # The kernel counts in ticks of 10 ms.
    assert 0.15 < after.busy - before.busy <= ended - began + 0.05
    assert began - 1e-4 <= before.read_at < after.read_at <= ended + 1e-4


def test_the_start_of_a_process_follows_a_clock_that_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    """As by NTP, some time after the daemon has started: with the next measurement, not with the next scan."""
    monkeypatch.setattr(module, "RESCAN_SECONDS", 1e9)
    monkeypatch.setattr(module, "CLOCK_STEP_SECONDS", 1e6)
    booted = 1e8
    table = ProcessTable(lambda: booted + time.clock_gettime(time.CLOCK_BOOTTIME))
    pid = os.getpid()

    def created() -> float:
        return next(each.created for each in table.measure({pid: "me"})[0] if each.pid == pid)

    first = created()
    booted += 1.0
    assert created() == first  # it does not tremble
    booted += 1e9
    assert created() - first == pytest.approx(1e9, abs=100)


def test_the_start_of_a_process_is_its_own() -> None:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, text=True) as program:
        (row,) = ProcessTable().measure({program.pid: "base"})[0]
        assert row.created == pytest.approx(psutil.Process(program.pid).create_time(), abs=1.5)
        program.communicate("\n")


def test_a_process_that_has_ended_is_left_out() -> None:
    table = ProcessTable()
    with family() as (parent, child):
        table.measure({parent: "base"})
    assert table.measure({parent: "base"}) == ([], 0)
    assert processes.read_stat(child) is None


def test_there_are_no_more_rows_than_a_message_may_have(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "PROCESSES", 1)
    with family() as (parent, _):
        rows, more = ProcessTable().measure({parent: "base"})
    assert (len(rows), more) == (1, 1)


@pytest.mark.parametrize("name", ["a (b) c", ") S 1 1", "(("])
def test_any_name_of_a_program_is_read(name: str) -> None:
    code = f"import sys; open('/proc/self/comm', 'w').write({name!r}); print(flush=True); input()"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as program:
        assert program.stdout is not None
        program.stdout.readline()
        rows, _ = ProcessTable().measure({program.pid: "base"})
        program.communicate("\n")
    assert [each.name for each in rows] == [name]
    assert rows[0].state in module.STATES.values()


def test_nodes_of_a_launch_file_have_their_own_names(tmp_path: Path) -> None:
    """By a program that starts two nodes of one executable, with the arguments that ``ros2 launch`` gives them."""
    camera, ros2 = tmp_path / "camera_node", tmp_path / "ros2"
    camera.write_text("import sys; print(flush=True); sys.stdin.read()")
    ros2.write_text(
        "import subprocess, sys\n"
        "for node in 'front', 'rear':\n"
        f"    subprocess.Popen([sys.executable, {str(camera)!r}, '--ros-args', '-r', '__node:=' + node])\n"
        "sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, str(ros2), "launch", "a", "b"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as launch:
        assert launch.stdout is not None
        for _ in range(2):
            launch.stdout.readline()
        rows, _ = ProcessTable().measure({launch.pid: "cameras"})
        launch.communicate()
    assert {each.name for each in rows} == {"ros2", "front (camera_node)", "rear (camera_node)"}
    assert {each.part for each in rows} == {"cameras"}


@pytest.mark.parametrize(
    ("kernel_name", "command", "name"),
    [
        ("python3", "/usr/bin/python3 -u -m my_robot.base --key 1", "my_robot.base"),
        ("python", "python -u -m robot_client.devices.host my_robot.arm:Arm", "Arm"),
        ("python", "python -m robot_client.modules.runner /folder", "modules.runner"),
        ("switchboard-rob", "/v/python /v/switchboard-robot run --state s", "switchboard-robot run"),
        (
            "switchboard-rob",
            "/v/python /v/switchboard-robot-service speech",
            "speech",
        ),
        ("switchboard-sim", "/v/python /v/switchboard-sim --world w", "switchboard-sim"),
        ("ros2", "/usr/bin/python3 /opt/ros/humble/bin/ros2 launch a b.py", "ros2"),
        ("python3.10", "python3.10 -c import secret", "python3.10"),
        ("my name", "python -m my_robot.base", "my name"),
        ("robot_state_pub", "/opt/ros/lib/robot_state_publisher --x", "robot_state_publisher"),
        ("lidar", "/opt/lidar --token secret", "lidar"),
        ("bash", "bash /opt/start.sh secret", "start.sh"),
        ("sh", "sh -c program secret", "sh"),
        ("zombie", "", "zombie"),
    ],
)
def test_a_process_is_named_after_its_program(kernel_name: str, command: str, name: str) -> None:
    assert program_name(kernel_name, command.split(" ")) == name
