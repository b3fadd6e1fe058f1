"""Who may move the robot now. Pure: sources and times go in, verdicts come out (SPEC 2.5, "Who moves the robot").

Stop is above all, then whoever suppresses a topic, then whoever holds control. Who went on commanding while he might
not has to let go first: his hand is on the stick, and nobody expects the robot to follow it in this very moment.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable
from typing import NamedTuple, TypeVar

from relay_protocol import link
from relay_protocol.limits import FACTS
from robot_client.safety import MILLI

_Key = TypeVar("_Key")

NOBODY = 0
LET_GO = 500 * MILLI
"""Silence of this length is letting go."""

SETTLED = 5000 * MILLI
"""How long after a new control link a stream may take to be heard again: its channel link has to come first."""

GRIPS = 4096
"""Most sources and topics whose latest commands are remembered; who was not heard for longest is forgotten first."""


class Verdict(enum.Enum):
    """What becomes of a command, and why."""

    ALLOWED = "it is obeyed"
    STOPPED = "the robot is stopped until somebody resumes it"
    SUPPRESSED = "others command this topic for a moment"
    NOT_HOLDER = "only who holds control moves the robot"
    NOT_LET_GO = "it must let go first: say zero, or nothing for half a second"


class Suppression(NamedTuple):
    """A topic commanded by some sources only.

    :param until: own clock, nanoseconds
    """

    sources: frozenset[int]
    until: int
    by: str


class _Grip:
    """A source that keeps moving a topic, or would.

    :ivar last: its latest command, nanoseconds
    :ivar innocent: ever since it began nobody has held control, which is how programs take a free robot
    :ivar barred: it must let go first
    """

    __slots__ = ("barred", "innocent", "last")

    def __init__(self, last: int) -> None:
        self.last = last
        self.innocent = True
        self.barred = False


class Authority:
    """Holder, stop and suppressions of one robot."""

    def __init__(self) -> None:
        self.holder = NOBODY
        self.user = ""
        self.level = ""
        self.stopped: link.Stopped | None = None
        self.suppressions: dict[str, Suppression] = {}
        self.refused = 0
        """Commands that were not obeyed."""
        self._grips: dict[tuple[int, str], _Grip] = {}
        self._opened: set[str] = set()
        """Topics on which the holder said zero last, since the stop."""
        self._resumed: tuple[int, int] | None = None
        """Who held control at the last resume, and when that was."""
        self._stopped_at: int | None = None
        """When the robot was stopped last."""
        self._lost = False
        """Whether there is no control link, and was one."""
        self._met: int | None = None
        """When the present control link began, if there was one before."""
        self._heard: dict[int, None] = {}
        """Sources that have commanded since the present control link began, the latest last."""
        self._former: dict[int, None] = {}
        """Those that commanded by earlier ones."""
        self._again: dict[tuple[int, str], None] = {}
        """Sources and topics heard soon after that."""

    # --- judging -------------------------------------------------------------------------------------------

    def judge(self, source: int, topic: str, moving: bool, now: int) -> Verdict:
        """What becomes of one command; what is refused is counted.

        :param topic: as the platform resolved it
        :param moving: whether it is anything but zero
        :param now: own clock, nanoseconds
        """
        verdict = self._rank(source, topic, now)
        _note(self._heard, source)
        if not moving:
            self._grips.pop((source, topic), None)
            if source == self.holder and len(self._opened) < GRIPS:
                self._opened.add(topic)
        elif self._barred(source, topic, verdict, now) and verdict is Verdict.ALLOWED:
            verdict = Verdict.NOT_LET_GO
        if self._just_met(now):
            _note(self._again, (source, topic))
        if verdict is not Verdict.ALLOWED:
            self.refused += 1
        return verdict

    def judge_request(self, source: int, came: int | None = None) -> Verdict:
        """What becomes of a call or a goal that moves the robot; what is refused is counted.

        :param came: when it did, own clock, nanoseconds, if it has waited: a stop since then counts though it is over
        """
        verdict = Verdict.ALLOWED
        overtaken = came is not None and self._stopped_at is not None and came < self._stopped_at
        if self.stopped is not None or overtaken:
            verdict = Verdict.STOPPED
        elif source == NOBODY or source != self.holder:
            verdict = Verdict.NOT_HOLDER
        if verdict is not Verdict.ALLOWED:
            self.refused += 1
        return verdict

    def commands(self, source: int, topic: str, now: int) -> bool:
        """Whether this source is the one to move a topic now."""
        return self._rank(source, topic, now) is Verdict.ALLOWED

    # --- changes -------------------------------------------------------------------------------------------

    def hold(self, holder: int, user: str, level: str, now: int) -> bool:
        """Give control to a source; whether it had another before."""
        self.user, self.level = user, level
        if holder == self.holder:
            return False
        self._drop_open(now)
        for (source, _), grip in self._grips.items():
            grip.barred = grip.barred or (source == holder and not grip.innocent)
        self._opened.clear()
        self.holder = holder
        return True

    def stop(self, stopped: link.Stopped, now: int) -> None:
        """Let nothing move until :meth:`resume`; who stopped it first stays on record."""
        self._stopped_at = now
        if self.stopped is None:
            self._drop_open(now)
            for grip in self._grips.values():
                grip.barred = True
            self._opened.clear()
            self.stopped = stopped

    def resume(self, now: int) -> None:
        """Let move again who has let go, or will."""
        if self.stopped is None:
            return
        self.stopped = None
        self._resumed = (self.holder, now)
        for grip in self._grips.values():
            # What a source said while the robot was stopped need not have come as far as here.
            grip.last = now

    def suppress(self, topic: str, suppression: Suppression) -> bool:
        """Give a topic to some sources for a time; whether there was room for it."""
        if topic not in self.suppressions and len(self.suppressions) >= FACTS:
            return False
        self.suppressions[topic] = suppression
        return True

    def end_suppression(self, topic: str) -> None:
        """Give a topic back to the holder."""
        self.suppressions.pop(topic, None)

    def forget(self, now: int) -> None:
        """The relay is gone; a stop stays, and who commanded just now has to let go first when it is back."""
        self.holder, self.user, self.level = NOBODY, "", ""
        self.suppressions.clear()
        if not self._lost:
            self._drop_open(now)
        for grip in self._grips.values():
            grip.barred = True
        self._opened.clear()
        self._resumed = self._met = None
        for source in self._heard:
            _note(self._former, source)
        self._heard.clear()
        self._lost = True

    def meet(self, now: int) -> None:
        """The relay is there, again perhaps: nobody heard what was said meanwhile, so silence counts from now on."""
        if not self._lost:
            return
        self._lost = False
        self._met = now
        self._again.clear()
        for grip in self._grips.values():
            grip.last = now

    # --- ranks and grips -----------------------------------------------------------------------------------

    def _rank(self, source: int, topic: str, now: int) -> Verdict:
        if self.stopped is not None:
            return Verdict.STOPPED
        suppression = self.suppressions.get(topic)
        if suppression is not None and now < suppression.until:
            return Verdict.ALLOWED if source in suppression.sources else Verdict.SUPPRESSED
        held = source == self.holder and source != NOBODY
        return Verdict.ALLOWED if held else Verdict.NOT_HOLDER

    def _barred(self, source: int, topic: str, verdict: Verdict, now: int) -> bool:
        """Take note of a command to move; whether its source must let go first."""
        grip = self._grips.get((source, topic))
        if grip is None or (self.stopped is None and now - grip.last >= LET_GO):
            grip = self._take(source, topic, now)
            grip.barred = self._holds_on(source, topic, now)
        else:
            self._grips[source, topic] = self._grips.pop((source, topic))
        grip.last = now
        grip.barred = grip.barred or verdict is Verdict.STOPPED
        grip.innocent = grip.innocent and verdict is Verdict.NOT_HOLDER and self.holder == NOBODY
        if source == self.holder:
            self._opened.discard(topic)
        return grip.barred

    def _holds_on(self, source: int, topic: str, now: int) -> bool:
        """Whether a command to move may be the going on of one that nobody heard.

        It is the first since the control link began anew, and comes soon, from who commanded before that; or it comes
        right after the resume, from who held control then and did not say zero.
        """
        if self._just_met(now) and source in self._former and (source, topic) not in self._again:
            return True
        if self._resumed is None:
            return False
        holder, at = self._resumed
        return source == holder != NOBODY and now - at < LET_GO and topic not in self._opened

    def _just_met(self, now: int) -> bool:
        return self._met is not None and now - self._met < SETTLED

    def _take(self, source: int, topic: str, now: int) -> _Grip:
        if len(self._grips) >= GRIPS:
            self._drop_open(now)
        if len(self._grips) >= GRIPS:
            self._drop([next(iter(self._grips))])
        grip = self._grips[source, topic] = _Grip(now)
        return grip

    def _drop_open(self, now: int) -> None:
        """Forget who has let go."""
        barred = self.stopped is not None
        self._drop(
            key
            for key, grip in self._grips.items()
            if now - grip.last >= LET_GO and not (barred and grip.barred)
        )

    def _drop(self, keys: Iterable[tuple[int, str]]) -> None:
        for key in list(keys):
            del self._grips[key]


def _note(known: dict[_Key, None], key: _Key) -> None:
    """Remember it as the latest of at most :data:`GRIPS`."""
    known.pop(key, None)
    known[key] = None
    if len(known) > GRIPS:
        del known[next(iter(known))]
