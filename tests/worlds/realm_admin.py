"""Administrators of two realms in a real database, and the relay's reactions."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

from twisted.internet.defer import Deferred

from relay_db import queries
from relay_db.queries import PrincipalRecord
from relay_protocol.errors import Unavailable
from relay_server.access import Principal
from relay_server.auth import passwords
from relay_server.common.database import AsyncDatabase
from relay_server.realms.service import RealmService
from relay_server.resources.page import PageQuery

HERE = "192.0.2.1"
ALL = PageQuery()


class RealmAdminWorld:
    """Two realms with a user ``toad``, a group ``crew``, a robot ``mobile`` and a group of robots ``cleaners`` each,
    and administrators: ``root`` and ``boss`` of lab1, ``root`` of lab2.
    """

    def __init__(self, store: AsyncDatabase) -> None:
        self.store = store
        self.taken_up = 0
        self.down = False
        self.held: Deferred[None] | None = None
        self.recorded = 0
        self.seconds = 0.0
        self.people: dict[str, Principal] = {}
        library = SimpleNamespace(of=lambda number: [None] * self.recorded)
        self.service = RealmService(
            store,
            self,
            cast(Any, SimpleNamespace(library=library)),
            self.take_up,
            lambda: 9091,
            lambda: 1000.0,
            lambda: self.seconds,
        )
        with store.database.begin() as s:
            for lab in ("lab1", "lab2"):
                queries.add_realm(s, lab)
                queries.add_group(s, "crew", lab)
                queries.add_robot(s, "mobile", realm=lab)
                queries.add_robot_group(s, "cleaners", lab)
                for name in ("toad", "root", *(["boss"] if lab == "lab1" else [])):
                    user = queries.add_user(s, name, None, admin=name != "toad", realm=lab)
                    self.people[f"{name}@{lab}"] = self._principal(s, user, None)

    @staticmethod
    def _principal(s: Any, user: queries.UserRecord, scope: str | None) -> Principal:
        hash = passwords.token_hash(passwords.new_token())
        token = queries.create_token(s, user.id, hash, kind="access", expires=None, now=1.0, scope=scope)
        return Principal.of(PrincipalRecord(user.id, user.name, user.realm, user.admin, token, None, scope))

    def by_token(self, name: str, realm: str, scope: str | None) -> Principal:
        """A user with one more token."""
        with self.store.database.begin() as s:
            user = queries.find_user(s, name, realm)
            assert user is not None
            return self._principal(s, user, scope)

    async def new_hash(self, password: str) -> str:
        """As a relay does, but at once, or when the test releases it."""
        if self.held is not None:
            await self.held
        return passwords.hash_password(password)

    async def take_up(self) -> None:
        """The relay applies changes of the database."""
        if self.down:
            raise Unavailable("the database does not answer")
        self.taken_up += 1

    async def do(self, work: Callable[..., Any], *args: Any, who: str = "root@lab1") -> Any:
        """A change by a user."""
        principal = self.people[who]
        self.service.admit(principal, changes=True)
        return await self.service.change(principal, HERE, work, *args)

    async def see(self, query: Callable[..., Any], *args: Any, who: str = "root@lab1") -> Any:
        """A query by a user."""
        self.service.admit(self.people[who])
        return await self.service.read(self.people[who], query, *args)

    def record(self) -> list[tuple[str, str, str, str, dict[str, Any]]]:
        """The audit log."""
        with self.store.database.reading() as s:
            entries = reversed(queries.list_audit(s))
            return [(each.actor, each.origin, each.action, each.target, each.data) for each in entries]
