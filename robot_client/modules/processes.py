"""Processes of this machine, as far as modules need them, and how they are ended. From ``/proc``, see proc(5)."""

from __future__ import annotations

import os
import signal
import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

MARK = "SWITCHBOARD_MODULE_RUN"
"""Environment variable that all processes of one run of a module inherit; its value is the run's id."""

LAUNCH_MARK = "SWITCHBOARD_LAUNCH_RUN"
"""The same for one run of a launch file that a module starts by itself."""

FOLDER = "SWITCHBOARD_MODULES"
"""Environment variable of a module: the folder with a folder for each module of this robot."""

KILL_ROUNDS = 20
"""Most searches for processes that are forked while others are being stopped."""

TERM_SECONDS = 5.0
KILL_SECONDS = 10.0
"""Time from SIGINT to SIGTERM, and from there to SIGKILL; those of ``ros2 launch``."""


UNKILLABLE_SECONDS = 10.0
"""A process that still runs so long after SIGKILL can't be ended for now: a driver in the kernel does not return, or it
belongs to another user."""

KILL_PAUSE = 0.05
LONGEST_KILL_PAUSE = 5.0
"""Seconds between two attempts to kill what is left. The pause doubles while there is nothing new."""

NAMED_PROCESSES = 5
"""Most processes that are named in a text."""


class ProcessStat(NamedTuple):
    """Fields of ``/proc/PID/stat`` that are used.

    :param state: a letter; ``Z`` is a process that has ended
    :param session: id of its session, which is the pid of the process that began it
    :param busy: user and system time, clock ticks
    :param started: clock ticks after boot
    :param pages: in RAM
    """

    name: str
    state: str
    parent: int
    session: int
    busy: int
    nice: int
    threads: int
    started: int
    pages: int
    cpu_number: int

    @property
    def has_ended(self) -> bool:
        """Whether no thread runs any more. A process whose first thread has ended before others is a ``Z``, too."""
        return self.state == "Z" and self.threads <= 1


class ProcessSession(NamedTuple):
    """A session of processes, see setsid(2).

    :param id: pid of the process that began it
    :param started: when that process started, clock ticks after boot
    """

    id: int
    started: int

    @classmethod
    def begun_by(cls, pid: int) -> ProcessSession:
        """The session that a process, which runs or was not reaped yet, has begun."""
        stat = read_stat(pid)
        return cls(pid, stat.started if stat is not None else 0)

    def holds(self, stat: ProcessStat) -> bool:
        """Whether a process is in this session.

        The kernel gives a pid to another process only when its session has ended, so a leader with another start
        means another session.
        """
        if stat.session != self.id:
            return False
        leader = read_stat(self.id)
        return leader is None or leader.started == self.started


class RunProcesses(NamedTuple):
    """The processes that have been started in one run of a program, whatever became of their parents.

    :param session: that the program has begun; ``None`` if it is not known
    :param run: id of the run, unguessable
    :param mark: environment variable with this id, which they inherit
    """

    session: ProcessSession | None
    run: str
    mark: str = MARK

    def hold(self, pid: int) -> bool:
        """Whether a process runs and is one of them."""
        stat = read_stat(pid)
        if stat is None or stat.has_ended:
            return False
        return (self.session is not None and self.session.holds(stat)) or is_marked(pid, self.run, self.mark)


