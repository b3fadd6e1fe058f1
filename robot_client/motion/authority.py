"""Which source may move the robot now. No I/O: from sources and times to decisions (SPEC 2.5, "Control of motion").

A source is a client's connection, by the number that its commands carry. A stop comes first, then a suppression of
the topic, then control. A source that went on commanding while it was not permitted must release the controls first;
:mod:`relay_protocol.release_rule` has that rule.
"""

from __future__ import annotations

import enum
from typing import NamedTuple

from relay_protocol import link
from relay_protocol.limits import LIST_ITEMS
from relay_protocol.release_rule import RELEASE_NS, CommandStream, CommandStreams, StreamsBeforeLoss
from robot_client.motion.command_age import MILLI

NO_SOURCE = 0
"""The holder while no source has control."""

PING_TOLERANCE = 300 * MILLI
"""How much earlier than it was a command may seem to have been sent: the relay pings clients ten times a second, and
pings take time (SPEC 2.5-55)."""

STREAMS = 4096
"""Most sources and topics whose latest commands are remembered; the ones silent for longest are forgotten first."""


class MotionDecision(enum.Enum):
    """Whether a command is carried out, and why not."""

    ALLOWED = "it is carried out"
    STOPPED = "the robot is stopped until it is resumed"
    SUPPRESSED = "other sources suppress this topic; send it again when that has ended"
    SUPPRESSED_ELSEWHERE = (
        "other sources suppress a topic that moves the robot; send it again when that has ended"
    )
    NOT_HOLDER = "only the holder of control moves the robot"
    MUST_RELEASE = "release the controls first: send zero, or nothing for half a second"
    STALE = (
        "it may have been sent before the robot was stopped or resumed, or control was lost; send it again"
    )


class Suppression(NamedTuple):
    """A topic commanded by some sources only.

    :param until: own clock, nanoseconds
    """

    sources: frozenset[int]
    until: int
    by: str


