"""Work that goes on whatever fails in it, on a clock of ours."""

from __future__ import annotations

import pytest
from twisted.internet.task import Clock
from twisted.logger import Logger, capturedLogs

from robot_client.periodic import LOG_EVERY, PeriodicTasks, run_safely


class Step:
    """Fails so often, then no more."""

    def __init__(self, failures: int) -> None:
        self.failures = failures
        self.done = 0

    def __call__(self, *_: object) -> None:
        self.done += 1
        if self.done <= self.failures:
            raise RuntimeError("this was not foreseen")


def test_a_step_that_fails_is_logged_and_ends_nothing() -> None:
    """The log says why; one that does not fail is not mentioned."""
    with capturedLogs() as logged:
        for step in (Step(1), Step(0)):
            run_safely(Logger("here"), "it could not be done", step, 1)
            assert step.done == 1
    assert [each["log_format"] for each in logged] == ["it could not be done"]
    assert logged[0]["log_failure"].getErrorMessage() == "this was not foreseen"


@pytest.mark.parametrize("failures", [0, 1, 10**6])
def test_rounds_go_on(failures: int) -> None:
    """At their time, however often they fail, until they are to end; one does not hang on the other."""
    clock = Clock()
    first, second = Step(failures), Step(0)
    rounds = PeriodicTasks([(first, 1.0), (second, 0.5)], clock)
    rounds.start()
    assert (first.done, second.done) == (0, 0)
    clock.pump([0.5] * 20)
    assert (first.done, second.done) == (10, 20)
    rounds.stop()
    clock.pump([0.5] * 20)
    assert (first.done, second.done) == (10, 20)
    assert clock.getDelayedCalls() == []


def test_rounds_that_fail_do_not_fill_the_disk() -> None:
    """The first failure is logged, and one a minute of those that follow."""
    clock = Clock()
    rounds = PeriodicTasks([(Step(10**6), 0.5)], clock)
    rounds.start()
    with capturedLogs() as logged:
        clock.pump([0.5] * round(4 * LOG_EVERY))
    assert len(logged) == 2
