"""Goals that move the robot must not outlive the daemon that had them pursued.

The guard hears of them as of commands on topics: of each action by the service that cancels its goals, again and again
as long as one is under way. When that ceases, or the daemon is gone, it has them cancelled. And a note of those actions
lies on the disk, so that a daemon whose guard died with it finds at its next start what was left.

A goal that was given up though its action may go on with it is *adrift*: it counts as under way for guard and note
until its action, seen again, has answered that it cancels it, or knows nothing of it. One that is to end, as its driver
has lost control or the robot is stopped, is asked to again until it has ended: an action may refuse that, and go on.
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

BEAT = 0.2
"""Seconds between two words to the guard that the daemon is still there."""

KEPT = 30.0
"""Seconds the guard stays able to cancel an action's goals after the last one ended: another may follow."""

LOOKS = 30
"""How often to look for actions that were left goals, a second apart: nodes may be found after the daemon's start."""

OVERDUE = 1_000_000_000
"""Nanoseconds a goal that is cancelled may take to end before it is asked to again."""

UNPROVEN = 2_000_000_000
"""Nanoseconds without proof of the relay after which goals are cancelled: nobody who gave one could end it then."""

ADRIFT = 600.0
"""Seconds in which an action that was lost with a goal, or refused to cancel those it has, is looked for."""

MAX_ADRIFT = 64
"""Goals adrift that are remembered."""

MAX_ASKING = 64
"""Goals that are being asked to end at a time."""

FAREWELL = 1.5
"""Seconds a daemon that leaves waits for the goals it has cancelled to end."""

Ended = TypeVar("Ended")

MAX_ACTIONS = 64
"""Actions that are had pursue goals at a time."""


class _UnderWay:
    """A goal that has not ended.

    :param began: own clock, nanoseconds
    """

    def __init__(self, action: str, began: int) -> None:
        self.action = action
        self.began = began
        self.ending: int | None = None
        """Since when it is to end, own clock, nanoseconds."""
        self.asking = False
        self.asked = 0
        """How often it was asked to once more."""


class _Adrift:
    """A goal that may go on.

    :param until: when it is forgotten, seconds
    """

    def __init__(self, action: str, until: float) -> None:
        self.action = action
        self.until = until
        self.asking = False


