"""Carries out the relay's orders about control, and answers each when it has taken effect (SPEC 2.4, 2.5)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from twisted.internet.defer import Deferred, maybeDeferred, succeed
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_protocol.limits import LIST_ITEMS
from relay_protocol.link.motion import ControlOrder
from robot_client.alerts import AlertCondition
from robot_client.motion.authority import NO_SOURCE, Authority, Suppression
from robot_client.motion.command_age import MILLI
from robot_client.motion.goal_canceller import ANSWER_SECONDS, STOP_SECONDS, GoalCanceller, list_names
from robot_client.motion.graph_zero_publisher import GraphZeroPublisher
from robot_client.motion.hardware import Hardware
from robot_client.motion.inhibition import Inhibitions
from robot_client.motion.motion_control import MotionControl
from robot_client.motion.robot_port import RobotPort
from robot_client.motion.state_reporter import StateReporter, motion_state
from robot_client.motion.stop_store import StopRecorder, StopStore, stopped_but
from robot_client.motion.unlimited_command_alert import UnlimitedCommandAlert
from robot_client.twisted_types import DelayedCall

CHECK_EVERY = 1.0
"""Seconds between two calls of :meth:`ControlOrderHandler.check`."""

STORE_EVERY = 10
"""Checks between two attempts to store a stop after a failure, as writing may block."""

UNEXPECTED_ERROR = "a part of this order failed; the robot's log says why"


class _PendingStop:
    """A stop that is not answered yet.

    :param id: of the order, for its answer
    :param earlier_problems: earlier problems, of which an alert was sent already
    """

    def __init__(self, id: int, earlier_problems: Iterable[str] = ()) -> None:
        self.id = id
        self.earlier_problems = earlier_problems
        self.problems: list[str] = []
        """Problems of this stop, reported in one alert."""


class ControlOrderHandler:
    """Carries out orders of the relay: grants of control, stops, resumes, suppressions, inhibitions.

    :param stop_store: stores the stop
    :param goal_canceller: cancels all goals that move the robot, of any client
    :param graph_zero_publisher: publishes zero on topics that other nodes command
    :param robot: the rest of the daemon
    :param clock: for timers
    :param now: clock of :mod:`relay_protocol.clocks`, nanoseconds
    :param wall: Unix time, seconds
    """

    def __init__(
        self,
        *,
        authority: Authority,
        motion: MotionControl,
        stop_store: StopStore,
        hardware: Hardware,
        goal_canceller: GoalCanceller,
        graph_zero_publisher: GraphZeroPublisher,
        robot: RobotPort,
        clock: Any,
        now: Callable[[], int],
        wall: Callable[[], float],
    ) -> None:
        self.limits: dict[str, link.Limits] = {}
        """Speed limits by level, for the reported state."""
        self.on_stopped: Callable[[bool], None] = lambda stopped: None
        """Called when the robot was stopped or resumed, with whether it is stopped."""
        self._authority = authority
        self._motion = motion
        self._hardware = hardware
        self._goal_canceller = goal_canceller
        self._graph_zero_publisher = graph_zero_publisher
        self._robot = robot
        self._clock = clock
        self._now = now
        self._wall = wall
        self._inhibitions = Inhibitions(robot, self.state_changed, clock, now)
        self.inhibited = self._inhibitions.inhibited
        """Inhibited topics, and whether they deliver their last value instead."""
        self._suppression_timers: dict[str, DelayedCall] = {}
        """Timers that end suppressions, by topic."""
        self._pending_stops: list[_PendingStop] = []
        """Stops that wait until hardware and actions have stopped."""
        self._stop_recorder = StopRecorder(stop_store, robot.alert)
        self._resuming: int | None = None
        """Id of the resume that is under way; a stop ends it."""
        self._checks = 0
        """Checks while the robot was stopped."""
        self._zero_pending = False
        """Whether zero is still to be published on topics of other nodes, for a stop from before the daemon's start."""
        self._uncancelled_alert = AlertCondition(robot.alert, "stop", "actions")
        """About goals that continue while the robot is stopped."""
        self._orphaned_alert = AlertCondition(robot.alert, "control", "goals")
        """About goals that continue after their client has lost control."""
        self._hardware_alert = AlertCondition(robot.alert, "stop", "hardware")
        self._unlimited_alert = UnlimitedCommandAlert(robot.alert)
        self._reporter = StateReporter(clock, self._send_state)
        self._log = Logger("motion")
        self._handlers: dict[type, Callable[[Any], None]] = {
            link.ControlGrant: self._grant,
            link.Stop: self._stop,
            link.Resume: self._resume,
            link.Suppress: self._suppress,
            link.Inhibit: self._inhibit,
        }
        motion.on_moving = self.state_changed
        motion.on_unreadable = self._unlimited_alert.refused
        hardware.on_problems = self._alert_hardware
        self._restore_stop(stop_store.load())

    def handle(self, message: link.Message) -> bool:
        """Carry out a message; return whether it is such an order."""
        if not isinstance(message, ControlOrder):
            return False
        try:
            self._handlers[type(message)](message)
        except SwitchboardError as error:
            self._answer(message.id, [str(error)])
        except Exception:
            # An unexpected error of the middleware must not leave the relay without an answer.
            self._log.failure("an order of the relay failed")
            self._answer(message.id, [UNEXPECTED_ERROR])
        return True

    def registered(self) -> None:
        """Begin to report the state, as the control link is established."""
        self._authority.link_restored(self._now())
        self._reporter.begin()

    def link_lost(self) -> None:
        """End control, suppressions and inhibitions, as the control link is lost."""
        self._authority.link_lost(self._now())
        self._unlimited_alert.end()
        for topic in list(self._suppression_timers):
            self._cancel_suppression_timer(topic)
        self._inhibitions.end()
        self._reporter.end()

    def state_changed(self) -> None:
        """Report the state, as something in ``motion_state`` has changed."""
        self._reporter.state_changed()

    def check(self) -> None:
        """Continue a stop that is not complete, also one from before the daemon's start; alert of goals that continue.

        To be called every :data:`CHECK_EVERY` seconds.
        """
        self._hardware.prepare()
        self._alert_orphaned(self._robot.uncancelled_actions)
        if self._authority.stopped is None:
            return
        self._checks += 1
        if self._zero_pending:
            self._zero_pending = False
            self._graph_zero_publisher.start()
        self._goal_canceller.retry()
        if not self._pending_stops:
            self._alert_uncancelled()
            self._hardware.retry()
        if self._stop_recorder.problem and self._checks % STORE_EVERY == 0:
            self._stop_recorder.store(self._authority.stopped)

    # --- orders ----------------------------------------------------------------------------------------------

    def _grant(self, message: link.ControlGrant) -> None:
        failed: list[str] = []
        goals: Deferred[list[str]] = succeed([])
        self._unlimited_alert.end()
        if self._authority.grant_control(message.holder, message.user, message.level, self._now()):
            self._log.info(
                "control: {who} ({why})",
                who=f"{message.user or 'a client'}, source {message.holder}" if message.holder else "nobody",
                why=message.why or "no reason given",
            )
            failed = self._motion.stop_moving_topics("control changes", gently=True)
            self._robot.cancel_goals(only_moving=True)
            goals = self._robot.goals_ended(ANSWER_SECONDS)
        self.state_changed()
        ramps = self._motion.ramps_ended()
        ramps.addCallback(
            lambda also: goals.addCallback(lambda actions: self._granted(message, failed + also, actions)),
        )

    def _granted(self, message: link.ControlGrant, failed: list[str], actions: list[str]) -> None:
        """Answer a grant, after the stop of the former holder's motion and goals.

        :param failed: topics on which zero could not be published; then no client gets control
        :param actions: actions whose goals have not ended in time
        """
        if actions:
            self._alert_orphaned(actions)
        if failed and self._authority.holder == message.holder:
            self._authority.grant_control(NO_SOURCE, "", "", self._now())
            self.state_changed()
        self._answer(message.id, _zero_failures(failed))

    def _alert_orphaned(self, actions: list[str]) -> None:
        """Alert of cancelled goals that continue; during a stop another alert covers them."""
        if actions and not self._orphaned_alert.text and self._authority.stopped is not None:
            return
        text = f"cancelled goals of {list_names(actions)} may continue; they are cancelled again every second"
        self._orphaned_alert.update(text if actions else "", "no cancelled goal is known to continue")

    def _stop(self, message: link.Stop) -> None:
        """Refuse motion, publish zero, cancel goals, set the switches, store the stop; answer when all have ended."""
        new = self._authority.stopped is None
        stopped = link.Stopped(by=message.by, since=message.at or self._wall(), why=message.why)
        self._authority.stop(stopped, self._now())
        self._resuming = None
        stop = _PendingStop(message.id)
        self._pending_stops.append(stop)
        why = f"{message.by} stopped the robot ({message.why or 'no reason given'})"
        self._attempt(stop.problems, self._motion.zero_commanded_topics, why).addCallback(
            _zero_failures
        ).addCallback(stop.problems.extend)
        self._attempt(stop.problems, self._robot.cancel_goals, False)
        self._attempt(stop.problems, self.state_changed)
        self._attempt(stop.problems, self.on_stopped, True)
        # Before the stop is stored, as the disk may be slow.
        stopping = self._stop_other_motion(stop)
        if new or self._stop_recorder.problem:
            self._attempt(stop.problems, self._stop_recorder.store, self._authority.stopped or stopped)
        stopping.addCallback(self._stop_done, stop).addErrback(self._answer_failed, message.id)

    def _stop_other_motion(self, stop: _PendingStop) -> Deferred[list[str]]:
        """Stop motion that clients' commands do not cause; fires with problems of the hardware."""
        hardware = self._attempt(stop.problems, self._hardware.stop)
        cancelled = self._attempt(stop.problems, self._goal_canceller.stop).addCallback(stop.problems.extend)
        self._attempt(stop.problems, self._graph_zero_publisher.start)
        ended = self._attempt(stop.problems, self._robot.goals_ended, STOP_SECONDS)

        async def all_done() -> list[str]:
            problems: list[str] = await hardware
            await cancelled
            await ended
            return problems

        return Deferred.fromCoroutine(all_done())

    def _attempt(self, problems: list[str], do: Callable[..., Any], *args: Any) -> Deferred[Any]:
        """Do a part of an order. Its unexpected errors must not prevent the other parts.

        :param problems: receives a text for such an error
        """
        return maybeDeferred(do, *args).addErrback(self._log_unexpected, problems)

    def _log_unexpected(self, failure: Failure, problems: list[str]) -> list[str]:
        self._log.failure("a part of an order of the relay failed", failure)
        problems.append(UNEXPECTED_ERROR)
        return []

    def _answer_failed(self, failure: Failure, id: int) -> None:
        self._log.failure("an order of the relay failed", failure)
        self._answer(id, [UNEXPECTED_ERROR])

    def _alert_hardware(self, problems: list[str]) -> None:
        self._hardware_alert.update(stopped_but(problems), "the hardware switch is set")

    def _stop_done(self, hardware_problems: list[str], stop: _PendingStop) -> None:
        """Answer a stop whose parts have all ended, with its problems."""
        self._pending_stops.remove(stop)
        if stop.problems:  # Other problems have alerts of their own that end with them.
            self._robot.alert("error", stopped_but(list(dict.fromkeys(stop.problems))))
        unstored = [self._stop_recorder.problem] if self._stop_recorder.problem else []
        problems = [
            *stop.earlier_problems,
            *stop.problems,
            *unstored,
            *hardware_problems,
            *self._alert_uncancelled(),
        ]
        self._answer(stop.id, list(dict.fromkeys(problems)))

    def _alert_uncancelled(self) -> list[str]:
        """Alert of goals that a stop has not ended in time; return sentences about them."""
        problems = self._goal_canceller.problems(self._robot.active_actions)
        self._uncancelled_alert.update(
            stopped_but(problems), "all goals that moved the stopped robot are cancelled"
        )
        return problems

    def _resume(self, message: link.Resume) -> None:
        if self._authority.stopped is None:
            self._answer(message.id, [])
            return
        if self._pending_stops or self._resuming is not None:
            raise Unavailable(
                "the robot is still being stopped or resumed; resume it again when that is done"
            )
        self._resuming = message.id
        problems: list[str] = []
        resumed = self._attempt(problems, self._hardware.resume)
        resumed.addCallback(lambda more: self._resumed(message, problems + more))
        resumed.addErrback(self._resume_failed, message)

    def _resumed(self, message: link.Resume, problems: list[str]) -> None:
        if self._resuming != message.id:
            self._answer(message.id, ["the robot was stopped again while it was being resumed"])
            return
        self._resuming = None
        released = not problems
        if released:
            problems = self._stop_recorder.clear()
        if problems:
            self._stay_stopped(message, problems, maybe_unstored=released)
            return
        self._goal_canceller.end()
        self._graph_zero_publisher.end()
        self._authority.resume(self._now())
        self._zero_pending = False
        self._stop_recorder.end()
        for condition in (self._uncancelled_alert, self._hardware_alert):
            condition.update("", "the robot is resumed")
        self._log.info("resumed by {who} ({why})", who=message.by, why=message.why or "no reason given")
        self.state_changed()
        self.on_stopped(False)
        self._answer(message.id, [])

    def _resume_failed(self, failure: Failure, message: link.Resume) -> None:
        """Handle an unexpected error in a resume: stop again what it released, if the robot is not resumed yet."""
        if self._authority.stopped is None:
            self._answer_failed(failure, message.id)
            return
        problems: list[str] = []
        self._log_unexpected(failure, problems)
        self._stay_stopped(message, problems, maybe_unstored=True)

    def _stay_stopped(self, message: link.Resume, problems: list[str], maybe_unstored: bool) -> None:
        """Handle a resume that failed half-way: stop again what it released, then answer that the robot stays stopped.

        :param maybe_unstored: whether the stop may no longer be stored
        """
        stop = _PendingStop(message.id, problems)
        self._pending_stops.append(stop)
        self._attempt(
            stop.problems, self._robot.alert, "error", f"the robot stays stopped: {'; '.join(problems)}"
        )
        stopping = self._stop_other_motion(stop)
        if maybe_unstored and self._authority.stopped is not None:
            self._attempt(stop.problems, self._stop_recorder.store, self._authority.stopped)
        stopping.addCallback(self._stop_done, stop).addErrback(self._answer_failed, message.id)

    def _suppress(self, message: link.Suppress) -> None:
        topic = self._motion_topic(message.resource)
        if message.ms:
            until = self._now() + message.ms * MILLI
            suppression = Suppression(frozenset(message.sources), until, message.by)
            if not self._authority.suppress(topic, suppression):
                raise Unavailable(f"{LIST_ITEMS} topics are suppressed already")
            self._cancel_suppression_timer(topic)
            self._suppression_timers[topic] = self._clock.callLater(
                message.ms / 1000, self._end_suppression, topic
            )
            self._motion.stop_unless_allowed(topic, f"suppressed by {message.by or 'a client'}")
            self.state_changed()
        else:
            self._end_suppression(topic)
        self._answer(message.id, [])

    def _end_suppression(self, topic: str) -> None:
        self._cancel_suppression_timer(topic)
        if topic not in self._authority.suppressions:
            return
        self._authority.end_suppression(topic)
        self._motion.stop_unless_allowed(topic, "its suppression has ended")
        self.state_changed()

    def _inhibit(self, message: link.Inhibit) -> None:
        self._inhibitions.handle(message)
        self._answer(message.id, [])

    # --- helpers ------------------------------------------------------------------------------------

    def _restore_stop(self, stopped: link.Stopped | None) -> None:
        if stopped is not None:
            self._authority.stop(stopped, self._now())
            self._zero_pending = True
            self._hardware.begin_stopped()
            self._goal_canceller.begin_stopped()
            self._log.warn(
                "the robot was stopped before the daemon's start, by {who} ({why})",
                who=stopped.by,
                why=stopped.why or "no reason given",
            )

    def _motion_topic(self, resource: str) -> str:
        topic, types = self._robot.find_topic(resource)
        if self._motion.may_be_commanded(topic) or any(
            self._motion.policy.moves_by_topic(topic, each) for each in types
        ):
            return topic
        if types:
            raise Invalid(f"{topic} does not move the robot, so there is nothing to suppress")
        raise NotFound(f"there is no topic {topic} on this robot")

    def _cancel_suppression_timer(self, topic: str) -> None:
        timer = self._suppression_timers.pop(topic, None)
        if timer is not None and timer.active():
            timer.cancel()

    def _answer(self, id: int, problems: list[str]) -> None:
        self._robot.send(link.OrderResult(id=id, ok=not problems, reason="; ".join(problems)))

    def _send_state(self) -> None:
        moving = self._motion.moving or bool(self._robot.active_actions)
        state = motion_state(self._authority, moving, self._inhibitions.by_topic, self.limits, self._now())
        self._robot.send(state)


def _zero_failures(topics: Iterable[str]) -> list[str]:
    return [f"zero could not be published on {topic}" for topic in topics]
