"""Decides all rights: whether a principal may carry out an operation on a robot's resource, now.

A topic that carries images needs the right to view them too, whichever way it is read.
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import TypeVar

from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.queries import PrincipalRecord, RobotRecord, UserRecord
from relay_protocol.errors import Refused
from relay_protocol.realms import full_name
from relay_protocol.rights import Decision, Grant, Operation, Rules
from relay_protocol.scopes import Scope
from relay_server.common.concurrency import SingleFlight
from relay_server.common.database import AsyncDatabase
from relay_server.robots.message_types import IMAGE_TYPES
from relay_server.robots.registry import RobotState

K = TypeVar("K")
V = TypeVar("V")

PROVED = 1024
"""Credentials that are remembered; those unused longest are forgotten first."""

RECENT_READ_SECONDS = 1.0
"""Seconds after a read of the database's changes in which a remembered credential is as certain as one read now."""

ADMITTED = 4096
"""Pairs of user and robot that are remembered, in the same way."""

_NO_ROBOT_ID = -1
"""A robot number that no robot has."""

NO_TOKEN = 0
"""Stands for the token of a principal that acts by the rights of its user alone, as the owner of a pipe."""

LISTED = 1024
"""Users, with the scopes of their tokens, whose robots are remembered."""

LOOKUP_SECONDS = 3.0
"""Seconds that the database may take to confirm a client's rights: at a login by websocket, and before a stop."""

NOT_LOOKED_UP = (
    f"the database has not answered within {LOOKUP_SECONDS:g} s, and without it the relay can't check your rights. "
    "Stop robots by their own switch, or by 'switchboard stop' on the relay's machine"
)

NO_ROBOT = "there is no such robot, or you have no right on it"
"""One answer for both cases, so that it does not disclose which robots exist."""

Changed = Callable[[], None]
Revoked = Callable[[Refused], None]


class BadCredentials(Refused):
    """The credentials are not valid."""

    code = "bad_credentials"


@dataclass(frozen=True)
class Principal:
    """An authenticated caller.

    :param admin: whether it may administer now: its user may, and the token's scope covers it
    :param token_id: the token that authenticated it; when it ends, everything opened with it ends too;
        :data:`NO_TOKEN`: none
    :param expires: Unix seconds at which the token expires, or ``None``
    :param scope: limits the rights of the token; ``None`` for all rights of its user
    :param robot_id: the only robot that the token is for; ``None`` for all
    """

    user_id: int
    name: str
    realm: str
    admin: bool
    token_id: int
    expires: float | None
    scope: Scope | None = None
    robot_id: int | None = None

    @classmethod
    def of(cls, record: PrincipalRecord) -> Principal:
        scope = None if record.scope is None else Scope(record.scope)
        admin = record.admin and (scope is None or scope.admin)
        return cls(
            record.user_id,
            record.name,
            record.realm,
            admin,
            record.token_id,
            record.expires,
            scope,
            record.robot_id,
        )

    @classmethod
    def of_user(cls, user: UserRecord) -> Principal:
        """A user for whom the relay acts, now and after any token of the user has ended."""
        return cls(user.id, user.name, user.realm, False, NO_TOKEN, None)

    @property
    def full(self) -> str:
        """The name in the whole relay: ``toad@lab1``."""
        return full_name(self.name, self.realm)

    def require_full_scope(self) -> None:
        """Reject a token with a scope, for requests that concern more than one robot.

        :raises Refused: the token has a scope
        """
        if self.scope is not None:
            raise Refused("this needs an access token without a scope")

    def rules(self, robot: RobotRecord, grants: Iterable[Grant]) -> Rules:
        """The rules on a robot, given the grants of its user."""
        if self.robot_id not in (None, robot.id):
            return Rules()
        return Rules(grants, None if self.scope is None else self.scope.on(robot.name))


class Permit:
    """The rights of one principal on one robot, now. Hold it as long as a connection is open, then release it."""

    def __init__(self, principal: Principal, robot_id: int, rules: Rules) -> None:
        self.principal = principal
        self.robot_id = robot_id
        self.rules = rules
        self.on_change: Changed = _ignore
        self.on_revoke: Revoked = _ignore_error
        """Called with the reason; :class:`BadCredentials` if logging in again would help."""

    def decide(self, operation: Operation, resource: str) -> Decision:
        """The decision with its reason, by the current rights."""
        return self.rules.decide(operation, resource)


def _ignore() -> None: ...


def _ignore_error(error: Refused) -> None: ...