class Authority:
    """Holder, stop and suppressions of one robot.

    :param capacity: most streams of commands that are remembered
    """

    def __init__(self, capacity: int = STREAMS) -> None:
        self.holder = NO_SOURCE
        self.user = ""
        self.level = ""
        self.stopped: link.Stopped | None = None
        self.suppressions: dict[str, Suppression] = {}
        self.refused = 0
        """Commands that were not carried out."""
        self._capacity = capacity
        self._streams: CommandStreams[tuple[int, str]] = CommandStreams(capacity)
        self._link_loss = StreamsBeforeLoss(capacity)
        self._zeroed: set[str] = set()
        """Topics on which the holder's latest command since the stop was zero."""
        self._resumed: tuple[int, int] | None = None
        """The holder at the last resume, and when that was."""
        self._refused_before: int | None = None
        """When the robot was last stopped or resumed, or its control link lost; commands sent before are refused."""
        self._control_lost_at: dict[int, int] = {}
        """Sources that have lost control since then, and when, nanoseconds; the latest last."""

    @property
    def link_is_lost(self) -> bool:
        """Whether the control link was lost and is not restored yet."""
        return self._link_loss.lost

    # --- judging -------------------------------------------------------------------------------------------

    def decide(self, source: int, topic: str, moving: bool, now: int, earliest_sent: int) -> MotionDecision:
        """Decide on one command. Call it once for each: it records what its source commands, and counts refusals.

        :param topic: as the platform resolved it
        :param moving: whether it is anything but zero
        :param now: own clock, nanoseconds
        :param earliest_sent: the earliest time it can have been sent, own clock, nanoseconds; no later than ``now``
        """
        decision = self._decide_by_source(source, topic, now)
        self._link_loss.note_command(source)
        if not moving:
            self._streams.zero((source, topic))
            if source == self.holder:
                self._link_loss.released(self.user, topic)
                if len(self._zeroed) < self._capacity:
                    self._zeroed.add(topic)
        else:
            must_release = self._record_movement(source, topic, decision, now, earliest_sent)
            if decision is MotionDecision.ALLOWED and must_release:
                decision = MotionDecision.MUST_RELEASE
            elif decision is MotionDecision.ALLOWED and self._is_stale(source, earliest_sent):
                decision = MotionDecision.STALE
        self._link_loss.decided_on(source, topic, now)
        return self._count_refused(decision)

    def decide_request(self, source: int, now: int, earliest_sent: int) -> MotionDecision:
        """Decide on a call or a goal that moves the robot; refused ones are counted.

        A suppression does not affect commands that the robot's own nodes publish for a goal. So no goal begins while
        other sources suppress any topic.

        :param now: as of :meth:`decide`, like ``earliest_sent``
        """
        decision = MotionDecision.ALLOWED
        if self.stopped is not None:
            decision = MotionDecision.STOPPED
        elif source == NO_SOURCE or source != self.holder:
            decision = MotionDecision.NOT_HOLDER
        elif self._is_suppressed_anywhere(source, now):
            decision = MotionDecision.SUPPRESSED_ELSEWHERE
        elif self._is_stale(source, earliest_sent):
            decision = MotionDecision.STALE
        return self._count_refused(decision)

    def _count_refused(self, decision: MotionDecision) -> MotionDecision:
        if decision is not MotionDecision.ALLOWED:
            self.refused += 1
        return decision

    def may_command(self, source: int, topic: str, now: int) -> bool:
        """Whether this source may move a topic now."""
        return self._decide_by_source(source, topic, now) is MotionDecision.ALLOWED

    def level_of(self, source: int) -> str:
        """The level of the holder of control; empty for other sources, whose level is not known here."""
        return self.level if source == self.holder else ""

    # --- changes -------------------------------------------------------------------------------------------

    def grant_control(self, holder: int, user: str, level: str, now: int) -> bool:
        """Give control to a source; return whether the holder has changed."""
        self.user, self.level = user, level
        if holder == self.holder:
            return False
        self._forget_released(now)
        restored = self._link_loss.restored_recently(now)

        def continues(key: tuple[int, str], stream: CommandStream) -> bool:
            source, topic = key
            contended = not stream.never_contended or (restored and self._link_loss.held_on(user, topic))
            return source == holder and contended

        self._streams.require_release(continues)
        self._zeroed.clear()
        if holder != NO_SOURCE and user:
            self._link_loss.controlled_by(user)
        if self.holder != NO_SOURCE:
            self._note_control_lost(self.holder, now)
        self.holder = holder
        return True

    def stop(self, stopped: link.Stopped, now: int) -> None:
        """Refuse all motion until :meth:`resume`; a further stop does not replace the first."""
        self._refuse_all_sent_before(now)
        if self.stopped is None:
            self._forget_released(now)
            self._streams.all_must_release()
            self._zeroed.clear()
            self.stopped = stopped

    def resume(self, now: int) -> None:
        """End the stop; streams move the robot again once they have been released."""
        if self.stopped is None:
            return
        self.stopped = None
        self._refuse_all_sent_before(now)
        self._resumed = (self.holder, now)
        # Commands that were sent during the stop need not have arrived here.
        self._streams.restart_silence(now)

    def suppress(self, topic: str, suppression: Suppression) -> bool:
        """Give a topic to some sources for a time; return false where too many are suppressed already."""
        if topic not in self.suppressions and len(self.suppressions) >= LIST_ITEMS:
            return False
        self.suppressions[topic] = suppression
        return True

    def end_suppression(self, topic: str) -> None:
        """Give a topic back to the holder."""
        self.suppressions.pop(topic, None)

    def link_lost(self, now: int) -> None:
        """End control and suppressions, as the control link has ended; a stop stays, and streams must be released."""
        self.holder, self.user, self.level = NO_SOURCE, "", ""
        self.suppressions.clear()
        if not self._link_loss.lost:
            self._refuse_all_sent_before(now)
            self._forget_released(now)
        self._streams.all_must_release()
        self._zeroed.clear()
        self._resumed = None
        self._link_loss.link_lost()

    def link_restored(self, now: int) -> None:
        """Count silence from now on, as nothing could arrive before the control link was established."""
        if self._link_loss.lost:
            self._link_loss.link_restored(now)
            self._streams.restart_silence(now)

    # --- rank, age and release -----------------------------------------------------------------------------

    def _decide_by_source(self, source: int, topic: str, now: int) -> MotionDecision:
        if self.stopped is not None:
            return MotionDecision.STOPPED
        suppression = self.suppressions.get(topic)
        if suppression is not None and now < suppression.until:
            return MotionDecision.ALLOWED if source in suppression.sources else MotionDecision.SUPPRESSED
        held = source == self.holder and source != NO_SOURCE
        return MotionDecision.ALLOWED if held else MotionDecision.NOT_HOLDER

    def _is_suppressed_anywhere(self, source: int, now: int) -> bool:
        return any(now < each.until and source not in each.sources for each in self.suppressions.values())

    def _refuse_all_sent_before(self, now: int) -> None:
        self._refused_before = now
        self._control_lost_at.clear()

    def _note_control_lost(self, source: int, now: int) -> None:
        self._control_lost_at.pop(source, None)
        self._control_lost_at[source] = now
        if len(self._control_lost_at) > self._capacity:
            del self._control_lost_at[next(iter(self._control_lost_at))]

    def _is_stale(self, source: int, earliest_sent: int) -> bool:
        """Whether it can have been sent before the last stop, resume or loss of the link, or while its source had
        control another time.
        """
        if self._refused_before is not None and earliest_sent < self._refused_before:
            return True
        return earliest_sent < self._control_lost_at.get(source, earliest_sent)

    def _record_movement(
        self, source: int, topic: str, decision: MotionDecision, now: int, earliest_sent: int
    ) -> bool:
        """Record a command that moves, whether it is carried out or not; return whether its stream must be released.

        :param decision: by rank alone
        """
        key = source, topic
        known = key in self._streams
        stream = self._streams.note_command(key, now, earliest_sent, silence_releases=self.stopped is None)
        if stream.began:
            if known and source == self.holder:
                self._link_loss.released(self.user, topic)
            stream.must_release = self._continues(source, topic, now, earliest_sent)
        # A command that only seems a little too old is refused, but the next one need not be.
        refused = decision is MotionDecision.STOPPED or self._is_stale(source, earliest_sent + PING_TOLERANCE)
        stream.must_release = stream.must_release or refused
        uncontended = decision is MotionDecision.NOT_HOLDER and self.holder == NO_SOURCE
        stream.never_contended = stream.never_contended and uncontended
        if source == self.holder:
            self._zeroed.discard(topic)
        return stream.must_release

    def _continues(self, source: int, topic: str, now: int, earliest_sent: int) -> bool:
        """Whether the first command of a stream may continue a stream whose earlier commands have not arrived.

        It comes soon after the link was restored, from a source or user that commanded before; or it comes right after
        the resume, from the holder of that moment, whose latest command was not zero.
        """
        holder_user = self.user if source == self.holder else None
        if self._link_loss.continues(source, topic, holder_user, now):
            return True
        if self._resumed is None:
            return False
        holder, at = self._resumed
        return source == holder != NO_SOURCE and earliest_sent - at < RELEASE_NS and topic not in self._zeroed

    def _forget_released(self, now: int) -> None:
        self._streams.forget_released(now, keep_refused=self.stopped is not None)
