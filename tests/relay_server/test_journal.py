"""Events are kept, but no more of one cause than is bearable."""

from __future__ import annotations

from typing import Any

import pytest
import pytest_twisted
from twisted.logger import capturedLogs

from relay_db import queries
from relay_server.common.database import AsyncDatabase
from relay_server.events import bus as module
from relay_server.events.bus import BURST, WAITING, EventBus
from tests.relay_server.edges.robot_ends import until
from tests.relay_server.memory import Time


@pytest.fixture
def journal(store: AsyncDatabase, time: Time) -> EventBus:
    """A journal on a real database."""
    return EventBus(store, time)


async def kept(journal: EventBus, store: AsyncDatabase, kind: str) -> list[dict[str, Any]]:
    """The data of all events of a kind, oldest first."""
    await until(lambda: journal._waiting == 0)
    return [dict(event.data) for event in await store.read(queries.list_events, kind=kind, limit=1000)][::-1]


@pytest_twisted.ensureDeferred
async def test_a_burst_is_kept_and_what_comes_too_fast_is_counted(
    journal: EventBus, store: AsyncDatabase, time: Time
) -> None:
    """The count is told with the next event of that cause that is kept."""
    results = [journal.event("x", "relay", cause="192.0.2.1", n=n) for n in range(BURST + 30)]
    assert results == [True] * BURST + [False] * 30
    time.now += 1
    assert journal.event("x", "relay", cause="192.0.2.1", n=-1)
    assert not journal.event("x", "relay", cause="192.0.2.1", n=-2)
    assert [data["n"] for data in await kept(journal, store, "x")] == [*range(BURST), -1]
    assert await kept(journal, store, "events.suppressed") == [{"cause": "192.0.2.1", "count": 30}]


@pytest_twisted.ensureDeferred
async def test_who_listens_and_fails_undoes_nothing(journal: EventBus, store: AsyncDatabase) -> None:
    """The event is kept, others hear of it, and whoever caused it goes on; the log tells."""
    heard: list[str] = []

    def fails(kind: str, robot_id: int | None, data: dict[str, Any]) -> None:
        raise KeyError(kind)

    journal.listen(fails)
    journal.listen(lambda kind, robot_id, data: heard.append(kind))
    with capturedLogs() as logs:
        assert journal.event("x", "relay", cause="a", n=1)
        journal.tell("y", 1)
    assert heard == ["x", "y"]
    assert [each["log_failure"].type for each in logs] == [KeyError, KeyError]
    assert await kept(journal, store, "x") == [{"n": 1}]


@pytest_twisted.ensureDeferred
async def test_causes_do_not_disturb_each_other_but_a_network_is_one(
    journal: EventBus, store: AsyncDatabase
) -> None:
    """Whoever has a network of IPv6 addresses has one bucket."""
    for number in range(100):
        journal.event("x", "relay", cause=f"2001:db8::{number:x}")
    assert journal.event("y", "relay", cause="2001:db8:1::1")
    assert journal.event("y", "relay", cause="robot:main/r2-d2")
    assert len(await kept(journal, store, "x")) == BURST


@pytest_twisted.ensureDeferred
async def test_a_clock_that_is_set_back_gives_no_events_away(
    journal: EventBus, store: AsyncDatabase, time: Time
) -> None:
    """Nor does it lock a cause out."""
    for _ in range(BURST):
        journal.event("x", "relay", cause="a")
    time.now -= 500
    assert not journal.event("x", "relay", cause="a")
    time.now += 1
    assert journal.event("x", "relay", cause="a")
    assert len(await kept(journal, store, "x")) == BURST + 1


@pytest_twisted.ensureDeferred
async def test_events_leave_room_for_logins_in_the_writers_queue(
    journal: EventBus, store: AsyncDatabase
) -> None:
    """Many causes at once may fill only their part of it."""
    results = [journal.event("x", "relay", cause=f"robot:{number}") for number in range(WAITING + 50)]
    assert results == [True] * WAITING + [False] * 50
    assert (await store.write(queries.add_user, "ann", None)).name == "ann"
    assert len(await kept(journal, store, "x")) == WAITING
    assert journal.event("x", "relay", cause="robot:0")
    await until(lambda: journal._waiting == 0)


def test_causes_are_forgotten_when_there_are_too_many(
    journal: EventBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Addresses without end fill no memory."""
    monkeypatch.setattr(module, "CAUSES", 10)
    monkeypatch.setattr(journal, "_write", lambda *_: None)
    for number in range(100):
        journal.event("x", "relay", cause=f"192.0.2.{number}")
    assert len(journal._causes) == 10
