"""The relay's orders about motion: done, answered when they have taken effect, told as ``safety`` (SPEC 2.4, 2.5)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from twisted.internet.defer import Deferred, maybeDeferred, succeed
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_protocol.limits import FACTS
from relay_protocol.link.motion import Order
from robot_client.alerts import AlertCondition
from robot_client.motion.authority import NOBODY, Authority, Suppression
from robot_client.motion.goal_canceller import HEARD_WITHIN, PATIENCE, GoalCanceller, names
from robot_client.motion.hardware import Hardware
from robot_client.motion.inhibition import Inhibitions
from robot_client.motion.motion import MotionControl
from robot_client.motion.robot_port import RobotPort
from robot_client.motion.safety import MILLI
from robot_client.motion.state_reporter import StateReporter, safety
from robot_client.motion.stop_store import StopRecorder, StopStore, but
from robot_client.motion.unlimited_command_alert import UnlimitedCommandAlert
from robot_client.twisted_types import DelayedCall

LOOK_EVERY = 1.0
"""Seconds between looks for what is still to be stopped while the robot is."""

KEEP_EVERY = 10
"""Looks between two attempts to keep a stop that could not be kept: the disk is waited for."""

UNFORESEEN = "a part of this order failed; the robot's log says why"


class _Stopping:
    """An order to stop that is not answered yet.

    :param before: what went wrong before it, and is told already
    """

    def __init__(self, id: int, before: Iterable[str] = ()) -> None:
        self.id = id
        self.before = before
        self.once: list[str] = []
        """What went wrong, and is told a person once."""


class OrderHandler:
    """Does what the relay orders.

    :param clock: for timers
    :param now: clock of :mod:`relay_protocol.clocks`, nanoseconds
    :param wall: Unix time, seconds
    """

    def __init__(
        self,
        authority: Authority,
        motion: MotionControl,
        latch: StopStore,
        hardware: Hardware,
        sweep: GoalCanceller,
        body: RobotPort,
        clock: Any,
        now: Callable[[], int],
        wall: Callable[[], float],
    ) -> None:
        self.limits: dict[str, link.Limits] = {}
        """How fast whom may move the robot, for the relay to know."""
        self._authority = authority
        self._motion = motion
        self._hardware = hardware
        self._sweep = sweep
        self._body = body
        self._clock = clock
        self._now = now
        self._wall = wall
        self._inhibiting = Inhibitions(body, self.changed, clock, now)
        self.silent = self._inhibiting.silent
        """Topics that say nothing now, and whether they say their last value instead."""
        self._timers: dict[str, DelayedCall] = {}
        """Those that end suppressions, by topic."""
        self._stopping: list[_Stopping] = []
        """Orders to stop that wait for hardware and actions, while those are being stopped."""
        self._keeping = StopRecorder(latch, body.alert)
        self._resuming: int | None = None
        self._looks = 0
        """How often was looked while the robot was stopped."""
        self._unsaid = False
        """Whether zero is still to be said on the topics of others, since before this start."""
        self._late = AlertCondition(body.alert, "stop", "actions")
        """Goals that go on though the robot is stopped."""
        self._going = AlertCondition(body.alert, "control", "goals")
        """Goals that go on though whoever gave them has lost control."""
        self._unthrown = AlertCondition(body.alert, "stop", "hardware")
        self._unread = UnlimitedCommandAlert(body.alert)
        self._telling = StateReporter(clock, self._tell)
        self._log = Logger("helm")
        self._orders: dict[type, Callable[[Any], None]] = {
            link.Control: self._control,
            link.Stop: self._stop,
            link.Resume: self._resume,
            link.Suppress: self._suppress,
            link.Inhibit: self._inhibit,
        }
        motion.on_moving = self.changed
        motion.on_unread = self._unread.refused
        hardware.on_owed = self._owed
        self._load(latch.load())

    def order(self, message: link.Message) -> bool:
        """Do one order; whether it was one."""
        if not isinstance(message, Order):
            return False
        try:
            self._orders[type(message)](message)
        except SwitchboardError as error:
            self._done(message.id, [str(error)])
        except Exception:
            # A middleware that throws something unforeseen must not leave the relay without an answer.
            self._log.failure("an order could not be done")
            self._done(message.id, ["the robot could not do this; its log says why"])
        return True

    def registered(self) -> None:
        """The relay knows us now; tell it all."""
        self._authority.meet(self._now())
        self._telling.begin()

    def unregistered(self) -> None:
        """The control link is gone, and control with it."""
        self._authority.forget(self._now())
        self._unread.over()
        for topic in list(self._timers):
            self._disarm(topic)
        self._inhibiting.end()
        self._telling.end()

    def changed(self) -> None:
        """Something that ``safety`` says has changed."""
        self._telling.changed()

    def look(self) -> None:
        """Go on with what a stop, also one of before this start, has yet to achieve, and see which goals go on that are
        to end; to be called every second.
        """
        self._hardware.prepare()
        self._tell_going(self._body.overdue)
        if self._authority.stopped is None:
            return
        self._looks += 1
        if self._unsaid:
            self._unsaid = False
            self._sweep.zeros.say()
        self._sweep.again()
        if not self._stopping:
            self._tell_late()
            self._hardware.look()
        if self._keeping.unkept and self._looks % KEEP_EVERY == 0:
            self._keeping.keep(self._authority.stopped)

    # --- orders --------------------------------------------------------------------------------------------

    def _control(self, message: link.Control) -> None:
        failed: list[str] = []
        goals: Deferred[list[str]] = succeed([])
        self._unread.over()
        if self._authority.hold(message.holder, message.user, message.level, self._now()):
            self._log.info(
                "control: {who} ({why})",
                who=f"{message.user or 'a client'}, source {message.holder}" if message.holder else "nobody",
                why=message.why or "no reason given",
            )
            failed = self._motion.stop_all("control changes", gently=True)
            self._body.cancel_goals(True)
            goals = self._body.standing(PATIENCE)
        self.changed()
        stood = self._motion.standing()
        stood.addCallback(
            lambda also: goals.addCallback(lambda going: self._controlled(message, failed + also, going)),
        )

    def _controlled(self, message: link.Control, failed: list[str], going: list[str]) -> None:
        """What the former one moved stands, or does not; his goals have ended, or have had the time to."""
        if going:
            self._tell_going(going)
        if failed and self._authority.holder == message.holder:
            self._authority.hold(NOBODY, "", "", self._now())
            self.changed()
        self._done(message.id, _unheard(failed))

    def _tell_going(self, going: list[str]) -> None:
        """Tell a person of goals that were to end and go on; while the robot is stopped that is told otherwise."""
        if going and not self._going.words and self._authority.stopped is not None:
            return
        words = (
            f"goals of {names(going)} may go on though they are to end; they are cancelled again every second"
        )
        self._going.tell(words if going else "", "no goal that was to end is known to go on")

    def _stop(self, message: link.Stop) -> None:
        new = self._authority.stopped is None
        stopped = link.Stopped(by=message.by, since=message.at or self._wall(), why=message.why)
        self._authority.stop(stopped, self._now())
        self._resuming = None
        order = _Stopping(message.id)
        self._stopping.append(order)
        why = f"{message.by} stopped the robot ({message.why or 'no reason given'})"
        self._part(order.once, self._motion.halt, why).addCallback(_unheard).addCallback(order.once.extend)
        self._part(order.once, self._body.cancel_goals, False)
        self._part(order.once, self.changed)
        # The disk may take its time.
        thrown = self._throw(order)
        if new or self._keeping.unkept:
            self._part(order.once, self._keeping.keep, self._authority.stopped or stopped)
        thrown.addCallback(self._stopped, order).addErrback(self._failed, message.id)

    def _throw(self, order: _Stopping) -> Deferred[list[str]]:
        """Stop what commands of clients don't move; fires with what went wrong in the hardware."""
        hardware = self._part(order.once, self._hardware.stop)
        cancelled = self._part(order.once, self._sweep.stop).addCallback(order.once.extend)
        self._part(order.once, self._sweep.zeros.say)
        ended = self._part(order.once, self._body.standing, HEARD_WITHIN)
        return hardware.addCallback(
            lambda problems: cancelled.addCallback(lambda _: ended.addCallback(lambda _: problems)),
        )

    def _part(self, problems: list[str], do: Callable[..., Any], *args: Any) -> Deferred[Any]:
        """Do a part of an order; what fails in it unforeseen must not keep the others from being done.

        :param problems: where it is said that it failed
        """
        return maybeDeferred(do, *args).addErrback(self._unforeseen, problems)

    def _unforeseen(self, failure: Failure, problems: list[str]) -> list[str]:
        self._log.failure("a part of an order failed", failure)
        problems.append(UNFORESEEN)
        return []

    def _failed(self, failure: Failure, id: int) -> None:
        self._log.failure("an order could not be done", failure)
        self._done(id, [UNFORESEEN])

    def _owed(self, problems: list[str]) -> None:
        self._unthrown.tell(but(problems), "the switch in the hardware is thrown")

    def _stopped(self, unthrown: list[str], order: _Stopping) -> None:
        """All is done that can be: tell who waits for it, with what went wrong."""
        self._stopping.remove(order)
        if order.once:  # the others are told as long as they last
            self._body.alert("error", but(list(dict.fromkeys(order.once))))
        unkept = [self._keeping.unkept] if self._keeping.unkept else []
        problems = [*order.before, *order.once, *unkept, *unthrown, *self._tell_late()]
        self._done(order.id, list(dict.fromkeys(problems)))

    def _tell_late(self) -> list[str]:
        """Tell a person what a stop has not achieved in time, and when it has; what that is now."""
        late = self._sweep.late(self._body.pursued)
        self._late.tell(but(late), "all goals that moved the stopped robot are cancelled")
        return late

    def _resume(self, message: link.Resume) -> None:
        if self._authority.stopped is None:
            self._done(message.id, [])
            return
        if self._stopping or self._resuming is not None:
            raise Unavailable(
                "the robot is still being stopped or resumed; resume it again when that is done"
            )
        self._resuming = message.id
        problems: list[str] = []
        resumed = self._part(problems, self._hardware.resume)
        resumed.addCallback(lambda more: self._resumed(message, problems + more))
        resumed.addErrback(self._unresumed, message)

    def _resumed(self, message: link.Resume, problems: list[str]) -> None:
        if self._resuming != message.id:
            self._done(message.id, ["somebody stopped the robot meanwhile"])
            return
        self._resuming = None
        released = not problems
        if released:
            problems = self._keeping.clear()
        if problems:
            self._stay(message, problems, unkept=released)
            return
        self._sweep.end()
        self._authority.resume(self._now())
        self._unsaid = False
        self._keeping.end()
        for concern in (self._late, self._unthrown):
            concern.tell("", "the robot is resumed")
        self._log.info("resumed by {who} ({why})", who=message.by, why=message.why or "no reason given")
        self.changed()
        self._done(message.id, [])

    def _unresumed(self, failure: Failure, message: link.Resume) -> None:
        """A resume failed unforeseen: what it let go is stopped again, if the robot is not resumed yet."""
        if self._authority.stopped is None:
            self._failed(failure, message.id)
            return
        problems: list[str] = []
        self._unforeseen(failure, problems)
        self._stay(message, problems, unkept=True)

    def _stay(self, message: link.Resume, problems: list[str], unkept: bool) -> None:
        """A resume failed half-way: stop again what it let go, then say that the robot stays stopped.

        :param unkept: the record of the stop may be gone
        """
        order = _Stopping(message.id, problems)
        self._stopping.append(order)
        self._part(order.once, self._body.alert, "error", f"the robot stays stopped: {'; '.join(problems)}")
        thrown = self._throw(order)
        if unkept and self._authority.stopped is not None:
            self._part(order.once, self._keeping.keep, self._authority.stopped)
        thrown.addCallback(self._stopped, order).addErrback(self._failed, message.id)

    def _suppress(self, message: link.Suppress) -> None:
        topic = self._motion_topic(message.resource)
        if message.ms:
            until = self._now() + message.ms * MILLI
            suppression = Suppression(frozenset(message.sources), until, message.by)
            if not self._authority.suppress(topic, suppression):
                raise Unavailable(f"{FACTS} topics are suppressed already")
            self._disarm(topic)
            self._timers[topic] = self._clock.callLater(message.ms / 1000, self._end_suppression, topic)
            self._motion.yield_topic(topic, f"suppressed by {message.by or 'a client'}")
            self.changed()
        else:
            self._end_suppression(topic)
        self._done(message.id, [])

    def _end_suppression(self, topic: str) -> None:
        self._disarm(topic)
        if topic not in self._authority.suppressions:
            return
        self._authority.end_suppression(topic)
        self._motion.yield_topic(topic, "its suppression is over")
        self.changed()

    def _inhibit(self, message: link.Inhibit) -> None:
        self._inhibiting.order(message)
        self._done(message.id, [])

    # --- what they need ------------------------------------------------------------------------------------

    def _load(self, stopped: link.Stopped | None) -> None:
        if stopped is not None:
            self._authority.stop(stopped, self._now())
            self._unsaid = True
            self._hardware.begin()
            self._sweep.begin()
            self._log.warn(
                "the robot is stopped since before this start, by {who} ({why})",
                who=stopped.by,
                why=stopped.why or "no reason given",
            )

    def _motion_topic(self, resource: str) -> str:
        topic, types = self._body.topic(resource)
        if self._motion.commanded(topic) or any(
            self._motion.policy.moves_by_topic(topic, each) for each in types
        ):
            return topic
        if types:
            raise Invalid(f"{topic} does not move the robot, so there is nothing to suppress")
        raise NotFound(f"there is no topic {topic} on this robot")

    def _disarm(self, topic: str) -> None:
        timer = self._timers.pop(topic, None)
        if timer is not None and timer.active():
            timer.cancel()

    def _done(self, id: int, problems: list[str]) -> None:
        self._body.say(link.Done(id=id, ok=not problems, reason="; ".join(problems)))

    def _tell(self) -> None:
        moving = self._motion.moving or bool(self._body.pursued)
        told = safety(self._authority, moving, self._inhibiting.told, self.limits, self._now())
        self._body.say(told)


def _unheard(topics: Iterable[str]) -> list[str]:
    return [f"zero could not be said on {topic}" for topic in topics]
