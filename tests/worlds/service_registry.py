"""A service registry with a real database, a clock of the test, and users."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import msgspec

from relay_db import queries
from relay_db.queries import NewStoredEvent
from relay_protocol.scopes import Scope
from relay_server.access import Access, Principal
from relay_server.common.database import AsyncDatabase
from relay_server.http.router import decode_query
from relay_server.service_registry.entries import EntryParameters, EntryQuery, Registration, cursor_text
from relay_server.service_registry.service import EntryReply, ServiceRegistry
from tests.worlds.relay import Time, World

HERE = "192.0.2.7"


class Room:
    """Ann operates rover, bob views it and owns hidden, root administers; cleo is in another realm, with its
    own rover.

    :ivar world: the relay's view of rover
    :ivar noted: events sent to the event log
    """

    def __init__(self, store: AsyncDatabase, time: Time) -> None:
        self.store, self.time = store, time
        self.world = World()
        self.access = Access(store, time)
        self.noted: list[NewStoredEvent] = []
        self.people: dict[str, Principal] = {}
        self.robots: dict[tuple[str, str], int] = {}
        with store.database.begin() as s:
            queries.add_realm(s, "lab")
            for name, realm in (("ann", "default"), ("bob", "default"), ("root", "default"), ("cleo", "lab")):
                user = queries.add_user(s, name, None, admin=name == "root", realm=realm)
                self.people[name] = Principal(user.id, name, realm, name == "root", user.id, None)
            for robot, realm in (("rover", "default"), ("hidden", "default"), ("rover", "lab")):
                self.robots[robot, realm] = queries.add_robot(s, robot, realm=realm).id
            for who, robot, realm, level in (
                ("ann", "rover", "default", "operator"),
                ("bob", "rover", "default", "viewer"),
                ("bob", "hidden", "default", "owner"),
                ("cleo", "rover", "lab", "owner"),
            ):
                queries.grant_right(s, self.robots[robot, realm], level, user_id=self.people[who].user_id)
        assert self.robots["rover", "default"] == self.world.robot.robot_id
        self.registry = self.again()
        self.service = self.registry.service

    def again(self) -> ServiceRegistry:
        """The service registry of a relay that starts now."""
        world = self.world
        core: Any = SimpleNamespace(
            reactor=world.clock,
            database=self.store,
            access=self.access,
            robots=world.registry,
            channels=world.channels,
        )
        return ServiceRegistry(core, self.noted.append, self.time)

    def by_token(self, who: str, scope: str) -> Principal:
        """A user with a token for fewer rights."""
        found = Scope(scope)
        user = self.people[who]
        return Principal(user.user_id, who, user.realm, user.admin and found.admin, 100, None, found)

    def who(self, who: str | Principal) -> Principal:
        """A user."""
        return self.people[who] if isinstance(who, str) else who

    async def register(self, who: str | Principal = "ann", **fields: Any) -> dict[str, Any]:
        """A user registers an entry; returns its reply, with its entity tag and whether it is new."""
        return read(await self.service.register(self.who(who), registration(**fields)))

    async def put(
        self, who: str | Principal, id: str, match: str | None = None, **fields: Any
    ) -> dict[str, Any]:
        """A user renews or changes an entry."""
        new = registration(**fields) if fields else None
        return read(await self.service.put(self.who(who), id, new, match, HERE))

    async def remove(self, who: str | Principal, id: str, match: str | None = None) -> None:
        """A user removes an entry."""
        await self.service.remove(self.who(who), id, match, HERE)

    async def all(self, who: str | Principal = "ann", **query: str) -> list[dict[str, Any]]:
        """Entries that a user finds, from all pages."""
        found: list[dict[str, Any]] = []
        ask: EntryQuery | None = asked(query)
        while ask is not None:
            page, behind = await self.service.page(self.who(who), ask)
            assert len(page) <= ask.limit
            found += msgspec.json.decode(msgspec.json.encode(page))
            ask = None if behind is None else asked({**query, "after": cursor_text(behind)})
        return found

    async def names(self, who: str | Principal = "ann", **query: str) -> list[str]:
        """Names of registered entries that a user finds."""
        return [each["name"] for each in await self.all(who, **query) if each["user"] is not None]

    def memory(self) -> list[tuple[str, str, str, str | None, str]]:
        """Events since the last call: kind, source, realm, user and name."""
        noted, self.noted[:] = list(self.noted), []
        return [
            (each.kind, each.source, each.realm, each.user, msgspec.json.decode(each.data)["name"])
            for each in noted
        ]


def registration(**fields: Any) -> Registration:
    """A registration as a user sends it."""
    body = {"kind": "service", "name": "map", "address": "http://a/", **fields}
    return msgspec.json.decode(msgspec.json.encode(body), type=Registration)


def read(kept: EntryReply) -> dict[str, Any]:
    """The reply as a client reads it."""
    reported: dict[str, Any] = msgspec.json.decode(kept.body)
    assert reported["id"] == kept.id
    return {**reported, "etag": kept.etag, "fresh": kept.created}


def asked(query: dict[str, str]) -> EntryQuery:
    """The query in the parameters of a request."""
    found: EntryParameters = decode_query(query, EntryParameters)
    return found.wanted()
