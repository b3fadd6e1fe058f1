"""The relay's orders about motion: done, answered when they have taken effect, told as ``safety`` (SPEC 2.4, 2.5)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from twisted.internet.defer import Deferred, succeed
from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_protocol.limits import FACTS
from relay_protocol.link.moving import Order
from robot_client.authority import NOBODY, Authority, Suppression
from robot_client.body import Body
from robot_client.hardware import Hardware
from robot_client.lasting import Latch
from robot_client.motion import MotionDesk
from robot_client.reactors import Timer
from robot_client.safety import MILLI
from robot_client.sweep import HEARD_WITHIN, PATIENCE, Sweep
from robot_client.telling import Inhibition, Telling, safety

LOOK_EVERY = 1.0
"""Seconds between looks for what is still to be stopped while the robot is."""

LOOKS = 30
"""How often a daemon that starts stopped looks for the switch in the hardware: nodes may start after it."""


LATE = ("stop", "actions")
"""Kind and part of the alert that goals go on though the robot is stopped."""


class Helm:
    """Does what the relay orders.

    :param clock: for timers
    :param now: clock of :mod:`robot_client.clocks`, nanoseconds
    :param wall: Unix time, seconds
    """

    def __init__(
        self,
        authority: Authority,
        motion: MotionDesk,
        latch: Latch,
        hardware: Hardware,
        sweep: Sweep,
        body: Body,
        clock: Any,
        now: Callable[[], int],
        wall: Callable[[], float],
    ) -> None:
        self.silent: dict[str, bool] = {}
        """Topics that say nothing now, and whether they say their last value instead."""
        self.limits: dict[str, link.Limits] = {}
        """How fast whom may move the robot, for the relay to know."""
        self._authority = authority
        self._motion = motion
        self._latch = latch
        self._hardware = hardware
        self._sweep = sweep
        self._body = body
        self._clock = clock
        self._now = now
        self._wall = wall
        self._inhibitions: dict[str, Inhibition] = {}
        self._timers: dict[tuple[str, str], Timer] = {}
        self._stopping: list[int | None] = []
        """Orders to stop that wait for hardware and actions, while those are being stopped; ``None``: our own."""
        self._problems: list[str] = []
        """What went wrong with them."""
        self._unkept = ""
        """Why the stop is not known to be on the disk; empty where it is."""
        self._resuming: int | None = None
        self._looks = 0
        """How often to look again for what is to be stopped since before this start."""
        self._unthrown = False
        """Whether the hardware is to be stopped in this."""
        self._late: list[str] = []
        """What a person was told that the stop has not achieved yet."""
        self._telling = Telling(clock, self._tell)
        self._log = Logger("helm")
        self._orders: dict[type, Callable[[Any], None]] = {
            link.Control: self._control,
            link.Stop: self._stop,
            link.Resume: self._resume,
            link.Suppress: self._suppress,
            link.Inhibit: self._inhibit,
        }
        motion.on_moving = self.changed
        sweep.on_refused = self._refused
        self._load()

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
        for kind, name in list(self._timers):
            if kind == "suppress":
                self._timers.pop((kind, name)).cancel()
        self._telling.end()

    def changed(self) -> None:
        """Something that ``safety`` says has changed."""
        self._telling.changed()

    def look(self) -> None:
        """Go on with what a stop, also one of before this start, has yet to achieve; to be called every second."""
        if self._authority.stopped is None:
            self._looks = 0
            return
        self._sweep.again()
        if not self._stopping:
            self._tell_late()
        if self._looks:
            self._looks -= 1
            if self._unthrown and not self._stopping and self._resuming is None:
                self._throw_again()

    # --- orders --------------------------------------------------------------------------------------------

    def _control(self, message: link.Control) -> None:
        failed: list[str] = []
        goals: Deferred[list[str]] = succeed([])
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
            self._log.warn("goals of {actions} were cancelled and have not ended", actions=", ".join(going))
        if failed and self._authority.holder == message.holder:
            self._authority.hold(NOBODY, "", "", self._now())
            self.changed()
        self._done(message.id, _unheard(failed))

    def _stop(self, message: link.Stop) -> None:
        new = self._authority.stopped is None
        stopped = link.Stopped(by=message.by, since=self._wall(), why=message.why)
        self._authority.stop(stopped, self._now())
        self._resuming = None
        why = f"{message.by} stopped the robot ({message.why or 'no reason given'})"
        self._problems += _unheard(self._motion.halt(why))
        self._body.cancel_goals(False)
        self.changed()
        self._stopping.append(message.id)
        # The disk may take its time.
        thrown = self._throw() if len(self._stopping) == 1 else None
        if new or self._unkept:
            self._keep(self._authority.stopped or stopped)
        if thrown is not None:
            thrown.addCallback(self._stopped)

    def _throw(self) -> Deferred[list[str]]:
        """Stop what commands of clients don't move; fires with what went wrong."""
        hardware = self._hardware.stop()
        cancelled = self._sweep.stop()
        self._sweep.zeros.say()
        ended = self._body.standing(HEARD_WITHIN)
        return hardware.addCallback(
            lambda problems: cancelled.addCallback(
                lambda also: ended.addCallback(lambda _: problems + also),
            ),
        )

    def _throw_again(self) -> None:
        if self._looks and not self._reachable():
            return
        self._unthrown = False
        self._stopping.append(None)
        self._sweep.zeros.say()
        self._hardware.stop().addCallback(self._stopped)

    def _reachable(self) -> bool:
        try:
            return self._hardware.reachable
        except Exception:  # a look that fails must not be the last one
            self._log.failure("the graph could not be read")
            return False

    def _keep(self, stopped: link.Stopped) -> None:
        self._unkept = ""
        try:
            self._latch.keep(stopped)
        except Unavailable as error:
            self._unkept = str(error)

    def _stopped(self, problems: list[str]) -> list[str]:
        """All is done that can be: tell those who wait for it; with what went wrong."""
        unkept = [self._unkept] if self._unkept else []
        problems = list(dict.fromkeys(self._problems + unkept + problems))
        waiting, self._stopping, self._problems = self._stopping, [], []
        if problems:
            self._body.alert("error", f"the robot is stopped, but {'; '.join(problems)}")
        self._tell_late()
        for id in waiting:
            if id is not None:
                self._done(id, problems + self._late)
        return problems

    def _tell_late(self) -> None:
        """Tell a person what a stop has not achieved in time, and when it has."""
        late, self._late = self._late, self._sweep.late(self._body.pursued)
        if self._late and not late:
            self._body.alert("error", f"the robot is stopped, but {'; '.join(self._late)}", *LATE)
        elif late and not self._late:
            self._body.alert("info", "all goals that moved the stopped robot are cancelled", *LATE, over=True)

    def _refused(self, words: str) -> None:
        self._body.alert("error", f"the robot is stopped, but {words}")

    def _resume(self, message: link.Resume) -> None:
        if self._authority.stopped is None:
            self._done(message.id, [])
            return
        if self._stopping or self._resuming is not None:
            raise Unavailable(
                "the robot is still being stopped or resumed; resume it again when that is done"
            )
        self._resuming = message.id
        self._hardware.resume().addCallback(lambda problems: self._resumed(message, problems))

    def _resumed(self, message: link.Resume, problems: list[str]) -> None:
        if self._resuming != message.id:
            self._done(message.id, ["somebody stopped the robot meanwhile"])
            return
        self._resuming = None
        released = not problems
        if released:
            try:
                self._latch.clear()
            except Unavailable as error:
                problems = [str(error)]
        if problems:
            self._stay(message, problems, unkept=released)
            return
        self._sweep.end()
        self._authority.resume(self._now())
        if self._late:
            self._late = []
            self._body.alert("info", "the robot is resumed", *LATE, over=True)
        self._log.info("resumed by {who} ({why})", who=message.by, why=message.why or "no reason given")
        self.changed()
        self._done(message.id, [])

    def _stay(self, message: link.Resume, problems: list[str], unkept: bool) -> None:
        """A resume failed half-way: stop again what it let go, then say that the robot stays stopped.

        :param unkept: the record of the stop may be gone
        """
        self._body.alert("error", f"the robot stays stopped: {'; '.join(problems)}")
        self._stopping.append(None)
        thrown = self._throw()
        if unkept and self._authority.stopped is not None:
            self._keep(self._authority.stopped)
        thrown.addCallback(self._stopped).addCallback(
            lambda also: self._done(message.id, list(dict.fromkeys(problems + also)))
        )

    def _suppress(self, message: link.Suppress) -> None:
        topic = self._motion_topic(message.resource)
        if message.ms:
            until = self._now() + message.ms * MILLI
            suppression = Suppression(frozenset(message.sources), until, message.by)
            if not self._authority.suppress(topic, suppression):
                raise Unavailable(f"{FACTS} topics are suppressed already")
            self._arm("suppress", topic, message.ms, self._end_suppression)
            self._motion.yield_topic(topic, f"suppressed by {message.by or 'a client'}")
            self.changed()
        else:
            self._end_suppression(topic)
        self._done(message.id, [])

    def _end_suppression(self, topic: str) -> None:
        self._disarm("suppress", topic)
        if topic not in self._authority.suppressions:
            return
        self._authority.end_suppression(topic)
        self._motion.yield_topic(topic, "its suppression is over")
        self.changed()

    def _inhibit(self, message: link.Inhibit) -> None:
        topic, types = self._body.topic(message.resource)
        if message.ms:
            if not types:
                raise NotFound(f"there is no topic {topic} on this robot")
            if topic not in self.silent and len(self.silent) >= FACTS:
                raise Unavailable(f"{FACTS} topics are inhibited already")
            self._inhibitions[topic] = Inhibition(message.hold, self._now() + message.ms * MILLI, message.by)
            self._arm("inhibit", topic, message.ms, self._end_inhibition)
            if self.silent.get(topic) != message.hold:
                self.silent[topic] = message.hold
                self._body.silence(topic)
            self.changed()
        else:
            self._end_inhibition(topic)
        self._done(message.id, [])

    def _end_inhibition(self, topic: str) -> None:
        self._disarm("inhibit", topic)
        if self.silent.pop(topic, None) is None:
            return
        del self._inhibitions[topic]
        self._body.silence(topic)
        self.changed()

    # --- what they need ------------------------------------------------------------------------------------

    def _load(self) -> None:
        stopped = self._latch.load()
        if stopped is not None:
            self._authority.stop(stopped, self._now())
            self._looks, self._unthrown = LOOKS, True
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

    def _arm(self, kind: str, topic: str, ms: int, end: Callable[[str], None]) -> None:
        self._disarm(kind, topic)
        self._timers[kind, topic] = self._clock.callLater(ms / 1000, partial(end, topic))

    def _disarm(self, kind: str, topic: str) -> None:
        timer = self._timers.pop((kind, topic), None)
        if timer is not None and timer.active():
            timer.cancel()

    def _done(self, id: int, problems: list[str]) -> None:
        self._body.say(link.Done(id=id, ok=not problems, reason="; ".join(problems)))

    def _tell(self) -> None:
        told = safety(self._authority, self._motion.moving, self._inhibitions, self.limits, self._now())
        self._body.say(told)


def _unheard(topics: Iterable[str]) -> list[str]:
    return [f"zero could not be said on {topic}" for topic in topics]
