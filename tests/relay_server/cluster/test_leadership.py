"""Tasks that one relay of a cluster does for all."""

from __future__ import annotations

from typing import Any

import pytest
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_db import queries
from relay_protocol.errors import Unavailable
from relay_server.cluster.leadership import ALERTS, LEASE_SECONDS, PURGES, RENEW_SECONDS, Leadership


class Leases:
    """A database with leases."""

    def __init__(self) -> None:
        self.answers = True
        self.holder = ""

    async def write(self, query: Any, *arguments: Any) -> bool:
        """The first relay gets each lease until it releases it."""
        if not self.answers:
            raise Unavailable("the database does not answer")
        if query is queries.release_relay_leases:
            self.holder = "" if self.holder == arguments[0] else self.holder
            return True
        self.holder = self.holder or arguments[1]
        return self.holder == arguments[1]


class Scene:
    """Two relays."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.leases: Any = Leases()
        self.one, self.two = (Leadership(self.clock, self.leases, name) for name in ("one", "two"))
        for each in (self.one, self.two):
            Deferred.fromCoroutine(each.start())

    @property
    def leaders(self) -> tuple[bool, bool]:
        return self.one.leads(ALERTS), self.two.leads(ALERTS)


@pytest.fixture
def scene() -> Scene:
    return Scene()


def test_one_relay_has_each_task(scene: Scene) -> None:
    assert scene.leaders == (True, False)
    assert scene.one.leads(PURGES)
    scene.clock.pump([RENEW_SECONDS] * 10)
    assert scene.leaders == (True, False)


def test_a_relay_that_stops_gives_its_tasks_to_another(scene: Scene) -> None:
    Deferred.fromCoroutine(scene.one.stop())
    scene.clock.advance(RENEW_SECONDS)
    assert scene.leaders == (False, True)


def test_without_the_database_a_task_ends_before_its_lease(scene: Scene) -> None:
    scene.leases.answers = False
    scene.clock.pump([1] * round(LEASE_SECONDS - 3))
    assert scene.leaders == (True, False)
    scene.clock.pump([1, 1])
    assert scene.leaders == (False, False)
