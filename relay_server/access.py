"""Who may have a robot's pictures, by whichever road: a topic that carries them takes the right to view them too."""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import TypeVar

from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.queries import PrincipalRecord, RobotRecord
from relay_protocol.errors import Refused
from relay_protocol.realms import full_name
from relay_protocol.rights import Grant, Operation, Rules, Verdict
from relay_protocol.scopes import Scope
from relay_server.common.clock import SingleFlight
from relay_server.common.database import AsyncDatabase
from relay_server.robots.registry import RobotState

K = TypeVar("K")
V = TypeVar("V")

PROVED = 1024
"""Credentials that are remembered; the longest unused are forgotten first."""

IN_STEP_SECONDS = 1.0
"""So long after a look at the database what is remembered of a credential counts as the database's own word."""

ADMITTED = 4096
"""Users on robots that are remembered, in the same way."""

_NOBODYS = -1
"""The number of no robot."""

LISTED = 1024
"""Users, with the scopes of their tokens, whose robots are remembered."""

NO_ROBOT = "there is no such robot, or you have no right on it"
"""What who asks for one is told: the same of both."""

Changed = Callable[[], None]
Revoked = Callable[[Refused], None]


class BadCredentials(Refused):
    """The credentials prove nobody."""

    code = "bad_credentials"


@dataclass(frozen=True)
class Principal:
    """Who is asking, once proved.

    :param admin: whether it may administer, now: its user may, and the token's scope covers it
    :param token_id: the token that proved it; when that one ends, so does all that was opened with it
    :param expires: Unix seconds at which the token ends by itself, or ``None``
    :param scope: what the token may be used for; ``None`` for all that its user may
    """

    user_id: int
    name: str
    realm: str
    admin: bool
    token_id: int
    expires: float | None
    scope: Scope | None = None

    @classmethod
    def of(cls, record: PrincipalRecord) -> Principal:
        """From the database's row."""
        scope = None if record.scope is None else Scope(record.scope)
        admin = record.admin and (scope is None or scope.admin)
        token = record.token_id, record.expires, scope
        return cls(record.user_id, record.name, record.realm, admin, *token)

    @property
    def full(self) -> str:
        """Its name for the whole relay: ``toad@lab1``."""
        return full_name(self.name, self.realm)

    def needs_whole(self) -> None:
        """Refuse what reaches further than any one robot.

        :raises Refused: the token is for less than all that its user may
        """
        if self.scope is not None:
            raise Refused("this takes a token without a scope: for all that you may")

    def rules(self, robot: str, grants: Iterable[Grant]) -> Rules:
        """What it may do on a robot of this name, of what its user was granted."""
        return Rules(grants, None if self.scope is None else self.scope.on(robot))


class Permit:
    """What one principal may do on one robot, now. Hold it for as long as something is open, then release it."""

    def __init__(self, principal: Principal, robot_id: int, rules: Rules) -> None:
        self.principal = principal
        self.robot_id = robot_id
        self.rules = rules
        self.on_change: Changed = _ignore
        self.on_revoke: Revoked = _ignore_error
        """Told why it is over: :class:`BadCredentials` where to log in again would help."""

    def judge(self, operation: Operation, resource: str) -> Verdict:
        """Yes or no with the reason, by the rights as they stand."""
        return self.rules.judge(operation, resource)


def _ignore() -> None:
    """Nobody listens yet."""


def _ignore_error(error: Refused) -> None:
    """Nobody listens yet."""


