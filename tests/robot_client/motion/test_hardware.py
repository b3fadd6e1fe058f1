"""Programs that stop the robot's hardware; services are tested in test_stop_hardware.py."""

from __future__ import annotations

import errno
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import Deferred
from twisted.internet.error import ProcessTerminated
from twisted.internet.task import Clock
from twisted.python.failure import Failure

from relay_protocol import link
from relay_protocol.errors import Unavailable
from robot_client.motion import hardware
from robot_client.motion.hardware import KILL_SECONDS, SWITCH_SECONDS, Hardware, Switches, run
from robot_client.platforms.base import GraphView
from tests.worlds.memory_platform import MemoryPlatform
from tests.worlds.robot_failures import broken
from tests.worlds.waiting import eventually

PYTHON = sys.executable
DONE, REFUSED = b"\0\1\0\0\1", b"\0\1\0\0" + bytes(9)
"""Answers of a service that stops the hardware, as CDR: a success as far as it is read, a failure without a word."""


class TimelessPrograms:
    """A reactor that runs real programs, however long they take: time passes only by its clock."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.callLater = self.clock.callLater
        real: Any = reactor
        self.spawnProcess = real.spawnProcess


@pytest_twisted.ensureDeferred
async def test_programs_are_run_with_their_arguments_and_no_shell(tmp_path: Path) -> None:
    """One at the stop, one at the resume; shell characters are passed literally."""
    note = "import pathlib, sys; pathlib.Path(sys.argv[1]).write_text(sys.argv[2])"
    out = str(tmp_path / "out")

    def content() -> str:
        return Path(out).read_text()

    switches = Switches("", [PYTHON, "-c", note, out, "$HOME; off"], [PYTHON, "-c", note, out, "on"])
    switch = Hardware(switches, MemoryPlatform(), TimelessPrograms())
    assert await switch.stop() == []
    assert content() == "$HOME; off"
    assert await switch.resume() == []
    assert content() == "on"


@pytest_twisted.ensureDeferred
async def test_failed_program_is_reported_with_its_last_line() -> None:
    """Its exit code, and the last line it wrote, harmless."""
    code = r"import sys; sys.exit('first\nno \x1b[31mpower')"
    switches = Switches(stop=[PYTHON, "-c", code])
    (problem,) = await Hardware(switches, MemoryPlatform(), TimelessPrograms()).stop()
    assert problem == rf"{PYTHON} ended with 1: no \x1b[31mpower"


@pytest_twisted.ensureDeferred
async def test_program_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """After its time it is killed, which is reported."""
    monkeypatch.setattr(hardware, "SWITCH_SECONDS", 0.2)
    with pytest.raises(Unavailable, match=r"did not end within 0\.2 s"):
        await run(reactor, [PYTHON, "-c", "import time; time.sleep(60)"])


@pytest_twisted.ensureDeferred
async def test_missing_program_is_reported() -> None:
    """It fails, and nothing waits."""
    (problem,) = await Hardware(Switches(stop=["/no/such/program"]), MemoryPlatform(), reactor).stop()
    assert problem.startswith("/no/such/program ")


@pytest_twisted.ensureDeferred
async def test_stop_in_the_middle_of_a_slow_resume_has_the_last_word(tmp_path: Path) -> None:
    """The switch is set at once, and again when the resume's program has ended; only then the stop is done."""
    out = tmp_path / "out"
    note = "import pathlib, sys; out = pathlib.Path(sys.argv[1]); out.open('a').write('s')"
    slow = "import pathlib, sys, time\nout = pathlib.Path(sys.argv[1])"
    slow += "\nwhile not (out.exists() and out.read_text()): time.sleep(0.01)"
    slow += "\nout.open('a').write('r')"
    stop, resume = ([PYTHON, "-c", code, str(out)] for code in (note, slow))
    switch = Hardware(Switches("", stop, resume), MemoryPlatform(), TimelessPrograms())
    resumed = switch.resume()
    assert await switch.stop() == []
    assert await resumed == []
    assert out.read_text() == "srs"


@pytest_twisted.ensureDeferred
async def test_stop_in_the_middle_of_a_resume_that_hangs_is_thrown_when_that_is_killed(
    tmp_path: Path,
) -> None:
    """The state left by a killed program is stopped too."""
    out = tmp_path / "out"
    note = "import pathlib, sys; pathlib.Path(sys.argv[1]).open('a').write(sys.argv[2])"
    hang = note + "; import time; time.sleep(600)"
    switches = Switches("", [PYTHON, "-c", note, str(out), "s"], [PYTHON, "-c", hang, str(out), "r"])
    programs = TimelessPrograms()
    switch = Hardware(switches, MemoryPlatform(), programs)
    resumed = switch.resume()
    stopped = switch.stop()
    await eventually("the resume has written", lambda: out.exists() and "r" in out.read_text())
    await eventually("the stop's program has ended", lambda: len(programs.clock.getDelayedCalls()) == 1)
    assert sorted(out.read_text()) == ["r", "s"]
    programs.clock.advance(SWITCH_SECONDS)
    assert await stopped == []
    assert "did not end" in (await resumed)[0]
    assert sorted(out.read_text()) == ["r", "s", "s"]
    assert out.read_text()[-1] == "s"


