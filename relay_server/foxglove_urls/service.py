"""The rules of Foxglove URLs: making, listing and revoking them."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable
from urllib.parse import quote, urlencode

from sqlalchemy.orm import Session
from twisted.internet.defer import Deferred

from relay_db import queries
from relay_db.queries import QuotaExceeded, RobotRecord, TokenRecord
from relay_protocol.errors import NotFound, Refused, Unavailable
from relay_protocol.rights import Level, Operation, Rules, includes
from relay_server.access import NO_ROBOT, Access, Principal
from relay_server.common.clock import Clock
from relay_server.common.concurrency import shield
from relay_server.common.database import AsyncDatabase
from relay_server.common.token_bucket import Buckets
from relay_server.foxglove_urls.schemas import (
    URL_LEVELS,
    FoxgloveUrl,
    FoxgloveUrls,
    MadeFoxgloveUrl,
    NewFoxgloveUrl,
    UrlLevel,
)
from relay_server.realms.changes import AuditedChange

MOST = 100
"""Most URLs of one user that have not expired."""

CHANGES_PER_SECOND = 1.0
CHANGES_BURST = 20.0
MAX_USERS = 1000
"""Changes by one user, each of which is written into the audit log, and users that are counted."""

BEYOND_VIEWING = (Operation.PUBLISH, Operation.CALL)
"""Operations of Foxglove clients for which a viewer's URL does not do."""


class FoxgloveUrlService:
    """
    :param apply: applies changes of the database in the relay, so that revoked connections are closed
    :param tokens_of: the tokens by which sessions of a robot are open now, each as often as it is used
    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        clock: Clock,
        access: Access,
        database: AsyncDatabase,
        apply: Callable[[], Awaitable[None]],
        tokens_of: Callable[[int], Iterable[int]],
        wall: Callable[[], float],
    ) -> None:
        self._access = access
        self._database = database
        self._apply = apply
        self._tokens_of = tokens_of
        self._wall = wall
        self._changes = Buckets(CHANGES_PER_SECOND, CHANGES_BURST, MAX_USERS, clock.seconds)

    async def urls(self, principal: Principal, robot: str) -> FoxgloveUrls:
        """The URLs of a robot that the caller has made, and the levels that another may have.

        :raises NotFound: no such robot, or no right on it
        :raises Refused: the token has a scope
        """
        record, rules = await self._robot(principal, robot)
        found = await self._database.read(_urls, principal.user_id, record.id, self._wall())
        urls = [self._shown(id, robot, each) for id, each in found]
        return FoxgloveUrls(urls, [each for each in URL_LEVELS if _may_have(rules, each)])

    async def add(
        self, principal: Principal, address: str, robot: str, new: NewFoxgloveUrl, base: str
    ) -> MadeFoxgloveUrl:
        """Make a URL.

        :param address: of the client, for the audit log
        :param base: ``scheme://host[:port]`` of the relay, as the caller addresses it
        :raises NotFound: no such robot, or no right on it
        :raises Refused: the caller has not that level, or the token has a scope
        :raises QuotaExceeded: the caller has too many
        """
        record, rules = await self._robot(principal, robot)
        require_level(rules, new.level, "you are")
        self._count(principal)
        id, token, made = await self._database.write(self._create, principal, address, record, new)
        url = websocket_url(base, robot, token)
        shown = self._shown(id, robot, made)
        return MadeFoxgloveUrl(
            id=shown.id,
            robot=shown.robot,
            level=shown.level,
            label=shown.label,
            created=shown.created,
            expires=shown.expires,
            connections=0,
            url=url,
            foxglove=f"https://app.foxglove.dev/~/view?{_data_source(url)}",
            foxglove_desktop=f"foxglove://open?{_data_source(url)}",
            lichtblick=f"lichtblick://open?{_data_source(url)}",
        )

    async def revoke(self, principal: Principal, address: str, robot: str, id: str) -> None:
        """Revoke a URL of the caller, and cut what is connected by it.

        :raises NotFound: no such robot, or the caller has no such URL of it
        :raises Refused: the token has a scope
        """
        record, _ = await self._robot(principal, robot)
        self._count(principal)
        # It goes on if the caller leaves: the URL may be in wrong hands.
        work = self._revoke_and_apply(principal, address, record, id)
        await shield(Deferred.fromCoroutine(work))

    async def _revoke_and_apply(
        self, principal: Principal, address: str, robot: RobotRecord, id: str
    ) -> None:
        await self._database.write(self._remove, principal, address, robot, id)
        await self._apply()

    async def _robot(self, principal: Principal, name: str) -> tuple[RobotRecord, Rules]:
        """A robot, and the caller's rules on it."""
        principal.require_full_scope()
        for record, rules in await self._access.robots(principal):
            if record.name == name and rules.level is not None:
                return record, rules
        raise NotFound(NO_ROBOT)

    def _count(self, principal: Principal) -> None:
        if not self._changes.take(principal.user_id):
            raise Unavailable("you make and revoke Foxglove URLs too often; try again in a moment")

    def _create(
        self, s: Session, principal: Principal, address: str, robot: RobotRecord, new: NewFoxgloveUrl
    ) -> tuple[str, str, TokenRecord]:
        change = AuditedChange(s, f"user:{principal.full}", address, self._wall)
        user = queries.get_user(s, principal.user_id)
        if user is None:
            raise NotFound("there is no such user")
        if len(queries.foxglove_tokens(s, self._wall(), user_id=user.id)) >= MOST:
            raise QuotaExceeded(f"you have {MOST} Foxglove URLs, the most that one user may have; revoke one")
        number, token = change.create_foxglove_url(user, robot, new.level, new.expires_in, new.label)
        by_name = queries.tokens_by_name(s, user.id)
        id, made = next((id, each) for id, each in by_name.items() if each.id == number)
        return id, token, made

    def _remove(self, s: Session, principal: Principal, address: str, robot: RobotRecord, id: str) -> None:
        change = AuditedChange(s, f"user:{principal.full}", address, self._wall)
        found = queries.tokens_by_name(s, principal.user_id).get(id)
        if found is None or found.robot_id != robot.id or not change.revoke_foxglove_url(found.id):
            raise NotFound("you have no such Foxglove URL of this robot")

    def _shown(self, id: str, robot: str, record: TokenRecord) -> FoxgloveUrl:
        return FoxgloveUrl(
            id=id,
            robot=robot,
            level="operator" if record.scope == "operator" else "viewer",
            label=record.label,
            created=record.created,
            expires=record.expires or 0.0,
            connections=sum(each == record.id for each in self._tokens_of(record.robot_id or 0)),
        )


