"""Goals over HTTP: given, told of, cancelled, and remembered for some minutes when they are over."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from contextlib import ExitStack
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

from twisted.internet.defer import Deferred

from relay_protocol.errors import NotFound, Refused, SwitchboardError, Unavailable
from relay_protocol.limits import MIB
from relay_protocol.rights import Operation
from relay_server.channel import resolve
from relay_server.clock import Clock, Timer, cancel
from relay_server.control import NotDone
from relay_server.inside import Guest, Guests
from relay_server.local.view import view
from relay_server.resources.desk import Asker, ResourceDesk, see_online
from relay_server.resources.goal import Ask, Goal, Owner, State
from relay_server.resources.listing import Listing
from relay_server.resources.states import tag_of
from relay_server.session.names import normal_type

KEPT_SECONDS = 600.0
"""Goals that are over can be read for so long."""

KEPT = 64
KEPT_BYTES = 4 * MIB
"""Of one user, over all robots: the oldest go first, the newest stays."""

UNDER_WAY = 64
"""Goals of one user that may be, over all robots."""


class Told(NamedTuple):
    """A status resource.

    :param body: JSON
    :param known: whether the asker has it already
    """

    body: bytes
    over: bool
    known: bool = False

    @property
    def etag(self) -> str:
        """The same for the same body."""
        return tag_of(self.body)


class Book:
    """All goals that were given and can be read still."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._of: dict[int, dict[str, Goal]] = {}
        """By user and id, the oldest first."""
        self._ended: dict[int, dict[Goal, Timer]] = {}
        """Those that are over, in the order of their ends, and when they are forgotten."""

    def of(self, owner: Owner, robot: str) -> dict[str, Goal]:
        """Those of an owner at a robot, by id."""
        mine = self._of.get(owner.user, {})
        return {id: goal for id, goal in mine.items() if (goal.owner, goal.robot) == (owner, robot)}

    def check_room(self, user: int) -> None:
        """:raises Unavailable: the user has too many under way"""
        if sum(not goal.over for goal in self._of.get(user, {}).values()) >= UNDER_WAY:
            raise Unavailable(f"{UNDER_WAY} goals of yours are under way already, the most one user may have")

    def add(self, goal: Goal) -> None:
        """One more."""
        self._of.setdefault(goal.owner.user, {})[goal.id] = goal

    def ended(self, goal: Goal) -> None:
        """One is over."""
        ended = self._ended.setdefault(goal.owner.user, {})
        ended[goal] = self._clock.callLater(KEPT_SECONDS, self.remove, goal)
        size = sum(each.size for each in ended)
        while len(ended) > 1 and (len(ended) > KEPT or size > KEPT_BYTES):
            oldest = next(iter(ended))
            size -= oldest.size
            self.remove(oldest)

    def remove(self, goal: Goal) -> None:
        """It can't be read any more."""
        user = goal.owner.user
        mine, ended = self._of.get(user, {}), self._ended.get(user, {})
        mine.pop(goal.id, None)
        cancel(ended.pop(goal, None))
        if not mine:
            self._of.pop(user, None)
        if not ended:
            self._ended.pop(user, None)