def boot_id() -> str:
    """Id of this boot of the machine; empty where the kernel has none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return ""


def descendants(pid: int) -> list[int]:
    """The children of a process, their children, and so on; without those that have ended."""
    children = children_by_parent()
    found: list[int] = []
    waiting = [pid]
    while waiting:
        of_parent = children.get(waiting.pop(), [])
        found += of_parent
        waiting += of_parent
    return found


def children_by_parent(zombies: bool = False) -> dict[int, list[int]]:
    """The children of all processes.

    :param zombies: whether those count that have ended, but were not reaped by their parent
    """
    children = defaultdict(list)
    for each in pids():
        stat = read_stat(each)
        if stat is not None and (zombies or not stat.has_ended):
            children[stat.parent].append(each)
    return children


def is_marked(pid: int, run: str, mark: str = MARK) -> bool:
    """Whether a process was started in one run of a module, whatever became of its parent.

    :param mark: name of the environment variable that says so
    """
    try:
        environment = Path(f"/proc/{pid}/environ").read_bytes()
    except OSError:
        return False
    return f"{mark}={run}".encode() in environment.split(b"\0")


class KillAttempts:
    """Kills processes again and again, until none is left. Some may not end, whatever is done.

    :param belongs: see :func:`kill_all`, also for ``rounds``
    :ivar unkillable: ids of those that have run for :data:`UNKILLABLE_SECONDS` since they were killed
    :ivar reason: that they can't be ended, in words; empty if there are none
    :ivar pause: seconds until the next attempt
    """

    def __init__(
        self,
        belongs: Callable[[int, set[int]], bool],
        rounds: int = KILL_ROUNDS,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.unkillable: list[int] = []
        self.reason = ""
        self._belongs = belongs
        self._rounds = rounds
        self._clock = clock
        self._killed_at: dict[int, float] = {}
        """By pid: when it was killed first."""
        self.pause = KILL_PAUSE

    def attempt(self) -> float | None:
        """Kill all that are left.

        :returns: seconds until the next attempt; ``None`` if none was left
        """
        left = kill_all(self._belongs, self._rounds)
        now = self._clock()
        self.pause = KILL_PAUSE if left - self._killed_at.keys() else min(2 * self.pause, LONGEST_KILL_PAUSE)
        self._killed_at = {pid: self._killed_at.get(pid, now) for pid in left}
        unkillable = sorted(pid for pid, at in self._killed_at.items() if now - at >= UNKILLABLE_SECONDS)
        if unkillable != self.unkillable:
            self.unkillable, self.reason = unkillable, _unkillable_text(unkillable)
        return self.pause if left else None


def _unkillable_text(pids: list[int]) -> str:
    if not pids:
        return ""
    named = ", ".join(_described(pid) for pid in pids[:NAMED_PROCESSES])
    more = f" and {len(pids) - NAMED_PROCESSES} more" if len(pids) > NAMED_PROCESSES else ""
    one = len(pids) == 1
    return f"{'process' if one else 'processes'} {named}{more} still {'runs' if one else 'run'} after SIGKILL"


def _described(pid: int) -> str:
    stat = read_stat(pid)
    if stat is None:
        return str(pid)
    try:
        os.kill(pid, 0)
    except PermissionError:
        return f"{pid} ({stat.name}, of another user)"
    except ProcessLookupError:
        pass
    return f"{pid} ({stat.name}, state {stat.state})"


def kill_all(belongs: Callable[[int, set[int]], bool], rounds: int = KILL_ROUNDS) -> set[int]:
    """Kill processes, also those that fork all the time.

    They are all stopped before the first one is killed: what stands still does not fork, and what a limit of processes
    or a program's own counter allows stays used up.

    :param belongs: whether to kill a process; it is also given those that have been stopped
    :param rounds: most searches for processes that have been forked meanwhile
    :returns: those that were killed now; call it until there are none
    """
    stopped: set[int] = set()
    seen: set[int] = set()
    for _ in range(rounds):
        before, found = len(stopped), pids()
        # The newest first: one that has a child and ends, again and again, lives for a moment only.
        for pid in sorted(found, reverse=True):
            if pid not in stopped and belongs(pid, stopped):
                send([pid], signal.SIGSTOP)
                stopped.add(pid)
        # A process that has ended since it was listed may have had a child meanwhile.
        if len(stopped) == before and seen.issuperset(found):
            break
        seen.update(found)
    send(stopped, signal.SIGKILL)
    return stopped


def stop_signals(term_after: float, kill_after: float) -> list[tuple[signal.Signals, float]]:
    """Signals that end a process, each with the seconds that it has before the next one; then comes SIGKILL."""
    return [(signal.SIGINT, term_after), (signal.SIGTERM, kill_after)]


def send(pids: Iterable[int], number: signal.Signals) -> None:
    """Send a signal to those that still run."""
    for pid in pids:
        with suppress(ProcessLookupError, PermissionError):
            os.kill(pid, number)


def pids() -> list[int]:
    """Ids of all processes of the machine."""
    return [int(each.name) for each in os.scandir("/proc") if each.name.isdigit()]


def read_stat(pid: int) -> ProcessStat | None:
    """Values of ``/proc/PID/stat``; ``None`` if there is no such process."""
    data = read_file(pid, "stat")
    if not data:
        return None
    # The name is in brackets and may hold any character, brackets too.
    opened, closed = data.index(b"("), data.rindex(b")")
    fields = data[closed + 2 :].split()
    return ProcessStat(
        name=data[opened + 1 : closed].decode(errors="replace"),
        state=fields[0].decode(),
        parent=int(fields[1]),
        session=int(fields[3]),
        busy=int(fields[11]) + int(fields[12]),
        nice=int(fields[16]),
        threads=int(fields[17]),
        started=int(fields[19]),
        pages=int(fields[21]),
        cpu_number=int(fields[36]),
    )


def read_file(pid: int, name: str) -> bytes:
    """The first 8 KiB of ``/proc/PID/NAME``; empty if there is no such process."""
    try:
        descriptor = os.open(f"/proc/{pid}/{name}", os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return b""
    try:
        return os.read(descriptor, 8192)
    except OSError:
        # It has ended meanwhile.
        return b""
    finally:
        os.close(descriptor)
