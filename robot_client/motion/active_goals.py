"""Goals that move the robot must not outlive the daemon that sent them.

The guard is notified of goals as of commands: under the name of the action's cancel service, repeatedly while a goal is
active. When the notifications end, or the daemon is gone, the guard cancels the goals. The actions are also stored on
the disk, so that a daemon whose guard died with it can cancel leftover goals at its next start.

A goal that was given up while its action may still execute it is *orphaned*. It counts as active for the guard and the
store until its action, seen again, answers that it cancels the goal or does not know it. A goal that has to end, as its
driver has lost control or the robot is stopped, is cancelled again until it has ended, as an action may refuse.
"""

from __future__ import annotations

from collections.abc import Callable
from fnmatch import fnmatchcase
from operator import itemgetter
from typing import Any, TypeVar

from twisted.internet.defer import Deferred, succeed
from twisted.logger import Logger

from relay_protocol.errors import Unavailable
from robot_client.motion.goal_canceller import GoalCanceller
from robot_client.motion.guard_port import GuardPort
from robot_client.motion.guard_protocol import cancelling
from robot_client.motion.stop_store import StopStore
from robot_client.platforms.base import GoalHandle, GoalOutcome
from robot_client.twisted_types import DelayedCall

NOTIFY_GUARD_EVERY = 0.2
"""Seconds between two notifications of the guard that a goal is still active."""

GUARD_CLIENT_SECONDS = 30.0
"""Seconds the guard keeps its client of an action after the last goal ended, as another may follow."""

LEFTOVER_ATTEMPTS = 30
"""Attempts, one second apart, to find actions with leftover goals: nodes may be discovered after the daemon's start."""

CANCEL_AGAIN_AFTER = 1_000_000_000
"""Nanoseconds a cancelled goal may take to end before it is cancelled again."""

LINK_UNPROVEN_AFTER = 2_000_000_000
"""Nanoseconds without an answer of the relay after which goals are cancelled, as no client could cancel them."""

ORPHAN_SECONDS = 600.0
"""Seconds for which a missing action is awaited that has an orphaned goal, or refused to cancel its goals."""

MAX_ORPHANED = 64
"""Most orphaned goals remembered."""

MAX_CANCELLING = 64
"""Most late goals that are being cancelled at a time."""

GOALS_END_SECONDS = 1.5
"""Seconds a daemon that shuts down waits for its cancelled goals to end."""

Ended = TypeVar("Ended")

MAX_ACTIONS = 64
"""Most actions that execute goals at a time."""


class _ActiveGoal:
    """A goal that has not ended.

    :param began_at: own clock, nanoseconds
    """

    def __init__(self, action: str, began_at: int) -> None:
        self.action = action
        self.began_at = began_at
        self.cancelled_at: int | None = None
        """When it was first cancelled, own clock, nanoseconds; ``None``: it was not."""
        self.is_cancelling = False
        self.attempts = 0
        """How often it was cancelled again."""


class _OrphanedGoal:
    """A goal that its action may still execute, although it was given up.

    :param until: when it is forgotten, seconds of the reactor's clock
    """

    def __init__(self, action: str, until: float) -> None:
        self.action = action
        self.until = until
        self.is_cancelling = False


