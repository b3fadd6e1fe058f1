"""Rules of Roles that need no process."""

from __future__ import annotations

from typing import Any, cast

import pytest
import pytest_twisted
from twisted.internet.defer import Deferred

from relay_db import queries
from relay_protocol.errors import Unavailable
from relay_server.access import Principal
from relay_server.roles.service import RoleService


class EmptyRealm:
    """A database without Roles, and a process with answers of the test."""

    generation = 1

    def __init__(self) -> None:
        self.asked: list[Deferred[Any]] = []

    async def read(self, query: Any, *arguments: Any) -> Any:
        return (0, 0, 0) if query is queries.role_version else []

    def start_process(self) -> None: ...

    def ask(self, do: str, **fields: Any) -> Deferred[Any]:
        self.asked.append(Deferred())
        return self.asked[-1]


def principal(user: int) -> Principal:
    return Principal(user, f"user{user}", "lab", True, user, None)


@pytest_twisted.ensureDeferred
async def test_users_do_not_wait_for_each_other() -> None:
    realm = EmptyRealm()
    service = RoleService(cast(Any, realm), cast(Any, realm), cast(Any, realm))
    running = [Deferred.fromCoroutine(service.query(principal(1), "ASK {}", "", "")) for _ in range(2)]
    with pytest.raises(Unavailable, match="2 documents and queries of yours"):
        await service.query(principal(1), "ASK {}", "", "")
    running.append(Deferred.fromCoroutine(service.query(principal(2), "ASK {}", "", "")))
    for each in realm.asked:
        each.callback(("text/csv", b""))
    assert [await each for each in running] == [("text/csv", b"")] * 3
    again = Deferred.fromCoroutine(service.query(principal(1), "ASK {}", "", ""))
    realm.asked[-1].callback(("text/csv", b"x"))
    assert await again == ("text/csv", b"x")