class Access:
    """Compiles rights from the database and keeps every open permit in step with them.

    :param wall: current Unix time in seconds
    :param seconds: a monotonic clock
    """

    def __init__(
        self, store: AsyncDatabase, wall: Callable[[], float], seconds: Callable[[], float] = time.monotonic
    ) -> None:
        self._store = store
        self._wall = wall
        self._seconds = seconds
        self._in_step = -math.inf
        """All changes that were made before this moment have been taken up."""
        self._permits: set[Permit] = set()
        self._robots: OrderedDict[tuple[int, str | None], list[tuple[RobotRecord, Rules]]] = OrderedDict()
        """By user and scope; those of the longest unchanged are forgotten first."""
        self._refreshed = 0
        self._refreshing = SingleFlight(self._refresh)
        self._proved: OrderedDict[str, Principal] = OrderedDict()
        """By the hash of a token, who it proved. Kept in step with the database as permits are."""
        self._admitted: OrderedDict[tuple[int, str | None, int], None] = OrderedDict()
        """Users, with the scopes of their tokens, and robots, of late found to have a right on them."""

    @property
    def refreshed(self) -> int:
        """How often changes in the database have been taken up; what was read before the latest may be outdated."""
        return self._refreshed

    def remember(self, token_hash: str, principal: Principal, refreshed: int) -> None:
        """A token has proved somebody.

        :param refreshed: as it was when that was asked for
        """
        if refreshed == self._refreshed:
            _keep(self._proved, token_hash, principal, PROVED)

    def remembered(self, token_hash: str) -> Principal | None:
        """Who a token proves, as far as that is known without asking the database."""
        principal = self._proved.get(token_hash)
        if principal is None or (principal.expires is not None and principal.expires <= self._wall()):
            return None
        self._proved.move_to_end(token_hash)
        return principal

    def in_step(self, seconds: float) -> None:
        """Everything that was changed in the database before a moment has been taken up.

        :param seconds: the moment, by the monotonic clock
        """
        self._in_step = max(self._in_step, seconds)

    def proves(self, token_hash: str) -> Principal | None:
        """Who a token proves, where that is as certain as by asking the database."""
        if self._seconds() - self._in_step > IN_STEP_SECONDS:
            return None
        return self.remembered(token_hash)

    def knows(self, principal: Principal, robot_id: int) -> bool:
        """Whether the principal is known to have a right on a robot, without asking the database."""
        who = _who(principal)
        return (
            (*who, robot_id) in self._admitted
            or any(record.id == robot_id for record, _ in self._robots.get(who, ()))
            or any(each.robot_id == robot_id and _who(each.principal) == who for each in self._permits)
        )

    async def permit(self, principal: Principal, robot: RobotRecord) -> Permit | None:
        """A live permit, or ``None`` when the principal has no right at all on the robot, or its token is not for it.

        :raises BadCredentials: the token has ended or the account was disabled since it was proved
        """
        found = await self._permitted(principal, lambda session: robot)
        return None if found is None else found[1]

    async def permit_by_name(self, principal: Principal, robot: str) -> tuple[RobotRecord, Permit] | None:
        """The same for a robot of the principal's realm.

        The same questions are put to the database whether or not there is such a robot: the time that they take does
        not tell.

        :raises BadCredentials: as :meth:`permit`
        """
        return await self._permitted(
            principal, lambda session: queries.find_robot(session, robot, principal.realm)
        )

    async def _permitted(
        self, principal: Principal, find: Callable[[Session], RobotRecord | None]
    ) -> tuple[RobotRecord, Permit] | None:
        # What was read while a refresh went by may be what the refresh was about.
        seen = -1
        while seen != self._refreshed:
            seen = self._refreshed
            robot, now = await self._store.read(_standing_on, principal, find, self._wall())
        if isinstance(now.ended, BadCredentials):
            raise now.ended
        if robot is None:
            return None
        rules = principal.rules(robot.name, now.grants)
        if now.ended is not None or not rules:
            return None
        permit = Permit(principal, robot.id, rules)
        self._permits.add(permit)
        _keep(self._admitted, (*_who(principal), robot.id), None, ADMITTED)
        return robot, permit

    async def robots(self, principal: Principal) -> list[tuple[RobotRecord, Rules]]:
        """The robots a principal has any right on, kept until something changes in the database."""
        who = _who(principal)
        found = self._robots.get(who)
        if found is None:
            seen = self._refreshed
            rows = await self._store.read(queries.robots_with_grants, principal.user_id)
            judged = ((record, principal.rules(record.name, grants)) for record, grants in rows)
            found = [(record, rules) for record, rules in judged if rules]
            if seen == self._refreshed:
                _keep(self._robots, who, found, LISTED)
        return found

    def release(self, permit: Permit) -> None:
        """Nothing is open under this permit any more."""
        self._permits.discard(permit)

    def expire(self) -> None:
        """Revoke the permits whose token's time is over. Asks nothing of the database."""
        now = self._wall()
        for permit in list(self._permits):
            if permit.principal.expires is not None and permit.principal.expires <= now:
                self._revoke(permit, BadCredentials("your session has expired; log in again"))

    async def refresh(self) -> None:
        """Judge all open permits anew, after something changed in the database.

        One at a time: what an earlier look has read must not come after what a later one has.

        :raises Unavailable: the database can't be asked; what is open goes on under the rights last seen
        """
        await self._refreshing.ask()

    async def _refresh(self) -> None:
        self._refreshed += 1
        self._robots.clear()
        self._admitted.clear()
        await self._refresh_proved()
        asked = list(self._permits)
        if not asked:
            return
        keys = {(permit.principal.user_id, permit.principal.token_id, permit.robot_id) for permit in asked}
        standing = await self._store.read(_standing, keys, self._wall())
        for permit in asked:
            if permit not in self._permits:
                continue
            principal = permit.principal
            now = standing[(principal.user_id, principal.token_id, permit.robot_id)]
            if now.ended is not None:
                self._revoke(permit, now.ended)
            elif tuple(now.grants) != permit.rules.grants:
                permit.rules = Rules(now.grants, permit.rules.scope)
                permit.on_change()

    async def _refresh_proved(self) -> None:
        asked = {principal.token_id for principal in self._proved.values()}
        if not asked:
            return
        records = await self._store.read(queries.principals_by_ids, asked, self._wall())
        live = {record.token_id: Principal.of(record) for record in records}
        for token_hash, principal in list(self._proved.items()):
            if principal.token_id in live:
                # Perhaps it may administer no more, or again.
                self._proved[token_hash] = live[principal.token_id]
            elif principal.token_id in asked:
                del self._proved[token_hash]

    def _revoke(self, permit: Permit, error: Refused) -> None:
        self._permits.discard(permit)
        permit.rules = Rules()
        permit.on_revoke(error)


