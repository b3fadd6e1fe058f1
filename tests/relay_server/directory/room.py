"""A directory on a real database, with a clock the test moves, and people who use it."""

from __future__ import annotations

from typing import Any

import msgspec

from relay_db import queries
from relay_db.queries import NewStoredEvent
from relay_protocol.scopes import Scope
from relay_server.access import Access, Principal
from relay_server.common.database import AsyncDatabase
from relay_server.registry.build import RegistryParts
from relay_server.registry.entries import EntryQuery, Registration, ask_of, place_text
from relay_server.registry.service import Kept
from tests.relay_server.memory import Time, World

HERE = "192.0.2.7"


class Room:
    """Ann operates rover, bob views it and owns hidden, root administers; cleo is elsewhere, with a rover of her own.

    :ivar world: rover as the relay knows it
    :ivar noted: what the memory was told
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
        self.house = self.again()
        self.desk = self.house.desk

    def again(self) -> RegistryParts:
        """The directory of a relay that begins now."""
        world = self.world
        known = self.store, self.access, world.registry, world.channels
        return RegistryParts(world.clock, *known, self.noted.append, self.time)

    def by_token(self, who: str, scope: str) -> Principal:
        """Somebody with a token for less."""
        found = Scope(scope)
        user = self.people[who]
        return Principal(user.user_id, who, user.realm, user.admin and found.admin, 100, None, found)

    def who(self, who: str | Principal) -> Principal:
        """Somebody."""
        return self.people[who] if isinstance(who, str) else who

    async def register(self, who: str | Principal = "ann", **fields: Any) -> dict[str, Any]:
        """Somebody registers something; as it is told, with its entity tag and whether it is new."""
        return read(await self.desk.register(self.who(who), registration(**fields)))

    async def put(
        self, who: str | Principal, id: str, match: str | None = None, **fields: Any
    ) -> dict[str, Any]:
        """Somebody renews something, or changes it."""
        new = registration(**fields) if fields else None
        return read(await self.desk.put(self.who(who), id, new, match, HERE))

    async def remove(self, who: str | Principal, id: str, match: str | None = None) -> None:
        """Somebody removes something."""
        await self.desk.remove(self.who(who), id, match, HERE)

    async def all(self, who: str | Principal = "ann", **query: str) -> list[dict[str, Any]]:
        """What somebody finds, page by page."""
        found: list[dict[str, Any]] = []
        ask: EntryQuery | None = ask_of(query)
        while ask is not None:
            page, behind = await self.desk.page(self.who(who), ask)
            assert len(page) <= ask.limit
            found += msgspec.json.decode(msgspec.json.encode(page))
            ask = None if behind is None else ask_of({**query, "after": place_text(behind)})
        return found

    async def names(self, who: str | Principal = "ann", **query: str) -> list[str]:
        """Names of what is registered and somebody finds."""
        return [each["name"] for each in await self.all(who, **query) if each["user"] is not None]

    def memory(self) -> list[tuple[str, str, str, str | None, str]]:
        """What the memory was told: what, from whom, in which realm, by whom, of which name; it is forgotten."""
        noted, self.noted[:] = list(self.noted), []
        return [
            (each.kind, each.source, each.realm, each.user, msgspec.json.decode(each.data)["name"])
            for each in noted
        ]


def registration(**fields: Any) -> Registration:
    """What somebody sends."""
    body = {"kind": "service", "name": "map", "address": "http://a/", **fields}
    return msgspec.json.decode(msgspec.json.encode(body), type=Registration)


def read(kept: Kept) -> dict[str, Any]:
    """As a client reads it."""
    told: dict[str, Any] = msgspec.json.decode(kept.body)
    assert told["id"] == kept.id
    return {**told, "etag": kept.etag, "fresh": kept.fresh}
