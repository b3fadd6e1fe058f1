"""Lists of pages are looked up and encoded once for all pages that may see the same."""

from __future__ import annotations

import dataclasses
import gc
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.task import Clock

from relay_protocol.errors import Unavailable
from relay_server.http import live_updates as module
from relay_server.http.live_updates import COALESCE_SECONDS, Shown, Sources
from tests.worlds.http_client import ANN, ROOT, World

BOB = dataclasses.replace(ANN, user_id=3, name="bob")
ROW = {"name": "rover"}


class Counted:
    """A source that counts how often it is asked."""

    def __init__(self) -> None:
        self.clock = Clock()
        self.asked: list[str] = []
        self.rows: list[dict[str, Any]] = [ROW]
        self.answer: Deferred[None] | None = None
        self.listeners: list[Callable[[], None]] = []
        self.sources = Sources(self.clock, {"robots": self._robots}, self._on_change)

    async def _robots(self, principal: Any) -> list[dict[str, Any]]:
        self.asked.append(principal.name)
        if self.answer is not None:
            await self.answer
        return list(self.rows)

    def _on_change(self, listener: Callable[[], None]) -> Callable[[], None]:
        self.listeners.append(listener)
        return lambda: self.listeners.remove(listener)

    def changed(self) -> None:
        """Something changed."""
        for listener in list(self.listeners):
            listener()

    def look(self, principal: Any = ANN) -> Deferred[list[Shown]]:
        """A page looks."""
        return Deferred.fromCoroutine(self.sources.visible_to(principal))

    def shown(self, principal: Any = ANN) -> Shown:
        """The rows that it shows at once."""
        found: list[Shown] = []
        self.look(principal).addCallback(found.extend)
        (shown,) = found
        return shown


@pytest.fixture
def counted() -> Counted:
    """A source without look-ups."""
    return Counted()


@pytest.mark.parametrize("streams", [10, 20])
def test_twice_as_many_streams_cost_no_more_look_ups_and_no_more_encoding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, streams: int
) -> None:
    """Over HTTP: each change is looked up once for a user, however many streams they have."""
    world = World(tmp_path)
    world.site.connection_limits._most = 100
    looks = encoded = 0
    rows: list[dict[str, Any]] = []

    async def robots(principal: Any) -> list[dict[str, Any]]:
        nonlocal looks
        looks += 1
        return rows

    real = module.jsontext.encode

    def encode(value: Any) -> bytes:
        nonlocal encoded
        encoded += 1
        return real(value)

    monkeypatch.setattr(module.jsontext, "encode", encode)
    world.events["robots"] = robots
    transports = [world.connect() for _ in range(streams)]
    for each in transports:
        world.clock.advance(0.01)
        world.send(
            each, b"GET /api/v1/robots/stream HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer ann\r\n\r\n"
        )
    world.clock.pump([COALESCE_SECONDS] * 2)
    looks = encoded = 0
    for number in range(10):
        rows = [{"name": f"robot {number}"}]
        world.service.changed()
        world.clock.advance(COALESCE_SECONDS)
    assert looks <= 25
    assert encoded <= looks
    assert all(each.value().count(b"event: robots") >= 10 for each in transports)


def test_users_with_the_same_rows_share_the_bytes(counted: Counted) -> None:
    """The rights of each user are judged separately."""
    assert counted.shown(ANN).body is counted.shown(BOB).body
    assert counted.asked == ["ann", "bob"]


def test_users_and_scopes_share_no_look_up(counted: Counted) -> None:
    """A user with fewer rights must not see the rows of others."""
    narrow = dataclasses.replace(ANN, scope=frozenset({"rover"}))
    for each in (ANN, ROOT, narrow, dataclasses.replace(ANN, admin=True)):
        counted.shown(each)
        counted.shown(each)
    assert len(counted.asked) == 4


def test_a_look_up_is_used_until_a_change_or_some_time_later(counted: Counted) -> None:
    """Unchanged rows are not encoded again."""
    end = counted.sources.on_change(lambda: None)
    first = counted.shown()
    counted.clock.advance(COALESCE_SECONDS / 2)
    assert counted.shown() is first
    assert len(counted.asked) == 1
    counted.changed()
    assert counted.shown() is first
    assert len(counted.asked) == 2
    counted.clock.advance(COALESCE_SECONDS)
    counted.rows = [{"name": "digger"}]
    assert counted.shown().rows == [{"name": "digger"}]
    end()
    assert counted.listeners == []