class GoalDesk:
    """Goals of those who come by HTTP.

    :param wall: Unix time in seconds
    """

    def __init__(
        self, clock: Clock, guests: Guests, resources: ResourceDesk, wall: Callable[[], float]
    ) -> None:
        self._clock = clock
        self._guests = guests
        self._resources = resources
        self._wall = wall
        self._book = Book(clock)

    async def give(self, asker: Asker, name: str, ask: Ask, moment: int | None) -> Goal:
        """Have a goal pursued; it is under way then.

        :param moment: the relay's monotonic nanoseconds before which it can't have been asked for
        :raises MomentNeeded: it moves the robot, and no moment is named
        :raises TooOld: it moves the robot, and may be too old
        :raises NotDone: it can't begin, with the reason
        :raises SwitchboardError: it is refused
        """
        action = resolve(name)
        type_name = normal_type(ask.type, "action")
        guest, leave = await self._guests.keep(*asker)
        with ExitStack() as undone:
            undone.callback(leave)
            goal, begins = self._begin(asker, guest, leave, action, type_name, ask, moment)
            undone.pop_all()
        with goal.looked_at():
            await begins
        if goal.state is State.REFUSED:
            self._book.remove(goal)
            raise NotDone(goal.reason or "the goal could not begin")
        return goal

    def _begin(
        self,
        asker: Asker,
        guest: Guest,
        leave: Callable[[], None],
        action: str,
        type_name: str,
        ask: Ask,
        moment: int | None,
    ) -> tuple[Goal, Deferred[None]]:
        session, owner = guest.session, Owner.of(asker.principal)
        session.judge(Operation.CALL, action)
        see_online(session)
        known = view(session).actions.get(action)
        if not type_name and known is None:
            raise NotFound(f"there is no action {action} on robot {session.robot.name}")
        moves = session.robot.description.motion.moves_by_action(action)
        since = self._resources.dated(guest, moment) if moves else None
        self._book.check_room(owner.user)
        goal = Goal(
            self._clock,
            self._wall,
            guest,
            leave,
            # In the order in which they are given, and nobody guesses one.
            id=f"{round(self._wall() * 1000):012x}{secrets.token_hex(16)}",
            owner=owner,
            action=action,
            type=known.types[0] if known is not None and known.types else type_name,
            moves=moves,
            unwatched=ask.unwatched,
            on_end=self._book.ended,
        )
        self._book.add(goal)
        try:
            return goal, goal.begin(ask.goal, since)
        except SwitchboardError:
            self._book.remove(goal)
            raise

    async def members(self, asker: Asker, listing: Listing) -> dict[str, Any]:
        """A page of the asker's own, in the order in which they were given, without feedback and results.

        :param listing: names and types are those of actions
        :raises NotFound: no such robot, or no right on it
        """
        mine = self._book.of(Owner.of(asker.principal), asker.robot)
        if not mine:
            async with self._guests.permit(*asker):
                pass
        meant = {id: goal for id, goal in mine.items() if fnmatchcase(goal.action, listing.name)}
        page, after = listing._replace(name="*").page(meant, lambda goal: [goal.type])
        return {"goals": [goal.summary() for _, goal in page], "next": after}

    def find(self, asker: Asker, id: str) -> Goal:
        """One of the asker's own.

        :raises NotFound: there is none
        """
        goal = self._book.of(Owner.of(asker.principal), asker.robot).get(id)
        if goal is None:
            raise NotFound("there is no such goal of yours, or none any more")
        return goal

    async def told(self, asker: Asker, goal: Goal) -> Told:
        """Its status; without feedback and result where the asker may not use the action any more."""
        # While it is under way it ends with the right.
        whole = not goal.over or await self._may(asker, goal)
        return Told(goal.json(whole), goal.over)

    async def state(self, asker: Asker, id: str, wait: float, unlike: frozenset[str]) -> Told:
        """Its status, which counts as a look at it.

        :param wait: seconds for which another may be waited for than those that are known
        :param unlike: entity tags of these
        :raises NotFound: there is no such goal
        """
        goal = self.find(asker, id)
        until = self._clock.seconds() + wait
        with goal.looked_at():
            while True:
                version = goal.version
                told = await self.told(asker, goal)
                if told.etag not in unlike:
                    return told
                left = until - self._clock.seconds()
                if left <= 0 or told.over:
                    return told._replace(known=True)
                await goal.changed(version, left)

    async def awaited(self, asker: Asker, id: str, wait: float) -> Told | None:
        """Its status when it is over, or after so many seconds; ``None`` when it can't be read any more."""
        try:
            goal = self.find(asker, id)
        except NotFound:
            return None
        with goal.looked_at():
            await goal.end_within(wait)
        return await self.told(asker, goal)

    def cancel(self, asker: Asker, id: str) -> Goal | None:
        """Have one end; ``None`` when it is over already.

        :raises NotFound: there is no such goal
        """
        goal = self.find(asker, id)
        if goal.over:
            return None
        with goal.looked_at():
            goal.cancel("it was cancelled by who gave it")
        return goal

    async def _may(self, asker: Asker, goal: Goal) -> bool:
        try:
            await self._resources.may(asker, Operation.CALL, goal.action)
        except (NotFound, Refused):
            return False
        return True
