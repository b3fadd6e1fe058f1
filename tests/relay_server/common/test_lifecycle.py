"""Parts of a process start in order and stop in reverse, even after failures."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import Deferred

from relay_server.common.lifecycle import Lifecycle, LifecycleStep


class Part:
    """A part that records its calls.

    :param fails: the phase in which it raises
    """

    def __init__(self, log: list[str], name: str, fails: str = "") -> None:
        self.log, self.name, self.fails = log, name, fails
        self.step = LifecycleStep(
            name=name,
            start=self._phase("start"),
            leave=lambda reason: self._phase(f"leave: {reason}")(),
            stop=self._phase("stop"),
            join=self._phase("join"),
        )

    def _phase(self, phase: str) -> Callable[[], None]:
        def run() -> None:
            self.log.append(f"{self.name} {phase}")
            if phase.split(":")[0] == self.fails:
                raise RuntimeError(f"{self.name} can't {phase}")

        return run


def lifecycle(log: list[str], *fails: str) -> Lifecycle:
    return Lifecycle(
        reactor, [Part(log, name, fail).step for name, fail in zip("abc", fails or ("", "", ""), strict=True)]
    )


STOPPED = ["c leave: why", "b leave: why", "a leave: why", "c stop", "b stop", "a stop", "c join", "b join"]


@pytest_twisted.ensureDeferred
async def test_phase_of_stopping_completes_before_the_next() -> None:
    log: list[str] = []
    parts = lifecycle(log)
    await parts.start()
    assert log == ["a start", "b start", "c start"]
    await parts.stop("why")
    assert log[3:] == [*STOPPED, "a join"]


@pytest_twisted.ensureDeferred
@pytest.mark.parametrize("phase", ["leave", "stop", "join"])
async def test_a_part_that_fails_keeps_no_other_from_stopping(phase: str) -> None:
    log: list[str] = []
    parts = lifecycle(log, "", phase, "")
    await parts.start()
    await parts.stop("why")
    assert log[3:] == [*STOPPED, "a join"]


@pytest_twisted.ensureDeferred
async def test_parts_not_started_are_not_stopped() -> None:
    log: list[str] = []
    parts = lifecycle(log, "", "start", "")
    with pytest.raises(RuntimeError, match="b can't start"):
        await parts.start()
    await parts.stop("why")
    assert [each for each in log if each.startswith("c")] == []
    assert log[-2:] == ["b join", "a join"]


@pytest_twisted.ensureDeferred
async def test_no_start_while_stopping() -> None:
    log: list[str] = []
    gate: Deferred[None] = Deferred()
    waiting = LifecycleStep(name="waiting", start=lambda: gate, stop=lambda: log.append("waiting stop"))
    parts = Lifecycle(reactor, [waiting, Part(log, "later").step])
    starting = Deferred.fromCoroutine(parts.start())
    await parts.stop("why")
    gate.callback(None)
    await starting
    assert log == ["waiting stop"]