class ActiveGoals:
    """Knows which actions that move the robot pursue goals of this daemon, and ends those of the one before.

    :param everything: patterns of all actions that move the robot, for a note that can't be read
    :param latch: where the note is kept
    :param clock: for timers
    :param now: clock of :mod:`relay_protocol.clocks`, nanoseconds
    """

    def __init__(
        self,
        everything: list[str],
        guard: GuardPort,
        sweep: GoalCanceller,
        latch: StopStore,
        clock: Any,
        now: Callable[[], int],
    ) -> None:
        self._guard = guard
        self._sweep = sweep
        self._latch = latch
        self._clock = clock
        self._now = now
        self._running: dict[str, int] = {}
        """How many goals by action, also adrift; none where the guard is only kept able to cancel them."""
        self.proof: Callable[[], int] = now
        """When the latest ping that the relay has answered was sent."""
        self.on_pursuing: Callable[[bool], None] = lambda pursuing: None
        """Called when a goal is under way, and when none is any more."""
        self.on_changed: Callable[[], None] = lambda: None
        """Called when :attr:`pursued` is another."""
        self._under_way: dict[GoalHandle, _UnderWay] = {}
        self._doubted: set[GoalHandle] = set()
        """Those that were cancelled for want of proof."""
        self._adrift: dict[bytes, _Adrift] = {}
        """By the goal's id, the oldest first."""
        self._waiting: list[Deferred[list[str]]] = []
        """Who wants to know when none is left."""
        self._forgetting: dict[str, DelayedCall] = {}
        self._beating: DelayedCall | None = None
        self._log = Logger("pursuits")
        noted = latch.goals()
        self._left = set(everything if noted is None else noted)
        """Actions, or patterns of them, whose goals are still to be cancelled since before this start."""
        self._refusing: set[str] = set()
        """Those among them that have answered, but refuse."""
        self._missed: dict[str, float] = {}
        """Since when those that refuse are not there, seconds."""
        self._swept: set[str] = set()
        self._looks = LOOKS if self._left else 0
        if self._left:
            names = ", ".join(sorted(self._left))
            self._log.warn("a daemon before this left goals of {names}; they are cancelled", names=names)

    def look(self) -> None:
        """Cancel what a daemon before this left, what is adrift, and what is to end; to be called every second."""
        if self._adrift:
            self._look_for_adrift()
        self._ask_again()
        if not self._left:
            return
        self._looks = max(0, self._looks - 1)
        there = self._sweep.actions()
        self._miss(there)
        for action in there:
            if self._is_left(action):
                self._sweep.cancel_surely(action).addCallback(self._answered, action)
        if not self._looks and self._left != self._refusing:
            # Others never appeared. What refuses still has goals that nobody here knows of.
            self._left = set(self._refusing)
            self._note()

    @property
    def pursued(self) -> list[str]:
        """The actions that pursue goals, or may do so, sorted."""
        return sorted(action for action, goals in self._running.items() if goals)

    @property
    def overdue(self) -> list[str]:
        """The actions that may pursue goals which were to end a second ago or earlier, sorted."""
        late = {each.action for each in self._late().values()}
        return sorted(late | {each.action for each in self._adrift.values()} | self._refusing)

    def standing(self, seconds: float) -> Deferred[list[str]]:
        """Fires with :attr:`pursued`, when none is under way but what is adrift, or in so many seconds."""
        if not self._under_way:
            return succeed(self.pursued)
        waiting: Deferred[list[str]] = Deferred(self._waiting.remove)
        self._waiting.append(waiting)
        return waiting.addTimeout(seconds, self._clock, lambda *_: self.pursued)

    def check(self, action: str) -> None:
        """See that a goal of an action may begin.

        :param action: its full name
        :raises Unavailable: goals of it are still being cancelled, or goals of too many are under way
        """
        if self._is_left(action):
            raise Unavailable(
                f"{action} still has goals of before the robot's daemon was started, which are being cancelled; "
                "try again in a moment"
            )
        if action not in self._running and len(self._running) >= MAX_ACTIONS and not self._forgetting:
            raise Unavailable(
                f"{MAX_ACTIONS} actions that move the robot are in use; wait until one has ended"
            )

    def add(self, action: str, goal: GoalHandle) -> None:
        """A goal has begun.

        :param action: its full name
        """
        timer = self._forgetting.pop(action, None)
        if timer is not None:
            timer.cancel()
        if action not in self._running and len(self._running) >= MAX_ACTIONS:
            self._forget(next(iter(self._forgetting)))
        self._running[action] = self._running.get(action, 0) + 1
        if self._running[action] == 1:
            self._guard.topic(cancelling(action))
            self._guard.command(cancelling(action), True, self._now())
            self._note()
            self.on_changed()
        if self._beating is None:
            self._beating = self._clock.callLater(BEAT, self._beat)
        self._under_way[goal] = _UnderWay(action, self._now())
        if len(self._under_way) == 1:
            self.on_pursuing(True)
        goal.result.addBoth(self._ended, action, goal)

    def end(self, goal: GoalHandle) -> None:
        """See that a goal ends that was just cancelled, and must not go on: nobody drives the robot by it any more."""
        known = self._under_way.get(goal)
        if known is not None and known.ending is None:
            known.ending = self._now()

    def _late(self) -> dict[GoalHandle, _UnderWay]:
        least = self._now() - OVERDUE
        return {
            goal: each
            for goal, each in self._under_way.items()
            if each.ending is not None and each.ending <= least
        }

    def _ask_again(self) -> None:
        """Ask what was cancelled and goes on."""
        late = self._late()
        if not late:
            return
        there = set(self._sweep.actions())
        idle = [
            (each.asked, goal, each)
            for goal, each in late.items()
            if not each.asking and each.action in there
        ]
        free = MAX_ASKING - sum(each.asking for each in late.values())
        for _, goal, each in sorted(idle, key=itemgetter(0))[: max(0, free)]:
            each.asking = True
            each.asked += 1
            self._sweep.cancel(each.action, goal.id).addCallback(self._asked, each)

    def _asked(self, words: str | None, each: _UnderWay) -> None:
        """An action was asked once more; whether it has ended the goal its result says."""
        each.asking = False

    def _ended(self, outcome: Ended, action: str, goal: GoalHandle) -> Ended:
        del self._under_way[goal]
        self._doubted.discard(goal)
        if isinstance(outcome, GoalOutcome) and outcome.certain:
            self._over(action)
        else:
            self._drift(action, goal)
        self._tell_standing()
        return outcome

    def _over(self, action: str) -> None:
        self._running[action] -= 1
        if not self._running[action]:
            self._guard.command(cancelling(action), False, self._now())
            self._forgetting[action] = self._clock.callLater(KEPT, self._forget, action)
            self._note()
            self.on_changed()

    def _tell_standing(self) -> None:
        if self._under_way:
            return
        self.on_pursuing(False)
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            each.callback(self.pursued)

    def _drift(self, action: str, goal: GoalHandle) -> None:
        if len(self._adrift) >= MAX_ADRIFT:
            self._lose(next(iter(self._adrift)))
        self._adrift[goal.id] = _Adrift(action, self._clock.seconds() + ADRIFT)
        self._log.warn(
            "a goal of {action} may go on; it is cancelled when that is there again", action=action
        )

    def _look_for_adrift(self) -> None:
        there = set(self._sweep.actions())
        now = self._clock.seconds()
        for id, each in list(self._adrift.items()):
            if now >= each.until:
                self._lose(id)
            elif each.action in there and not each.asking:
                each.asking = True
                self._sweep.cancel(each.action, id).addCallback(self._caught, id, each)

    def _caught(self, words: str | None, id: bytes, each: _Adrift) -> None:
        """An action was asked to cancel a goal that was adrift; only one that does not refuse ends it."""
        each.asking = False
        if words == "" and self._adrift.pop(id, None) is not None:
            self._over(each.action)

    def _lose(self, id: bytes) -> None:
        action = self._adrift.pop(id).action
        self._log.warn("a goal of {action} may go on, and is looked for no longer", action=action)
        self._over(action)

    def _forget(self, action: str) -> None:
        timer = self._forgetting.pop(action)
        if timer.active():
            timer.cancel()
        del self._running[action]
        self._guard.forget(cancelling(action))

    def _beat(self) -> None:
        self._beating = None
        self._cancel_unproven()
        running = self.pursued
        for action in running:
            self._guard.command(cancelling(action), True, self._now())
        if running:
            self._beating = self._clock.callLater(BEAT, self._beat)

    def _cancel_unproven(self) -> None:
        least = self._now() - UNPROVEN
        if self.proof() >= least:
            return
        for goal in [goal for goal, each in self._under_way.items() if each.began < least]:
            if goal in self._doubted:
                continue
            self._doubted.add(goal)
            self._log.warn(
                "the relay has not answered for {time:g} s: a goal is cancelled", time=UNPROVEN / 1e9
            )
            try:
                goal.cancel()
            except Exception:  # one that fails must not keep the next from its end
                self._log.failure("a goal could not be cancelled")
            self.end(goal)

    def _is_left(self, action: str) -> bool:
        return action not in self._swept and any(fnmatchcase(action, each) for each in self._left)

    def _answered(self, words: str | None, action: str) -> None:
        """An action was asked to cancel its goals: ``None``, it was not heard of; else what it refused, in words."""
        if words is None:
            return
        if words:
            if self._is_left(action) and action not in self._refusing:
                self._refusing.add(action)
                self._left.add(action)
                self._note()
            return
        self._refusing.discard(action)
        self._swept.add(action)
        if action in self._left:
            self._left.discard(action)
            self._note()

    def _miss(self, there: list[str]) -> None:
        """Give up what refuses and does not come back: its goals have most likely ended with its node.

        :param there: the actions there are now
        """
        now = self._clock.seconds()
        self._missed = {action: self._missed.get(action, now) for action in self._refusing.difference(there)}
        lost = {action for action, since in self._missed.items() if now - since >= ADRIFT}
        if not lost:
            return
        for action in sorted(lost):
            self._log.warn("goals of {action} may go on, and are looked for no longer", action=action)
            self._sweep.forget(action)
        self._refusing -= lost
        self._left -= lost
        self._note()

    def _note(self) -> None:
        try:
            self._latch.keep_goals(sorted({*self.pursued, *self._left}))
        except Unavailable as error:
            self._log.warn("{why}", why=str(error))