def _who(principal: Principal) -> tuple[int, str | None]:
    """Equal for principals with the same rights."""
    return principal.user_id, None if principal.scope is None else str(principal.scope)


def _keep(kept: OrderedDict[K, V], key: K, value: V, most: int) -> None:
    kept[key] = value
    kept.move_to_end(key)
    if len(kept) > most:
        kept.popitem(last=False)


@dataclass(frozen=True)
class _Standing:
    ended: Refused | None
    grants: tuple[Grant, ...] = ()


def _standing(
    session: Session, keys: set[tuple[int, int, int]], now: float
) -> dict[tuple[int, int, int], _Standing]:
    found = {}
    for key in keys:
        user_id, token_id, robot_id = key
        if not queries.token_is_live(session, token_id, now):
            found[key] = _Standing(BadCredentials("your session was ended; log in again"))
        elif not queries.user_is_live(session, user_id):
            found[key] = _Standing(BadCredentials("your account was disabled"))
        else:
            grants = tuple(queries.grants_for(session, user_id, robot_id))
            found[key] = _Standing(
                None if grants else Refused("your right on this robot was revoked"), grants
            )
    return found


def _standing_on(
    session: Session, principal: Principal, find: Callable[[Session], RobotRecord | None], now: float
) -> tuple[RobotRecord | None, _Standing]:
    """A robot, and how the principal stands to it; of none as much is asked."""
    robot = find(session)
    key = principal.user_id, principal.token_id, _NOBODYS if robot is None else robot.id
    return robot, _standing(session, {key}, now)[key]


Judge = Callable[[Operation, str], Verdict]
"""Says whether somebody may do something to a resource of a robot: a permit's or rules' ``judge``."""

PICTURES = frozenset(
    {
        "sensor_msgs/msg/Image",
        "sensor_msgs/msg/CompressedImage",
        "stereo_msgs/msg/DisparityImage",
        "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
        "theora_image_transport/msg/Packet",
        "foxglove_msgs/msg/CompressedImage",
        "foxglove_msgs/msg/CompressedVideo",
        "foxglove_msgs/msg/RawImage",
    }
)
"""Types of topics that carry pictures."""


def is_image_topic(robot: RobotState, topic: str, said: Collection[str] = ()) -> bool:
    """Whether a topic of a robot shows what a camera sees, as far as anybody knows; without a type it may.

    :param said: its types for those who hear it, where the robot's graph does not have it
    """
    known = robot.graph.topics.get(topic)
    types = (known.types if known is not None else ()) or said
    return not types or not PICTURES.isdisjoint(types) or any(each.name == topic for each in robot.cameras)


def may_subscribe(judge: Judge, robot: RobotState, topic: str, said: Collection[str] = ()) -> Verdict:
    """May somebody hear a topic of a robot?

    :param said: as for :func:`is_image_topic`
    """
    verdict = judge(Operation.SUBSCRIBE, topic)
    if verdict.allowed and is_image_topic(robot, topic, said):
        return judge(Operation.VIEW, topic)
    return verdict
