"""A session manager with a real database, built as in a relay."""

from __future__ import annotations

from twisted.internet import reactor

from relay_db import queries
from relay_db.queries import UserRecord
from relay_server.access import Access, Principal
from relay_server.auth import passwords
from relay_server.auth.authenticator import Authenticator
from relay_server.auth.origins import Origins
from relay_server.auth.service import AuthService
from relay_server.auth.url_tokens import UrlTokens
from relay_server.cluster.homes import RobotHomes, SingleHome
from relay_server.common.database import AsyncDatabase
from relay_server.events.bus import BusEvent, EventBus
from relay_server.modules.report_store import ModuleReportStore
from relay_server.modules.service import ModuleService
from relay_server.sessions.context import ClientContext
from relay_server.sessions.manager import SessionManager
from relay_server.sessions.ports import Timing
from relay_server.sessions.rosbridge_port import RosbridgePort
from tests.worlds.relay import MemoryClient, World

PASSWORD = "correct horse"
HERE = "192.0.2.1"


class SessionsWorld:
    """A session manager and its parts: ann operates rover, and does not know of hidden."""

    def __init__(self, store: AsyncDatabase) -> None:
        self.store = store
        self.world = World()
        self.homes: RobotHomes = SingleHome()
        self.access = Access(store, self.wall, self.world.clock.seconds)
        # For mypy the reactor is a module.
        self.auth = Authenticator(reactor, store, self.world.clock.seconds, self.wall)  # type: ignore[arg-type]
        self.auth.start()
        self.bus = EventBus()
        self.published: list[BusEvent] = []
        self.bus.subscribe(self.published.append)
        self.url_tokens = UrlTokens(store, lambda: self.access.refreshed, self.world.clock.seconds, self.wall)
        self.logins = AuthService(
            self.world.clock, store, self.auth, self.access, self.bus, Origins("http"), "sb", self.url_tokens
        )
        self.service = SessionManager(
            self.world.clock,
            store,
            self.access,
            self.world.registry,
            self.world.channels,
            self.world.videos,
            self.world.control_service,
            self.module_service(),
            self.bus,
            Timing(2.0, 0.1, 5.0),
            clock_ns=self.world.now_ns,
            wall=self.wall,
        )
        with store.database.begin() as session:
            ann = queries.add_user(session, "ann", passwords.hash_password(PASSWORD))
            rover = queries.add_robot(session, "rover", "in the shed")
            queries.add_robot(session, "hidden")
            queries.grant_right(session, rover.id, "operator", user_id=ann.id)
        self.ann, self.rover = ann, rover

    def module_service(self) -> ModuleService:
        """Modules of the robots of this world, with reports that are stored."""
        self.module_reports = ModuleReportStore(self.world.clock, self.store, self.world.modules)
        return ModuleService(
            self.world.modules,
            self.world.registry,
            self.store,
            self.bus,
            self.wall,
            self.module_reports,
            self.homes,
        )

    def wall(self) -> float:
        """Unix time."""
        return 1000.0 + self.world.clock.seconds()

    async def logged_in(self) -> tuple[Principal, str]:
        """Ann's principal by a new session, and its token."""
        _, token = await self.logins.password("ann", PASSWORD, HERE)
        return await self.logins.token(token), token

    async def by_token(self, user: UserRecord, scope: str | None = None) -> Principal:
        """A user's principal by a token limited to a scope."""
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
        return await self.logins.token(token)

    async def opens(self, principal: Principal) -> tuple[RosbridgePort, MemoryClient]:
        """A websocket session of this principal."""
        client = MemoryClient()
        admission = await self.service.admit(principal, "rover", HERE)
        session = self.service.open(admission, client, self.world.now_ns())
        session.start()
        return session, client

    async def connected(self, principal: Principal) -> ClientContext:
        """A websocket session of this principal, as a client of control."""
        client, _ = await self.opens(principal)
        return client.session.client

    def events(self, kind: str) -> list[BusEvent]:
        """Events of a kind published so far."""
        return [each for each in self.published if each.kind == kind]
