"""Periodic tasks that continue after failures."""

from __future__ import annotations

import pytest
from twisted.internet.task import Clock
from twisted.logger import Logger, capturedLogs

from robot_client.periodic import LOG_EVERY, PeriodicTasks, run_safely


class Step:
    """Fails so often, then works."""

    def __init__(self, failures: int) -> None:
        self.failures = failures
        self.done = 0

    def __call__(self, *_: object) -> None:
        self.done += 1
        if self.done <= self.failures:
            raise RuntimeError("this was not foreseen")


def test_failing_step_is_logged() -> None:
    """A step that works is not."""
    with capturedLogs() as logged:
        for step in (Step(1), Step(0)):
            run_safely(Logger("here"), "it could not be done", step, 1)
            assert step.done == 1
    assert [each["log_format"] for each in logged] == ["it could not be done"]
    assert logged[0]["log_failure"].getErrorMessage() == "this was not foreseen"


@pytest.mark.parametrize("failures", [0, 1, 10**6])
def test_tasks_continue_after_failures_until_stopped(failures: int) -> None:
    """They are independent."""
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


def test_failures_are_logged_once_a_minute() -> None:
    clock = Clock()
    rounds = PeriodicTasks([(Step(10**6), 0.5)], clock)
    rounds.start()
    with capturedLogs() as logged:
        clock.pump([0.5] * round(4 * LOG_EVERY))
    assert len(logged) == 2