class Access:
    """Compiles rights from the database, and keeps every open permit up to date.

    :param wall: Unix time in seconds
    :param seconds: a monotonic clock
    """

    def __init__(
        self, store: AsyncDatabase, wall: Callable[[], float], seconds: Callable[[], float] = time.monotonic
    ) -> None:
        self._store = store
        self._wall = wall
        self._seconds = seconds
        self._known_until = -math.inf
        """All changes before this time, by the monotonic clock, are known."""
        self._permits: set[Permit] = set()
        self._robots: OrderedDict[_RightsKey, list[tuple[RobotRecord, Rules]]] = OrderedDict()
        """Those unchanged longest are forgotten first."""
        self._refreshed = 0
        self._refreshing = SingleFlight(self._refresh)
        self._proved: OrderedDict[str, Principal] = OrderedDict()
        """By the hash of a token, the principal it proved. Kept up to date like permits."""
        self._admitted: OrderedDict[tuple[_RightsKey, int], None] = OrderedDict()
        """Principals, and robots on which they were recently found to have a right."""

    @property
    def refreshed(self) -> int:
        """How often changes of the database were read. Anything read before the latest time may be outdated."""
        return self._refreshed

    def remember(self, token_hash: str, principal: Principal, refreshed: int) -> None:
        """A token has proved a principal.

        :param refreshed: its value when the database was asked
        """
        if refreshed == self._refreshed:
            keep_newest(self._proved, token_hash, principal, PROVED)

    def remembered_principal(self, token_hash: str) -> Principal | None:
        """The principal of a token, as far as it is known without asking the database."""
        principal = self._proved.get(token_hash)
        if principal is None or (principal.expires is not None and principal.expires <= self._wall()):
            return None
        self._proved.move_to_end(token_hash)
        return principal

    def set_known_until(self, seconds: float) -> None:
        """Note that all changes of the database before a time are known.

        :param seconds: by the monotonic clock
        """
        self._known_until = max(self._known_until, seconds)

    @property
    def lag(self) -> float:
        """Seconds since changes of the database were read; infinite before the first time."""
        return self._seconds() - self._known_until

    def recent_principal(self, token_hash: str) -> Principal | None:
        """The principal of a token, if that is as certain as by asking the database."""
        if self.lag > RECENT_READ_SECONDS:
            return None
        return self.remembered_principal(token_hash)

    def knows(self, principal: Principal, robot_id: int) -> bool:
        """Whether the principal is known to have a right on a robot, without asking the database."""
        key = _key_of(principal)
        return (
            (key, robot_id) in self._admitted
            or any(record.id == robot_id for record, _ in self._robots.get(key, ()))
            or any(each.robot_id == robot_id and _key_of(each.principal) == key for each in self._permits)
        )

    def may_stop_at_once(self, principal: Principal, robot: RobotState) -> bool:
        """Whether the principal may stop a robot without waiting for the database: memory shows a right on it."""
        return principal.realm in robot.realms and self.knows(principal, robot.robot_id)

    async def permit(self, principal: Principal, robot: RobotRecord) -> Permit | None:
        """A live permit; ``None`` if the principal has no right on the robot, or its token is not for it.

        :raises BadCredentials: the token has ended or the account was disabled since it was proved
        """
        found = await self._permitted(principal, lambda session: robot)
        return None if found is None else found[1]

    async def permit_by_name(self, principal: Principal, robot: str) -> tuple[RobotRecord, Permit] | None:
        """The same for a robot's name in the principal's realm.

        The same queries are made whether the robot exists or not, so their time does not disclose it.

        :raises BadCredentials: as for :meth:`permit`
        """
        return await self._permitted(
            principal, lambda session: queries.find_robot(session, robot, principal.realm)
        )

    async def _permitted(
        self, principal: Principal, find: Callable[[Session], RobotRecord | None]
    ) -> tuple[RobotRecord, Permit] | None:
        # Rows that were read during a refresh may be older than the change that caused it.
        seen = -1
        while seen != self._refreshed:
            seen = self._refreshed
            robot, now = await self._store.read(_find_with_rights, principal, find, self._wall())
        if isinstance(now.ended, BadCredentials):
            raise now.ended
        if robot is None:
            return None
        rules = principal.rules(robot, now.grants)
        if now.ended is not None or not rules:
            return None
        permit = Permit(principal, robot.id, rules)
        self._permits.add(permit)
        keep_newest(self._admitted, (_key_of(principal), robot.id), None, ADMITTED)
        return robot, permit

    async def robots(self, principal: Principal) -> list[tuple[RobotRecord, Rules]]:
        """The robots that a principal has any right on, remembered until the database changes."""
        key = _key_of(principal)
        found = self._robots.get(key)
        if found is None:
            seen = self._refreshed
            rows = await self._store.read(queries.robots_with_grants, principal.user_id)
            with_rules = ((record, principal.rules(record, grants)) for record, grants in rows)
            found = [(record, rules) for record, rules in with_rules if rules]
            if seen == self._refreshed:
                keep_newest(self._robots, key, found, LISTED)
        return found

    def release(self, permit: Permit) -> None:
        """Nothing is open under this permit any more."""
        self._permits.discard(permit)

    def expire(self) -> None:
        """Revoke the permits whose tokens have expired. The database is not asked."""
        now = self._wall()
        for permit in list(self._permits):
            if permit.principal.expires is not None and permit.principal.expires <= now:
                self._revoke(
                    permit, _reason(permit, BadCredentials("your session has expired; log in again"))
                )

    async def refresh(self) -> None:
        """Decide on all open permits again, after a change in the database.

        Only one refresh runs at a time, so an older result never follows a newer one.

        :raises Unavailable: the database cannot be asked; open permits keep the rights last seen
        """
        await self._refreshing.run()

    async def _refresh(self) -> None:
        self._refreshed += 1
        self._robots.clear()
        self._admitted.clear()
        await self._refresh_proved()
        asked = list(self._permits)
        if not asked:
            return
        keys = {(permit.principal.user_id, permit.principal.token_id, permit.robot_id) for permit in asked}
        rights = await self._store.read(_current_rights, keys, self._wall())
        for permit in asked:
            if permit not in self._permits:
                continue
            principal = permit.principal
            now = rights[(principal.user_id, principal.token_id, permit.robot_id)]
            if now.ended is not None:
                self._revoke(permit, _reason(permit, now.ended))
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
                # The right to administer may have changed.
                self._proved[token_hash] = live[principal.token_id]
            elif principal.token_id in asked:
                del self._proved[token_hash]

    def _revoke(self, permit: Permit, error: Refused) -> None:
        self._permits.discard(permit)
        permit.rules = Rules()
        permit.on_revoke(error)