class ActiveGoals:
    """Tracks which actions that move the robot execute goals of this daemon, and cancels those of an earlier one.

    :param patterns: patterns of all actions that move the robot, used where the store can't be read
    :param goal_canceller: cancels goals
    :param stop_store: stores the actions with goals
    :param clock: for timers
    :param now: clock of :mod:`relay_protocol.clocks`, nanoseconds
    """

    def __init__(
        self,
        patterns: list[str],
        guard: GuardPort,
        goal_canceller: GoalCanceller,
        stop_store: StopStore,
        clock: Any,
        now: Callable[[], int],
    ) -> None:
        self._guard = guard
        self._goal_canceller = goal_canceller
        self._store = stop_store
        self._clock = clock
        self._now = now
        self._goal_counts: dict[str, int] = {}
        """Number of goals by action, including orphaned ones; 0 while only the guard's client is kept."""
        self._prepared: set[str] = set()
        """Actions in the graph, of which the guard has clients."""
        self.link_proven_at: Callable[[], int] = now
        """Returns when the latest ping that the relay has answered was sent, nanoseconds of ``now``."""
        self.on_active: Callable[[bool], None] = lambda active: None
        """Called with true when the first goal begins, and with false when the last one has ended."""
        self.on_changed: Callable[[], None] = lambda: None
        """Called when :attr:`active_actions` has changed."""
        self._active: dict[GoalHandle, _ActiveGoal] = {}
        self._cancelled_unproven: set[GoalHandle] = set()
        """Goals cancelled because the relay did not answer."""
        self._orphaned: dict[bytes, _OrphanedGoal] = {}
        """Orphaned goals by id, the oldest first."""
        self._waiters: list[Deferred[list[str]]] = []
        """Fired when no goal is active."""
        self._forget_timers: dict[str, DelayedCall] = {}
        self._guard_timer: DelayedCall | None = None
        self._log = Logger("goals")
        stored = stop_store.load_actions()
        self._leftover = set(patterns if stored is None else stored)
        """Actions, or patterns of them, whose leftover goals are still to be cancelled."""
        self._refusing: set[str] = set()
        """Actions with leftover goals that refuse to cancel them."""
        self._missing_since: dict[str, float] = {}
        """By refusing action, since when it is missing in the graph, seconds."""
        self._leftover_cancelled: set[str] = set()
        self._attempts_left = LEFTOVER_ATTEMPTS if self._leftover else 0
        if self._leftover:
            names = ", ".join(sorted(self._leftover))
            self._log.warn("an earlier daemon left goals of {names}; they are cancelled", names=names)

    def retry_cancels(self) -> None:
        """Cancel leftover, orphaned and late goals, and prepare the guard; to be called every second."""
        present = self._goal_canceller.actions()
        self._prepare_guard(self._goal_canceller.moving_actions)
        if self._orphaned:
            self._cancel_orphaned()
        self._cancel_late_again()
        if not self._leftover:
            return
        self._attempts_left = max(0, self._attempts_left - 1)
        self._give_up_missing(present)
        for action in present:
            if self._is_leftover(action):
                self._goal_canceller.cancel_all_checked(action).addCallback(
                    self._leftover_cancel_answered, action
                )
        if not self._attempts_left and self._leftover != self._refusing:
            # The others never appeared. Refusing actions still have goals that this daemon does not know.
            self._leftover = set(self._refusing)
            self._save_actions()

    def _prepare_guard(self, present: list[str]) -> None:
        """Have the guard's clients of actions in the graph ready before a goal begins, as DDS takes time to match them.

        :param present: actions that move the robot
        """
        found = set(present[:MAX_ACTIONS])
        for action in found - self._prepared:
            self._guard.add_topic(cancelling(action))
        for action in self._prepared - found - self._goal_counts.keys():
            self._guard.forget(cancelling(action))
        self._prepared = found

    @property
    def active_actions(self) -> list[str]:
        """The actions that execute goals, or may do so, sorted."""
        return sorted(action for action, goals in self._goal_counts.items() if goals)

    @property
    def uncancelled_actions(self) -> list[str]:
        """The actions that may still execute goals cancelled :data:`CANCEL_AGAIN_AFTER` ago or earlier, sorted."""
        late = {each.action for each in self._late().values()}
        return sorted(late | {each.action for each in self._orphaned.values()} | self._refusing)

    def goals_ended(self, seconds: float) -> Deferred[list[str]]:
        """Fires with :attr:`active_actions` when only orphaned goals are left, or after ``seconds``."""
        if not self._active:
            return succeed(self.active_actions)
        waiting: Deferred[list[str]] = Deferred(self._waiters.remove)
        self._waiters.append(waiting)
        return waiting.addTimeout(seconds, self._clock, lambda *_: self.active_actions)

    def check(self, action: str) -> None:
        """Check that a goal of an action may begin.

        :param action: its full name
        :raises Unavailable: leftover goals of it are still being cancelled, the guard can't cancel its goals yet, or
            too many actions have goals
        """
        if self._is_leftover(action):
            raise Unavailable(
                f"{action} still has goals of before the robot's daemon was started, which are being cancelled; "
                "try again in a moment"
            )
        if (
            action not in self._goal_counts
            and len(self._goal_counts) >= MAX_ACTIONS
            and not self._forget_timers
        ):
            raise Unavailable(
                f"{MAX_ACTIONS} actions that move the robot are in use; wait until one has ended"
            )
        if action not in self._prepared:
            self._goal_canceller.actions()
            self._prepare_guard(self._goal_canceller.moving_actions)
        # An action that is not in the graph ends its goal by itself.
        if action in self._prepared and not self._guard.ready(cancelling(action)):
            raise Unavailable(
                f"the robot's guard can't cancel goals of {action} yet, as it must if the daemon dies; "
                "try again in a moment"
            )

    def add(self, action: str, goal: GoalHandle) -> None:
        """Track a goal that has begun.

        :param action: its full name
        """
        timer = self._forget_timers.pop(action, None)
        if timer is not None:
            timer.cancel()
        if action not in self._goal_counts and len(self._goal_counts) >= MAX_ACTIONS:
            self._forget(next(iter(self._forget_timers)))
        self._goal_counts[action] = self._goal_counts.get(action, 0) + 1
        if self._goal_counts[action] == 1:
            self._guard.add_topic(cancelling(action))
            self._guard.note_command(cancelling(action), True, self._now())
            self._save_actions()
            self.on_changed()
        if self._guard_timer is None:
            self._guard_timer = self._clock.callLater(NOTIFY_GUARD_EVERY, self._notify_guard)
        self._active[goal] = _ActiveGoal(action, self._now())
        if len(self._active) == 1:
            self.on_active(True)
        goal.result.addBoth(self._goal_ended, action, goal)

    def note_cancelled(self, goal: GoalHandle) -> None:
        """Note that a goal was cancelled and has to end; while it does not, it is cancelled again."""
        known = self._active.get(goal)
        if known is not None and known.cancelled_at is None:
            known.cancelled_at = self._now()

    def _late(self) -> dict[GoalHandle, _ActiveGoal]:
        latest = self._now() - CANCEL_AGAIN_AFTER
        return {
            goal: each
            for goal, each in self._active.items()
            if each.cancelled_at is not None and each.cancelled_at <= latest
        }

    def _cancel_late_again(self) -> None:
        """Cancel late goals again, those with the fewest attempts first."""
        late = self._late()
        if not late:
            return
        present = set(self._goal_canceller.actions())
        idle = [
            (each.attempts, goal, each)
            for goal, each in late.items()
            if not each.is_cancelling and each.action in present
        ]
        free = MAX_CANCELLING - sum(each.is_cancelling for each in late.values())
        for _, goal, each in sorted(idle, key=itemgetter(0))[: max(0, free)]:
            each.is_cancelling = True
            each.attempts += 1
            self._goal_canceller.cancel(each.action, goal.id).addCallback(self._late_cancel_answered, each)

    def _late_cancel_answered(self, refusal: str | None, each: _ActiveGoal) -> None:
        """Note that a further cancel request has ended; only the goal's result shows whether the goal has."""
        each.is_cancelling = False

    def _goal_ended(self, outcome: Ended, action: str, goal: GoalHandle) -> Ended:
        del self._active[goal]
        self._cancelled_unproven.discard(goal)
        if isinstance(outcome, GoalOutcome) and outcome.certain:
            self._count_ended(action)
        else:
            self._orphan(action, goal)
        self._notify_if_none()
        return outcome

    def _count_ended(self, action: str) -> None:
        self._goal_counts[action] -= 1
        if not self._goal_counts[action]:
            self._guard.note_command(cancelling(action), False, self._now())
            self._forget_timers[action] = self._clock.callLater(GUARD_CLIENT_SECONDS, self._forget, action)
            self._save_actions()
            self.on_changed()

    def _notify_if_none(self) -> None:
        if self._active:
            return
        self.on_active(False)
        waiting, self._waiters = self._waiters, []
        for each in waiting:
            each.callback(self.active_actions)

    def _orphan(self, action: str, goal: GoalHandle) -> None:
        if len(self._orphaned) >= MAX_ORPHANED:
            self._give_up_orphan(next(iter(self._orphaned)))
        self._orphaned[goal.id] = _OrphanedGoal(action, self._clock.seconds() + ORPHAN_SECONDS)
        self._log.warn(
            "a goal of {action} may continue; it is cancelled when the action is in the graph again",
            action=action,
        )

    def _cancel_orphaned(self) -> None:
        present = set(self._goal_canceller.actions())
        now = self._clock.seconds()
        for id, each in list(self._orphaned.items()):
            if now >= each.until:
                self._give_up_orphan(id)
            elif each.action in present and not each.is_cancelling:
                each.is_cancelling = True
                self._goal_canceller.cancel(each.action, id).addCallback(
                    self._orphan_cancel_answered, id, each
                )

    def _orphan_cancel_answered(self, refusal: str | None, id: bytes, each: _OrphanedGoal) -> None:
        """Handle the answer to the cancel request of an orphaned goal; only one without a refusal ends the goal."""
        each.is_cancelling = False
        if refusal == "" and self._orphaned.pop(id, None) is not None:
            self._count_ended(each.action)

    def _give_up_orphan(self, id: bytes) -> None:
        action = self._orphaned.pop(id).action
        self._log.warn("a goal of {action} may continue; it is no longer tracked", action=action)
        self._count_ended(action)

    def _forget(self, action: str) -> None:
        timer = self._forget_timers.pop(action)
        if timer.active():
            timer.cancel()
        del self._goal_counts[action]
        if action not in self._prepared:
            self._guard.forget(cancelling(action))

    def _notify_guard(self) -> None:
        self._guard_timer = None
        self._cancel_unproven()
        actions = self.active_actions
        for action in actions:
            self._guard.note_command(cancelling(action), True, self._now())
        if actions:
            self._guard_timer = self._clock.callLater(NOTIFY_GUARD_EVERY, self._notify_guard)

    def _cancel_unproven(self) -> None:
        latest = self._now() - LINK_UNPROVEN_AFTER
        if self.link_proven_at() >= latest:
            return
        for goal in [goal for goal, each in self._active.items() if each.began_at < latest]:
            if goal in self._cancelled_unproven:
                continue
            self._cancelled_unproven.add(goal)
            self._log.warn(
                "the relay has not answered for {time:g} s: a goal is cancelled",
                time=LINK_UNPROVEN_AFTER / 1e9,
            )
            try:
                goal.cancel()
            except Exception:  # a failure of one goal must not prevent cancelling the next
                self._log.failure("a goal could not be cancelled")
            self.note_cancelled(goal)

    def _is_leftover(self, action: str) -> bool:
        return action not in self._leftover_cancelled and any(
            fnmatchcase(action, each) for each in self._leftover
        )

    def _leftover_cancel_answered(self, refusal: str | None, action: str) -> None:
        """Handle the answer to the cancel request of leftover goals, as of :meth:`GoalCanceller.cancel_all_checked`."""
        if refusal is None:
            return
        if refusal:
            if self._is_leftover(action) and action not in self._refusing:
                self._refusing.add(action)
                self._leftover.add(action)
                self._save_actions()
            return
        self._refusing.discard(action)
        self._leftover_cancelled.add(action)
        if action in self._leftover:
            self._leftover.discard(action)
            self._save_actions()

    def _give_up_missing(self, present: list[str]) -> None:
        """Give up refusing actions that stay missing: their goals have most likely ended with their nodes.

        :param present: the actions in the graph now
        """
        now = self._clock.seconds()
        self._missing_since = {
            action: self._missing_since.get(action, now) for action in self._refusing.difference(present)
        }
        lost = {action for action, since in self._missing_since.items() if now - since >= ORPHAN_SECONDS}
        if not lost:
            return
        for action in sorted(lost):
            self._log.warn("goals of {action} may continue; they are no longer tracked", action=action)
            self._goal_canceller.forget(action)
        self._refusing -= lost
        self._leftover -= lost
        self._save_actions()

    def _save_actions(self) -> None:
        try:
            self._store.store_actions(sorted({*self.active_actions, *self._leftover}))
        except Unavailable as error:
            self._log.warn("{why}", why=str(error))
