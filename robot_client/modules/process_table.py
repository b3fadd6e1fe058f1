"""Measures processes of the daemon and of the modules. From ``/proc``, see proc(5)."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Mapping
from pathlib import PurePosixPath

from relay_protocol import limits
from relay_protocol.link import ProcessInfo
from robot_client.modules.processes import ProcessStat, children_by_parent, read_file, read_stat

RESCAN_SECONDS = 1.0
"""New processes are found within this time; a scan reads all processes of the machine."""

CLOCK_STEP_SECONDS = 0.05
"""A clock that differs by more has been set; less is the time that a measurement takes."""

STATES = {
    "R": "running",
    "S": "sleeping",
    "D": "disk-sleep",
    "T": "stopped",
    "t": "tracing-stop",
    "Z": "zombie",
    "X": "dead",
    "I": "idle",
    "P": "parked",
}

COMMAND_WORDS = 12
"""Most arguments that are read to name a process."""

_NODE_NAME = re.compile(rb"\0__node:=(\w+)(?=\0)")
"""A launch file gives a node its name by this argument (ROS 2 design, Ros Command Line Arguments)."""
_PACKAGE = "robot_client."
_HOST = "robot_client.devices.host"
_DAEMON = "switchboard-robot"
_SERVICES = "switchboard-robot-service"
_INTERPRETER = re.compile(r"(python|pypy)[0-9.]*|sh|bash|dash")
_KERNEL_NAME = 15
"""The kernel cuts the names of processes off after so many bytes."""

_LONGEST_NAME = 64

_PAGE = os.sysconf("SC_PAGE_SIZE")
_TICKS = os.sysconf("SC_CLK_TCK")


def _uptime() -> float:
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class ProcessTable:
    """All processes below some roots.

    :param wall: Unix time, seconds
    :param uptime: seconds since the machine was started
    """

    def __init__(self, wall: Callable[[], float] = time.time, uptime: Callable[[], float] = _uptime) -> None:
        self._wall = wall
        self._uptime = uptime
        self._boot = 0.0
        """When the machine was started, Unix time, seconds."""
        self._scanned = -RESCAN_SECONDS
        self._parts: dict[int, str] = {}
        self._names: dict[tuple[int, str], str] = {}
        """By pid and the kernel's name; forgotten with each scan, as a process may run another program."""

    def measure(self, roots: Mapping[int, str]) -> tuple[list[ProcessInfo], int]:
        """Measure the roots and all their descendants now.

        :param roots: for the id of a process, the part of the robot that it and its descendants belong to
        :returns: the processes in the order of their ids, at most ``limits.PROCESSES``; how many there are beyond
        """
        now = self._uptime()
        if now - self._scanned >= RESCAN_SECONDS or not roots.keys() <= self._parts.keys():
            self._parts = self._scan(roots)
            self._scanned = now
            self._names.clear()
        boot = self._wall() - self._uptime()
        if abs(boot - self._boot) > CLOCK_STEP_SECONDS:
            # The first measurement, or NTP has set the clock.
            self._boot = boot
        rows: list[ProcessInfo] = []
        for pid in sorted(self._parts)[: limits.PROCESSES]:
            stat = read_stat(pid)
            if stat is not None:
                rows.append(self._row(pid, stat))
        return rows, max(0, len(self._parts) - limits.PROCESSES)

    def _scan(self, roots: Mapping[int, str]) -> dict[int, str]:
        children = children_by_parent(zombies=True)
        parts = dict(roots)
        waiting = list(roots)
        while waiting:
            parent = waiting.pop()
            for child in children.get(parent, []):
                if child not in parts:
                    parts[child] = parts[parent]
                    waiting.append(child)
        return parts

    def _row(self, pid: int, stat: ProcessStat) -> ProcessInfo:
        uptime = self._uptime()
        voluntary, involuntary = self._switches(pid)
        return ProcessInfo(
            pid=pid,
            parent=stat.parent,
            name=self._name(pid, stat.name),
            part=self._parts[pid],
            state=STATES.get(stat.state, stat.state),
            busy=stat.busy / _TICKS,
            read_at=round(uptime, 4),
            cpu_number=stat.cpu_number,
            nice=stat.nice,
            threads=stat.threads,
            voluntary=voluntary,
            involuntary=involuntary,
            created=round(self._boot + stat.started / _TICKS, 2),
            memory=stat.pages * _PAGE,
        )

    def _name(self, pid: int, kernel_name: str) -> str:
        name = self._names.get((pid, kernel_name))
        if name is None:
            name = self._names[pid, kernel_name] = _shown_name(kernel_name, read_file(pid, "cmdline"))
        return name

    @staticmethod
    def _switches(pid: int) -> tuple[int, int]:
        data = read_file(pid, "status")
        found = data.rfind(b"voluntary_ctxt_switches:", 0, data.rfind(b"nonvoluntary"))
        if found < 0:
            return 0, 0
        numbers = data[found:].split()
        return int(numbers[1]), int(numbers[3])


def _shown_name(kernel_name: str, command: bytes) -> str:
    """What a process runs. A node that a launch file has named comes with its name: ``front (camera_node)``."""
    program = program_name(kernel_name, command.decode(errors="replace").split("\0")[:COMMAND_WORDS])
    node = _NODE_NAME.search(command)
    return f"{node[1].decode()} ({program})"[:_LONGEST_NAME] if node else program


def program_name(kernel_name: str, command: list[str]) -> str:
    """What a process runs: for ``python -m my_robot.base`` that is ``my_robot.base``, not ``python``.

    Arguments are left out, as they may hold secrets; a service of Switchboard has its own name,
    a class its class's name.

    :param kernel_name: as in ``/proc/PID/stat``
    :param command: the program and its arguments
    """
    program = PurePosixPath(command[0]).name if command else ""
    if _INTERPRETER.fullmatch(program):
        # A process that has named itself keeps that name.
        named_itself = not _INTERPRETER.fullmatch(kernel_name) and kernel_name not in _scripts(command)
        name = kernel_name if named_itself else _interpreted(command[1:]) or program
    elif len(kernel_name) == _KERNEL_NAME and program.startswith(kernel_name):
        name = program
    else:
        name = kernel_name
    return name[:_LONGEST_NAME]


def _scripts(command: list[str]) -> set[str]:
    """Kernel names of a script that was started by its ``#!`` line."""
    return {PurePosixPath(each).name[:_KERNEL_NAME] for each in command[1:]}


def _interpreted(arguments: list[str]) -> str:
    """Name of a script or Python module by the arguments of its interpreter; empty if there is none."""
    for number, each in enumerate(arguments):
        following = arguments[number + 1] if number + 1 < len(arguments) else ""
        if each == "-m":
            is_class = following == _HOST and number + 2 < len(arguments)
            return arguments[number + 2].rpartition(":")[2] if is_class else following.removeprefix(_PACKAGE)
        if each == "-c":
            return ""
        if not each.startswith("-"):
            script = PurePosixPath(each).name
            if script == _SERVICES and following.isalpha():
                return following
            return f"{script} {following}" if script == _DAEMON and following.isalpha() else script
    return ""
