"""The state of motion that the robot reports (``motion_state``, SPEC 2.4), and how often."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from relay_protocol import link
from robot_client.motion.authority import Authority
from robot_client.motion.command_age import MILLI
from robot_client.motion.inhibition import Inhibition
from robot_client.twisted_types import DelayedCall, ReactorClock

REPORT_EVERY = 0.05
"""Least seconds between two reports."""


def motion_state(
    authority: Authority,
    moving: bool,
    inhibitions: Mapping[str, Inhibition],
    limits: dict[str, link.Limits],
    now: int,
) -> link.MotionState:
    """The state as the relay receives it.

    :param now: own clock, nanoseconds
    """
    return link.MotionState(
        holder=authority.holder,
        moving=moving,
        stopped=authority.stopped,
        suppressed=[
            link.Suppressed(
                resource=topic, sources=sorted(each.sources), by=each.by, ms=_left(each.until, now)
            )
            for topic, each in authority.suppressions.items()
        ],
        inhibited=[
            link.Inhibited(resource=topic, hold=each.hold, by=each.by, ms=_left(each.until, now))
            for topic, each in inhibitions.items()
        ],
        limits=limits,
    )


def _left(until: int, now: int) -> int:
    return max(0, until - now) // MILLI


class StateReporter:
    """Reports a state when it changes: at most every :data:`REPORT_EVERY`, and always the last one.

    :param report: sends the present state
    """

    def __init__(self, clock: ReactorClock, report: Callable[[], None]) -> None:
        self._clock = clock
        self._report = report
        self._reported_at: float | None = None
        """When it was reported last; ``None`` while there is no link."""
        self._timer: DelayedCall | None = None

    def begin(self) -> None:
        """There is a link: report the state now, and from now on when it changes."""
        self._reported_at = self._clock.seconds()
        self._report()

    def end(self) -> None:
        """There is no link any more."""
        self._reported_at = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def state_changed(self) -> None:
        """Report now, or :data:`REPORT_EVERY` after the last report."""
        if self._reported_at is None or self._timer is not None:
            return
        wait = self._reported_at + REPORT_EVERY - self._clock.seconds()
        if wait <= 0:
            self.begin()
        else:
            self._timer = self._clock.callLater(wait, self._report_again)

    def _report_again(self) -> None:
        self._timer = None
        self.begin()