def require_level(rules: Rules, level: UrlLevel, subject: str) -> None:
    """
    :param rules: of the URL's user on the robot
    :param subject: of the reason, as ``you are``
    :raises Refused: a URL of the user can't have that level
    """
    if rules.level is None:
        raise Refused(f"a URL needs a right on the robot; {subject} without one")
    if not _may_have(rules, level):
        raise Refused(
            f"a URL with the level {level} needs that level; {subject} {rules.level.value} on this robot"
        )


def _may_have(rules: Rules, level: UrlLevel) -> bool:
    """Whether a URL may have a level: its user has it, or a pattern that allows what a viewer may not."""
    if rules.level is None:
        return False
    return includes(rules.level, Level(level)) or any(map(rules.may_allow, BEYOND_VIEWING))


def websocket_url(base: str, robot: str, token: str) -> str:
    """The URL of a robot's websocket with a token.

    :param base: ``scheme://host[:port]`` of the relay; ``http`` becomes ``ws``
    """
    scheme = base.replace("http", "ws", 1) if base.startswith("http") else base
    return f"{scheme.rstrip('/')}/robots/{quote(robot)}?{urlencode({'token': token})}"


def _data_source(url: str) -> str:
    return urlencode({"ds": "foxglove-websocket", "ds.url": url})


def _urls(s: Session, user_id: int, robot_id: int, now: float) -> list[tuple[str, TokenRecord]]:
    """A user's URLs of a robot that have not expired, each with its name."""
    live = {each.id for each in queries.foxglove_tokens(s, now, user_id=user_id)}
    by_name = queries.tokens_by_name(s, user_id)
    return [(id, each) for id, each in by_name.items() if each.id in live and each.robot_id == robot_id]
