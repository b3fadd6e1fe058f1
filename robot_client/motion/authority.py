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
from robot_client.motion.safety import MILLI

_Key = TypeVar("_Key")
_Value = TypeVar("_Value")

NOBODY = 0
LET_GO = 500 * MILLI
"""Silence of this length is letting go."""

SETTLED = 5000 * MILLI
"""How long after a new control link a stream may take to be heard again: its channel link has to come first."""

DOUBT = 300 * MILLI
"""How much earlier than it was a command may seem to have been sent: the relay pings clients ten times a second, and
pings take their way (SPEC 1.5, "Clocks and deadline").
"""

GRIPS = 4096
"""Most sources and topics whose latest commands are remembered; who was not heard for longest is forgotten first."""


class Verdict(enum.Enum):
    """What becomes of a command, and why."""

    ALLOWED = "it is obeyed"
    STOPPED = "the robot is stopped until somebody resumes it"
    SUPPRESSED = "others command this topic for a moment"
    OVERRULED = "others suppress a topic that moves it; send it again when that is over"
    NOT_HOLDER = "only who holds control moves the robot"
    NOT_LET_GO = "it must let go first: say zero, or nothing for half a second"
    OVERTAKEN = (
        "it may have been sent before the robot was stopped or resumed, or control was lost; send it again"
    )


class Suppression(NamedTuple):
    """A topic commanded by some sources only.

    :param until: own clock, nanoseconds
    """

    sources: frozenset[int]
    until: int
    by: str