class UnkillableProgram:
    """A program that can't be killed, and the reactor that runs it."""

    def __init__(self, kill: Callable[[], None]) -> None:
        self.clock = Clock()
        self.callLater = self.clock.callLater
        self.program: Any = None
        self._kill = kill

    def spawnProcess(self, program: Any, *_: Any, **__: Any) -> None:
        self.program = program
        program.makeConnection(self)

    def signalProcess(self, signal: str) -> None:
        assert signal == "KILL"
        self._kill()

    def closeStdin(self) -> None:
        pass

    def loseConnection(self) -> None:
        pass


def _forbidden() -> None:
    raise PermissionError(errno.EPERM, "Operation not permitted")


@pytest.mark.parametrize(
    ("kill", "waits", "words"),
    [
        (_forbidden, [SWITCH_SECONDS], "Operation not permitted"),
        (lambda: None, [SWITCH_SECONDS, KILL_SECONDS], "could not be killed"),
    ],
)
def test_program_that_can_not_be_killed_is_given_up(
    kill: Callable[[], None], waits: list[float], words: str
) -> None:
    """The stop is answered; a later end of the program has no effect."""
    undead = UnkillableProgram(kill)
    ends: list[list[str]] = []
    Hardware(Switches(stop=["/bin/cut"]), MemoryPlatform(), undead).stop().addCallback(ends.append)
    undead.program.errReceived(b"relay is stuck\n")
    for wait in waits:
        assert ends == []
        undead.clock.advance(wait)
    ((problem,),) = ends
    assert problem.startswith("/bin/cut did not end within 5 s")
    assert words in problem
    assert problem.endswith(": relay is stuck")
    undead.program.processExited(Failure(ProcessTerminated(signal=9)))
    assert len(ends) == 1
    assert undead.clock.getDelayedCalls() == []


def test_stop_without_switches_fires_at_once() -> None:
    switch = Hardware(Switches(), MemoryPlatform(), Clock())
    ends: list[list[str]] = []
    switch.stop().addCallback(ends.append)
    switch.resume().addCallback(ends.append)
    assert ends == [[], []]


class Robot:
    """A robot with a service that cuts its motors off, once it is found.

    :param answer: of the service, CDR
    :ivar called: its requests
    """

    def __init__(self, answer: bytes) -> None:
        self.called: list[bytes] = []
        self.platform = MemoryPlatform()
        self.platform.services["/estop"] = self._call
        self._answer = answer

    def _call(self, request: bytes) -> bytes:
        self.called.append(request)
        return self._answer

    def serves(self) -> None:
        """Add the service to the graph."""
        self.platform.view = GraphView(services={"/estop": link.Service(types=["std_srvs/srv/Trigger"])})


@pytest.fixture
def ran(monkeypatch: pytest.MonkeyPatch) -> list[Deferred[None]]:
    """Programs that were run so far; a test ends each."""
    running: list[Deferred[None]] = []

    def runs(reactor: object, command: object) -> Deferred[None]:
        running.append(Deferred())
        return running[-1]

    monkeypatch.setattr(hardware, "run", runs)
    return running


def test_only_failed_switches_are_set_again(ran: list[Deferred[None]]) -> None:
    problems: list[list[str]] = []
    robot = Robot(DONE)
    robot.serves()
    switch = Hardware(Switches("/estop", ["off"]), robot.platform, Clock())
    switch.on_problems = problems.append
    switch.stop()
    ran[0].errback(Unavailable("no power"))
    switch.retry()
    switch.retry()
    ran[1].callback(None)
    switch.retry()
    assert (len(robot.called), len(ran)) == (1, 2)
    assert problems == [["no power"], []]


def test_program_does_not_wait_for_a_missing_service(ran: list[Deferred[None]]) -> None:
    problems: list[list[str]] = []
    robot = Robot(DONE)
    switch = Hardware(Switches("/estop", ["off"]), robot.platform, Clock())
    switch.on_problems = problems.append
    switch.begin_stopped()
    switch.retry()
    assert len(ran) == 1
    ran[0].errback(Unavailable("no power"))
    switch.retry()
    ran[1].callback(None)
    assert problems == [["no power"], []]
    for _ in range(5):
        switch.retry()
    robot.serves()
    switch.prepare()
    for _ in range(5):
        switch.retry()
    assert (len(robot.called), len(ran), problems[2:]) == (1, 2, [[]])


def test_failing_callback_affects_neither_stop_nor_resume() -> None:
    robot = Robot(REFUSED)
    robot.serves()
    switch = Hardware(Switches("/estop"), robot.platform, Clock())
    switch.on_problems = broken
    ends: list[list[str]] = []
    switch.stop().addCallback(ends.append)
    switch.stop().addCallback(ends.append)
    switch.retry()
    switch.retry()
    switch.resume().addCallback(ends.append)
    assert ends == [["a hardware switch failed; the robot's log says why"]] * 2 + [[]]
    assert len(robot.called) == 4


def test_resume_ends_after_an_unexpected_error(
    monkeypatch: pytest.MonkeyPatch, ran: list[Deferred[None]]
) -> None:
    """The next stop and the next resume work."""
    switch = Hardware(Switches("", ["off"], ["on"]), MemoryPlatform(), Clock())
    ends: list[list[str]] = []
    with monkeypatch.context() as broken_for_now:
        broken_for_now.setattr(hardware, "DeferredList", broken)
        switch.resume().addCallback(ends.append)
    assert ends == [["a hardware switch failed; the robot's log says why"]]
    for each in (switch.stop(), switch.resume()):
        each.addCallback(ends.append)
        ran.pop().callback(None)
    assert ends[1:] == [[], []]