def test_pages_share_a_pending_look_up(counted: Counted) -> None:
    """Even when the first page leaves. A change meanwhile causes another look-up."""
    end = counted.sources.on_change(lambda: None)
    counted.answer = Deferred()
    found: list[Any] = []
    looks = [counted.look() for _ in range(3)]
    for each in looks:
        each.addCallbacks(found.append, lambda failure: failure.trap(CancelledError))
    looks[0].cancel()
    assert counted.asked == ["ann"]
    counted.changed()
    late = counted.look().addCallback(found.append)
    assert counted.asked == ["ann", "ann"]
    counted.answer.callback(None)
    assert len(found) == 3
    assert late.called
    end()


def test_a_failed_look_up_fails_for_all_that_wait_and_is_not_stored(counted: Counted) -> None:
    counted.answer = Deferred()
    failed: list[str] = []
    for _ in range(2):
        counted.look().addErrback(lambda failure: failed.append(str(failure.value)))
    counted.answer.errback(Unavailable("the database does not answer"))
    assert failed == ["the database does not answer"] * 2
    counted.answer = None
    assert counted.shown().rows == [ROW]


def test_stored_results_are_bounded(counted: Counted, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "KEPT", 4)
    for number in range(20):
        counted.shown(dataclasses.replace(ANN, user_id=number))
    assert len(counted.sources._known.of) <= 4
    assert len(counted.sources._same) <= 4


def test_rows_that_no_page_shows_are_dropped(counted: Counted) -> None:
    """A user's rows differ at every look-up."""
    for number in range(2000):
        counted.rows = [{"name": "rover", "rtt_ms": number}]
        counted.shown()
        counted.clock.advance(COALESCE_SECONDS)
    gc.collect()
    assert len(counted.sources._same) == 1
    assert len(counted.sources._known.of) == 1


PEOPLE = [dataclasses.replace(ANN, user_id=10 + number, name=f"user{number}") for number in range(8)]


@given(
    st.lists(
        st.tuples(
            st.sampled_from(PEOPLE),
            st.integers(0, 2),
            st.sampled_from(["look", "look", "look", "change", "wait", "collect"]),
        ),
        max_size=40,
    )
)
def test_no_user_ever_sees_the_rows_of_another(steps: list[tuple[Any, int, str]]) -> None:
    """Rows are made for each look-up, so new ones may have the memory addresses of old ones."""
    counted = Counted()
    ends = counted.sources.on_change(lambda: None)

    async def robots(principal: Any) -> list[dict[str, Any]]:
        return [{"of": principal.name, "state": state, "number": number} for number in range(2)]

    counted.sources._sources = {"robots": robots}
    for person, now, step in steps:
        state = now
        if step == "change":
            counted.changed()
        elif step == "wait":
            counted.clock.advance(COALESCE_SECONDS)
        elif step == "collect":
            gc.collect(0)
        shown = counted.shown(person)
        assert {row["of"] for row in shown.rows} == {person.name}
        assert shown.body == module.jsontext.encode({"robots": shown.rows})
    ends()


def test_pages_of_many_users_never_show_the_robots_of_another(tmp_path: Path) -> None:
    """Over HTTP: the robots of all users differ by name only."""
    world = World(tmp_path)
    world.site.connection_limits._most = 100
    users = [f"user{number:02}" for number in range(40)]
    tick = 0

    async def robots(principal: Any) -> list[dict[str, Any]]:
        return [{"name": f"robot of {principal.name}", "state": "offline", "rtt_ms": tick}]

    world.events["robots"] = robots
    transports = {}
    for number, name in enumerate(users):
        world.service.tokens[name] = dataclasses.replace(ANN, user_id=100 + number, name=name)
        transports[name] = world.connect()
        head = f"GET /api/v1/robots/stream HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {name}\r\n\r\n"
        world.send(transports[name], head.encode())
    for tick in range(1, 20):
        if tick % 3 == 0:
            world.service.changed()
        if tick % 4 == 0:
            gc.collect()
        world.clock.pump([COALESCE_SECONDS] * 8)
    for name, transport in transports.items():
        reported = set(re.findall(rb"robot of (user\d\d)", transport.value()))
        assert reported == {name.encode()}
        assert transport.value().count(b"event: robots") >= 10
        transport.loseConnection()