class ReleaseState:
    """A source that keeps moving a topic, or would.

    :ivar last: when its latest command came, nanoseconds
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
        self._grips: dict[tuple[int, str], ReleaseState] = {}
        self._opened: set[str] = set()
        """Topics on which the holder said zero last, since the stop."""
        self._resumed: tuple[int, int] | None = None
        """Who held control at the last resume, and when that was."""
        self._turned: int | None = None
        """When the robot was stopped or resumed last, or its control link lost: nothing sent before moves it."""
        self._ceded: dict[int, int] = {}
        """Sources that have lost control since then, and when; the latest last."""
        self._lost = False
        """Whether there is no control link, and was one."""
        self._met: int | None = None
        """When the present control link began, if there was one before."""
        self._heard: dict[int, None] = {}
        """Sources that have commanded since the present control link began, the latest last."""
        self._former: dict[int, None] = {}
        """Those that commanded by earlier ones."""
        self._users: dict[str, None] = {}
        """Users who held control since the present control link began, the latest last."""
        self._former_users: dict[str, None] = {}
        """Those who did by earlier ones: to a relay that was started anew they come under another number."""
        self._again: dict[tuple[int, str], None] = {}
        """Sources and topics heard soon after that."""
        self._released: dict[tuple[str, str], None] = {}
        """Users and topics of which they have let go since then, by whatever connection."""

    # --- judging -------------------------------------------------------------------------------------------

    def judge(self, source: int, topic: str, moving: bool, now: int, sent: int) -> Verdict:
        """What becomes of one command; what is refused is counted.

        :param topic: as the platform resolved it
        :param moving: whether it is anything but zero
        :param now: own clock, nanoseconds
        :param sent: before when it can't have been sent, own clock, nanoseconds; no later than ``now``
        """
        verdict = self._rank(source, topic, now)
        _note(self._heard, source, None)
        if not moving:
            self._grips.pop((source, topic), None)
            if source == self.holder:
                _note(self._released, (self.user, topic), None)
                if len(self._opened) < GRIPS:
                    self._opened.add(topic)
        elif self._barred(source, topic, verdict, now, sent) and verdict is Verdict.ALLOWED:
            verdict = Verdict.NOT_LET_GO
        elif self._overtaken(source, sent) and verdict is Verdict.ALLOWED:
            verdict = Verdict.OVERTAKEN
        if self._just_met(now):
            _note(self._again, (source, topic), None)
        if verdict is not Verdict.ALLOWED:
            self.refused += 1
        return verdict

    def judge_request(self, source: int, now: int, sent: int) -> Verdict:
        """What becomes of a call or a goal that moves the robot; what is refused is counted.

        What a goal makes of itself, by publishers of the robot's own, no suppression holds back: so none begins while
        others suppress any topic.

        :param now: as of :meth:`judge`, like ``sent``
        """
        verdict = Verdict.ALLOWED
        if self.stopped is not None:
            verdict = Verdict.STOPPED
        elif source == NOBODY or source != self.holder:
            verdict = Verdict.NOT_HOLDER
        elif self._overruled(source, now):
            verdict = Verdict.OVERRULED
        elif self._overtaken(source, sent):
            verdict = Verdict.OVERTAKEN
        if verdict is not Verdict.ALLOWED:
            self.refused += 1
        return verdict

    def commands(self, source: int, topic: str, now: int) -> bool:
        """Whether this source is the one to move a topic now."""
        return self._rank(source, topic, now) is Verdict.ALLOWED

    def level_of(self, source: int) -> str:
        """The level of who holds control; of others, such as who suppresses a topic, nobody told us: empty."""
        return self.level if source == self.holder else ""

    # --- changes -------------------------------------------------------------------------------------------

    def hold(self, holder: int, user: str, level: str, now: int) -> bool:
        """Give control to a source; whether it had another before."""
        self.user, self.level = user, level
        if holder == self.holder:
            return False
        self._drop_open(now)
        met = self._just_met(now)
        for (source, topic), grip in self._grips.items():
            if source == holder:
                grip.barred = grip.barred or not grip.innocent or (met and self._returned(user, topic))
        self._opened.clear()
        if holder != NOBODY and user:
            _note(self._users, user, None)
        if self.holder != NOBODY:
            _note(self._ceded, self.holder, now)
        self.holder = holder
        return True

    def stop(self, stopped: link.Stopped, now: int) -> None:
        """Let nothing move until :meth:`resume`; who stopped it first stays on record."""
        self._turn(now)
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
        self._turn(now)
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
            self._turn(now)
            self._drop_open(now)
        for grip in self._grips.values():
            grip.barred = True
        self._opened.clear()
        self._resumed = self._met = None
        for source in self._heard:
            _note(self._former, source, None)
        self._heard.clear()
        for user in self._users:
            _note(self._former_users, user, None)
        self._users.clear()
        self._lost = True

    def meet(self, now: int) -> None:
        """The relay is there, again perhaps: nobody heard what was said meanwhile, so silence counts from now on."""
        if not self._lost:
            return
        self._lost = False
        self._met = now
        self._again.clear()
        self._released.clear()
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

    def _overruled(self, source: int, now: int) -> bool:
        """Whether any topic is suppressed by others."""
        return any(now < each.until and source not in each.sources for each in self.suppressions.values())

    def _turn(self, now: int) -> None:
        """What can have been sent before this moves nothing any more, whoever sent it."""
        self._turned = now
        self._ceded.clear()

    def _overtaken(self, source: int, sent: int) -> bool:
        """Whether what moves the robot can have been sent before it was stopped or resumed, or lost its link; or while
        its source held control another time.
        """
        if self._turned is not None and sent < self._turned:
            return True
        return sent < self._ceded.get(source, sent)

    def _barred(self, source: int, topic: str, verdict: Verdict, now: int, sent: int) -> bool:
        """Take note of a command to move; whether its source must let go first.

        Silence is what lies between the last that came and the earliest moment at which this one can have been sent:
        a link that stalls makes none.
        """
        grip = self._grips.get((source, topic))
        if grip is None or (self.stopped is None and sent - grip.last >= LET_GO):
            if grip is not None and source == self.holder:
                _note(self._released, (self.user, topic), None)
            grip = self._take(source, topic, now)
            grip.barred = self._holds_on(source, topic, now, sent)
        else:
            self._grips[source, topic] = self._grips.pop((source, topic))
        grip.last = now
        # Of one that only seems a little too old nobody knows; it is not obeyed, but the next may be.
        held = verdict is Verdict.STOPPED or self._overtaken(source, sent + DOUBT)
        grip.barred = grip.barred or held
        grip.innocent = grip.innocent and verdict is Verdict.NOT_HOLDER and self.holder == NOBODY
        if source == self.holder:
            self._opened.discard(topic)
        return grip.barred

    def _holds_on(self, source: int, topic: str, now: int, sent: int) -> bool:
        """Whether a command to move may be the going on of one that nobody heard.

        It is the first since the control link began anew, and comes soon, from who commanded before that, be it by
        another connection; or it comes right after the resume, from who held control then and did not say zero.
        """
        if self._just_met(now) and self._was_there(source, topic):
            return True
        if self._resumed is None:
            return False
        holder, at = self._resumed
        return source == holder != NOBODY and sent - at < LET_GO and topic not in self._opened

    def _was_there(self, source: int, topic: str) -> bool:
        """Whether it is the first from a source that commanded, or whose user held control, by an earlier link."""
        if (source, topic) in self._again:
            return False
        return source in self._former or (source == self.holder and self._returned(self.user, topic))

    def _returned(self, user: str, topic: str) -> bool:
        """Whether a user held control by an earlier control link and has not let go of the topic since."""
        return user in self._former_users and (user, topic) not in self._released

    def _just_met(self, now: int) -> bool:
        return self._met is not None and now - self._met < SETTLED

    def _take(self, source: int, topic: str, now: int) -> ReleaseState:
        if len(self._grips) >= GRIPS:
            self._drop_open(now)
        if len(self._grips) >= GRIPS:
            self._drop([next(iter(self._grips))])
        grip = self._grips[source, topic] = ReleaseState(now)
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


def _note(known: dict[_Key, _Value], key: _Key, value: _Value) -> None:
    """Remember it as the latest of at most :data:`GRIPS`."""
    known.pop(key, None)
    known[key] = value
    if len(known) > GRIPS:
        del known[next(iter(known))]
