"""What pages show is looked up and encoded once for all that may see the same."""

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
from relay_server.http import update_sources as module
from relay_server.http.update_sources import COALESCE_SECONDS, Shown, Sources
from tests.relay_server.edges.http_client import ANN, ROOT, World

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
        return Deferred.fromCoroutine(self.sources.look(principal))

    def shown(self, principal: Any = ANN) -> Shown:
        """What it is shown at once."""
        found: list[Shown] = []
        self.look(principal).addCallback(found.extend)
        (shown,) = found
        return shown


@pytest.fixture
def counted() -> Counted:
    """Nobody has asked yet."""
    return Counted()


@pytest.mark.parametrize("streams", [10, 20])
def test_twice_as_many_streams_cost_no_more_looks_and_no_more_encoding(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, streams: int
) -> None:
    """Over HTTP: each change is looked up once for a user, however many streams they have."""
    world = World(tmp_path)
    world.site.cap._most = 100
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
        world.desk.changed()
        world.clock.advance(COALESCE_SECONDS)
    assert looks <= 25
    assert encoded <= looks
    assert all(each.value().count(b"event: robots") >= 10 for each in transports)


def test_users_who_are_shown_the_same_rows_share_the_bytes(counted: Counted) -> None:
    """Each of them is judged by themselves."""
    assert counted.shown(ANN).body is counted.shown(BOB).body
    assert counted.asked == ["ann", "bob"]


def test_users_and_scopes_share_no_look(counted: Counted) -> None:
    """Whoever may see less must not be shown what others see."""
    narrow = dataclasses.replace(ANN, scope=frozenset({"rover"}))
    for each in (ANN, ROOT, narrow, dataclasses.replace(ANN, admin=True)):
        counted.shown(each)
        counted.shown(each)
    assert len(counted.asked) == 4


def test_a_look_is_good_until_something_changes_or_time_has_passed(counted: Counted) -> None:
    """What did not change by then is the same, and is not encoded again."""
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


def test_pages_that_look_at_the_same_time_wait_for_the_same_answer(counted: Counted) -> None:
    """Also when the one that asked first leaves; what changes meanwhile is asked again."""
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


def test_an_answer_that_fails_fails_for_all_who_wait_and_is_not_kept(counted: Counted) -> None:
    """The next look may do better."""
    counted.answer = Deferred()
    failed: list[str] = []
    for _ in range(2):
        counted.look().addErrback(lambda failure: failed.append(str(failure.value)))
    counted.answer.errback(Unavailable("the database does not answer"))
    assert failed == ["the database does not answer"] * 2
    counted.answer = None
    assert counted.shown().rows == [ROW]


def test_what_is_kept_is_bounded(counted: Counted, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many users have pages."""
    monkeypatch.setattr(module, "KEPT", 4)
    for number in range(20):
        counted.shown(dataclasses.replace(ANN, user_id=number))
    assert len(counted.sources._known.of) <= 4
    assert len(counted.sources._same) <= 4


def test_rows_that_nobody_is_shown_any_more_are_not_kept(counted: Counted) -> None:
    """One user's rows that differ at every look leave nothing behind."""
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
def test_nobody_is_ever_shown_the_rows_of_somebody_else(steps: list[tuple[Any, int, str]]) -> None:
    """Rows are made anew for each look, as those of robots are, so new ones have the addresses of old ones."""
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
            gc.collect()
        shown = counted.shown(person)
        assert {row["of"] for row in shown.rows} == {person.name}
        assert shown.body == module.jsontext.encode({"robots": shown.rows})
    ends()


def test_pages_of_many_users_never_show_the_robots_of_another(tmp_path: Path) -> None:
    """Over HTTP: each has a robot of their own, and all robots look alike but for the name."""
    world = World(tmp_path)
    world.site.cap._most = 100
    users = [f"user{number:02}" for number in range(40)]
    tick = 0

    async def robots(principal: Any) -> list[dict[str, Any]]:
        return [{"name": f"robot of {principal.name}", "state": "offline", "rtt_ms": tick}]

    world.events["robots"] = robots
    transports = {}
    for number, name in enumerate(users):
        world.desk.tokens[name] = dataclasses.replace(ANN, user_id=100 + number, name=name)
        transports[name] = world.connect()
        head = f"GET /api/v1/robots/stream HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {name}\r\n\r\n"
        world.send(transports[name], head.encode())
    for tick in range(1, 20):
        if tick % 3 == 0:
            world.desk.changed()
        if tick % 4 == 0:
            gc.collect()
        world.clock.pump([COALESCE_SECONDS] * 8)
    for name, transport in transports.items():
        told = set(re.findall(rb"robot of (user\d\d)", transport.value()))
        assert told == {name.encode()}
        assert transport.value().count(b"event: robots") >= 10
        transport.loseConnection()
