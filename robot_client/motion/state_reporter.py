"""What ``safety`` says (SPEC 2.4), and when: soon, not too often, and the last state always."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from relay_protocol import link
from robot_client.motion.authority import Authority
from robot_client.motion.safety import MILLI
from robot_client.twisted_types import DelayedCall, ReactorClock

TELL_EVERY = 0.05
"""Seconds between two words, at least."""


class Inhibition(NamedTuple):
    """A topic that says nothing, or with ``hold`` the last it said.

    :param until: own clock, nanoseconds
    """

    hold: bool
    until: int
    by: str


def safety(
    authority: Authority,
    moving: bool,
    inhibitions: Mapping[str, Inhibition],
    limits: dict[str, link.Limits],
    now: int,
) -> link.Safety:
    """How it is with what moves the robot.

    :param now: own clock, nanoseconds
    """
    return link.Safety(
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
    """Paces what is said of one state.

    :param say: says it as it is now
    """

    def __init__(self, clock: ReactorClock, say: Callable[[], None]) -> None:
        self._clock = clock
        self._say = say
        self._said_at: float | None = None
        """When it was said last; ``None`` while nobody is there to hear it."""
        self._timer: DelayedCall | None = None

    def begin(self) -> None:
        """Somebody is there to hear it: say it now, and from now on when it changes."""
        self._said_at = self._clock.seconds()
        self._say()

    def end(self) -> None:
        """Nobody is there any more."""
        self._said_at = None
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def changed(self) -> None:
        """Say it now, or :data:`TELL_EVERY` after it was said last."""
        if self._said_at is None or self._timer is not None:
            return
        wait = self._said_at + TELL_EVERY - self._clock.seconds()
        if wait <= 0:
            self.begin()
        else:
            self._timer = self._clock.callLater(wait, self._again)

    def _again(self) -> None:
        self._timer = None
        self.begin()