_RightsKey = tuple[int, str | None, int | None]
"""User, scope of the token, and the only robot that the token is for."""


def _key_of(principal: Principal) -> _RightsKey:
    """A key that is equal for principals with the same rights."""
    scope = None if principal.scope is None else str(principal.scope)
    return principal.user_id, scope, principal.robot_id


def _reason(permit: Permit, error: Refused) -> Refused:
    """Why a permit ends, in words for the client: one that came by a URL can't log in again."""
    if permit.principal.robot_id is None or not isinstance(error, BadCredentials):
        return error
    return BadCredentials("this Foxglove URL was revoked or has expired, or its user was disabled")


def keep_newest(kept: OrderedDict[K, V], key: K, value: V, most: int) -> None:
    """Keep a value as the newest; beyond ``most`` the oldest is forgotten."""
    kept[key] = value
    kept.move_to_end(key)
    if len(kept) > most:
        kept.popitem(last=False)


@dataclass(frozen=True)
class _CurrentRights:
    ended: Refused | None
    grants: tuple[Grant, ...] = ()


def _current_rights(
    session: Session, keys: set[tuple[int, int, int]], now: float
) -> dict[tuple[int, int, int], _CurrentRights]:
    found = {}
    for key in keys:
        user_id, token_id, robot_id = key
        if token_id != NO_TOKEN and not queries.token_is_live(session, token_id, now):
            found[key] = _CurrentRights(BadCredentials("your session was ended; log in again"))
        elif not queries.user_is_live(session, user_id):
            found[key] = _CurrentRights(BadCredentials("your account was disabled"))
        else:
            grants = tuple(queries.grants_for(session, user_id, robot_id))
            found[key] = _CurrentRights(
                None if grants else Refused("your right on this robot was revoked"), grants
            )
    return found


def _find_with_rights(
    session: Session, principal: Principal, find: Callable[[Session], RobotRecord | None], now: float
) -> tuple[RobotRecord | None, _CurrentRights]:
    """A robot and the principal's rights on it. A robot that does not exist takes the same queries."""
    robot = find(session)
    key = principal.user_id, principal.token_id, _NO_ROBOT_ID if robot is None else robot.id
    return robot, _current_rights(session, {key}, now)[key]


Decide = Callable[[Operation, str], Decision]
"""Decides on an operation on a resource of a robot: ``decide`` of a permit or of rules."""


def is_image_topic(robot: RobotState, topic: str, types_of_subscribers: Collection[str] = ()) -> bool:
    """Whether a topic of a robot carries camera images, as far as is known. A topic without a type may.

    :param types_of_subscribers: its types according to its subscribers, if the robot's graph lacks them
    """
    known = robot.graph.topics.get(topic)
    types = (known.types if known is not None else ()) or types_of_subscribers
    return not types or not IMAGE_TYPES.isdisjoint(types) or any(each.name == topic for each in robot.cameras)


def may_subscribe(
    decide: Decide, robot: RobotState, topic: str, types_of_subscribers: Collection[str] = ()
) -> Decision:
    """Decide on a subscription to a topic of a robot.

    :param types_of_subscribers: as for :func:`is_image_topic`
    """
    decision = decide(Operation.SUBSCRIBE, topic)
    if decision.allowed and is_image_topic(robot, topic, types_of_subscribers):
        return decide(Operation.VIEW, topic)
    return decision
