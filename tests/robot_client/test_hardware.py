"""Programs that stop the robot's hardware; what services do is tested with the orders (``test_helm``)."""

from __future__ import annotations

import errno
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.error import ProcessTerminated
from twisted.internet.task import Clock
from twisted.python.failure import Failure

from relay_protocol.errors import Unavailable
from robot_client import hardware
from robot_client.hardware import DYING, PATIENCE, Hardware, Switches, run
from robot_client.platforms.memory import MemoryPlatform

PYTHON = sys.executable


@pytest_twisted.ensureDeferred
async def test_programs_are_run_with_their_arguments_and_no_shell(tmp_path: Path) -> None:
    """One at the stop, one at the resume; what would mean something to a shell is an argument like others."""
    note = "import pathlib, sys; pathlib.Path(sys.argv[1]).write_text(sys.argv[2])"
    out = str(tmp_path / "out")

    def told() -> str:
        return Path(out).read_text()

    switches = Switches("", [PYTHON, "-c", note, out, "$HOME; off"], [PYTHON, "-c", note, out, "on"])
    switch = Hardware(switches, MemoryPlatform(), reactor)
    assert await switch.stop() == []
    assert told() == "$HOME; off"
    assert await switch.resume() == []
    assert told() == "on"


@pytest_twisted.ensureDeferred
async def test_program_that_fails_is_told_with_its_last_words() -> None:
    """Its exit code, and the last line it wrote, harmless."""
    code = r"import sys; sys.exit('first\nno \x1b[31mpower')"
    switches = Switches(stop=[PYTHON, "-c", code])
    (problem,) = await Hardware(switches, MemoryPlatform(), reactor).stop()
    assert problem == rf"{PYTHON} ended with 1: no \x1b[31mpower"


@pytest_twisted.ensureDeferred
async def test_program_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """After its time it is killed, and that is told."""
    monkeypatch.setattr(hardware, "PATIENCE", 0.2)
    with pytest.raises(Unavailable, match=r"did not end within 0\.2 s"):
        await run(reactor, [PYTHON, "-c", "import time; time.sleep(60)"])


@pytest_twisted.ensureDeferred
async def test_program_that_is_not_there_is_told() -> None:
    """It fails, and nothing waits."""
    (problem,) = await Hardware(Switches(stop=["/no/such/program"]), MemoryPlatform(), reactor).stop()
    assert problem.startswith("/no/such/program ")


@pytest_twisted.ensureDeferred
async def test_stop_in_the_middle_of_a_slow_resume_has_the_last_word(tmp_path: Path) -> None:
    """The switch is thrown at once, and again when the resume's program has ended; only then the stop is done."""
    note = "; pathlib.Path(sys.argv[1]).open('a').write(sys.argv[2])"
    code = "import pathlib, sys, time; time.sleep(float(sys.argv[3]))" + note
    out = tmp_path / "out"
    stop, resume = ([PYTHON, "-c", code, str(out), *each] for each in (("s", "0"), ("r", "0.5")))
    switch = Hardware(Switches("", stop, resume), MemoryPlatform(), reactor)
    resumed = switch.resume()
    assert await switch.stop() == []
    assert await resumed == []
    assert sorted(out.read_text()) == ["r", "s", "s"]
    assert out.read_text()[-1] == "s"


@pytest_twisted.ensureDeferred
async def test_stop_in_the_middle_of_a_resume_that_hangs_is_thrown_when_that_is_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a killed program leaves is stopped too."""
    monkeypatch.setattr(hardware, "PATIENCE", 2.0)
    out = tmp_path / "out"
    note = "import pathlib, sys; pathlib.Path(sys.argv[1]).open('a').write(sys.argv[2])"
    hang = note + "; import time; time.sleep(60)"
    switches = Switches("", [PYTHON, "-c", note, str(out), "s"], [PYTHON, "-c", hang, str(out), "r"])
    switch = Hardware(switches, MemoryPlatform(), reactor)
    resumed = switch.resume()
    assert await switch.stop() == []
    assert "did not end" in (await resumed)[0]
    assert sorted(out.read_text()) == ["r", "s", "s"]
    assert out.read_text()[-1] == "s"


class Undead:
    """A program of this system that outlives what should end it, and the reactor that runs it."""

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
    [(_forbidden, [PATIENCE], "Operation not permitted"), (lambda: None, [PATIENCE, DYING], "does not die")],
)
def test_program_that_can_not_be_killed_is_given_up(
    kill: Callable[[], None], waits: list[float], words: str
) -> None:
    """It runs as root, or hangs in the kernel: the stop is answered all the same, and its end later changes nothing."""
    undead = Undead(kill)
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


def test_without_switches_nothing_is_waited_for() -> None:
    """The answer is there at once."""
    switch = Hardware(Switches(), MemoryPlatform(), Clock())
    ends: list[list[str]] = []
    switch.stop().addCallback(ends.append)
    switch.resume().addCallback(ends.append)
    assert ends == [[], []]
