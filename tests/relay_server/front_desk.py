"""A front desk on a real database, put together as a relay does it."""

from __future__ import annotations

from typing import Any

from twisted.internet import reactor

from relay_db import queries
from relay_db.queries import UserRecord
from relay_server.access import Access, Principal
from relay_server.auth import passwords
from relay_server.auth.authenticator import Authenticator
from relay_server.auth.origins import Origins
from relay_server.common.database import AsyncDatabase
from relay_server.events.bus import EventBus
from relay_server.sessions.manager import SessionManager
from relay_server.sessions.ports import Timing
from relay_server.sessions.session import Session
from tests.relay_server.memory import MemoryClient, World

PASSWORD = "correct horse"
HERE = "192.0.2.1"


class Desk:
    """A front desk, and what it is made of: ann operates rover, and knows nothing of hidden."""

    def __init__(self, store: AsyncDatabase) -> None:
        self.store = store
        self.world = World()
        self.access = Access(store, self.wall, self.world.clock.seconds)
        # To mypy the reactor is a module.
        self.auth = Authenticator(reactor, store, self.world.clock.seconds, self.wall)  # type: ignore[arg-type]
        self.auth.start()
        self.desk = SessionManager(
            self.world.clock,
            store,
            self.auth,
            self.access,
            self.world.registry,
            self.world.channels,
            self.world.videos,
            self.world.desks,
            EventBus(store, self.wall),
            Origins("http"),
            Timing(2.0, 0.1, 5.0),
            cookie="sb",
            clock_ns=self.world.now_ns,
            wall=self.wall,
        )
        with store.database.begin() as session:
            ann = queries.add_user(session, "ann", passwords.hash_password(PASSWORD))
            rover = queries.add_robot(session, "rover", "in the shed")
            queries.add_robot(session, "hidden")
            queries.grant_right(session, rover.id, "operator", user_id=ann.id)
        self.ann, self.rover = ann, rover

    def wall(self) -> float:
        """Unix time."""
        return 1000.0 + self.world.clock.seconds()

    async def logged_in(self) -> tuple[Principal, str]:
        """Ann's principal by a fresh session, and its token."""
        _, token = await self.desk.password("ann", PASSWORD, HERE)
        return await self.desk.token(token), token

    async def by_token(self, user: UserRecord, scope: str | None = None) -> Principal:
        """A user's principal by a token that was made for no more than a scope."""
        token = f"token of {user.name} for {scope}"
        await self.store.write(
            queries.create_token,
            user.id,
            passwords.token_hash(token),
            kind="access",
            expires=None,
            now=1000.0,
            scope=scope,
        )
        return await self.desk.token(token)

    async def opens(self, principal: Principal) -> tuple[Session, MemoryClient]:
        """A websocket of this principal."""
        client = MemoryClient()
        admission = await self.desk.admit(principal, "rover", HERE)
        session = self.desk.open(admission, client, self.world.now_ns())
        session.start()
        return session, client

    async def events(self, kind: str) -> list[Any]:
        """What was recorded of a kind, once what is being written is written."""
        await self.store.write(queries.revision)
        return [each for each in await self.store.read(queries.list_events) if each.kind == kind]
