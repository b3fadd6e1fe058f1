"""Rights to read and write events, with a real database."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_db import queries
from relay_db.queries import StoredEventCounts, event_search
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable
from relay_protocol.scopes import Scope
from relay_server.access import Access, Principal
from relay_server.common.database import AsyncDatabase
from relay_server.events import service as module
from relay_server.events.bus import BusEvent, EventFollower, RecentEvents
from relay_server.events.collector import EventCollector
from relay_server.events.query import EventInfo, EventQuery, parse_query
from relay_server.events.service import EventService, NewEvent
from relay_server.events.writer import EventQuota, EventWriter
from relay_server.robots.registry import RobotRegistry
from tests.worlds.relay import Time


class EventWorld:
    """An event log: ann may use rover, bob hidden, root administers; cleo belongs to another realm with its
    own rover.
    """

    def __init__(self, store: AsyncDatabase, time: Time) -> None:
        self.store, self.time = store, time
        self.access = Access(store, time)
        self.recent = RecentEvents(100)
        self.quota = EventQuota(Clock(), store, time, per_source=20, retention=1000.0, per_realm=50)
        self.writer = EventWriter(reactor, store, time, self._written)
        self.service = EventService(store, self.access, self.writer, self.quota, self.recent, time)
        self.people: dict[str, Principal] = {}
        self.robots: dict[str, int] = {}
        with store.database.begin() as s:
            queries.add_realm(s, "lab")
            for name, realm in (("ann", "default"), ("bob", "default"), ("root", "default"), ("cleo", "lab")):
                user = queries.add_user(s, name, None, realm=realm)
                self.people[name] = Principal(user.id, name, realm, name == "root", user.id, None)
            for robot, realm, user in (
                ("rover", "default", "ann"), ("hidden", "default", "bob"), ("rover", "lab", "cleo"),
            ):  # fmt: skip
                record = queries.add_robot(s, robot, realm=realm)
                self.robots.setdefault(robot, record.id)
                queries.grant_right(s, record.id, "viewer", user_id=self.people[user].user_id)
        self.registry = RobotRegistry(time)
        for name, number in self.robots.items():
            self.registry.robot(number, name, "default")
        self.collector = EventCollector(self.writer, self.registry, time, lambda: time.now)

    def _written(self, events: list[queries.StoredEventRecord]) -> None:
        self.quota.on_written(events)
        self.recent.on_written(events)

    async def write(self, who: str, *events: dict[str, Any]) -> list[dict[str, Any]]:
        """A user writes events."""
        new = [msgspec.json.decode(msgspec.json.encode(each), type=NewEvent) for each in events]
        return decoded(await self.service.write(self.people[who], new))

    async def reads(self, who: str | Principal, **query: str) -> list[str]:
        """Types of the events that a user reads, newest first."""
        principal = self.people[who] if isinstance(who, str) else who
        ask = parse_query(query, self.time())
        found, formatter, _ = await self.service.page(principal, ask, ask.limit)
        assert await self.service.count(principal, ask) == (len(found), None)
        return [each["kind"] for each in decoded([formatter.info(each) for each in found])]


def decoded(events: list[EventInfo]) -> list[dict[str, Any]]:
    """The events as a client reads them."""
    found: list[dict[str, Any]] = msgspec.json.decode(msgspec.json.encode(events))
    return found


@pytest.fixture
def world(store: AsyncDatabase, time: Time) -> Iterator[EventWorld]:
    """An empty event log."""
    yield EventWorld(store, time)


@pytest_twisted.ensureDeferred
async def test_an_event_comes_back_as_it_was_written(world: EventWorld) -> None:
    [reported] = await world.write(
        "ann", {"kind": "greeted", "robot": "rover", "data": {"who": "Bö", "n": [1]}}
    )
    assert reported == {
        "id": 1,
        "source": "ann",
        "kind": "greeted",
        "robot": "rover",
        "user": "ann",
        "at": 1000.0,
        "data": {"who": "Bö", "n": [1]},
        "use_count": 0,
    }
    found, formatter, more = await world.service.page(world.people["ann"], EventQuery(), 10)
    assert decoded([formatter.info(each) for each in found]) == [reported] and more is None


@pytest_twisted.ensureDeferred
async def test_events_are_visible_by_rights(world: EventWorld) -> None:
    await world.write("ann", {"kind": "about-rover", "robot": "rover"}, {"kind": "for-all"})
    await world.write("bob", {"kind": "about-hidden", "robot": "hidden"}, {"kind": "login.odd"})
    await world.write("cleo", {"kind": "elsewhere"}, {"kind": "other-rover", "robot": "rover"})
    world.writer.count_drop("default")
    world.collector.on_bus_event(BusEvent("login.refused", None, "relay", {"user": "x"}))
    await world.writer.flush()
    assert await world.reads("ann") == ["for-all", "about-rover"]
    assert await world.reads("bob") == ["about-hidden", "for-all"]
    assert await world.reads("root") == ["events.dropped", "login.refused", "login.odd", "for-all"]
    assert await world.reads("root", source="relay") == ["login.refused"]
    assert await world.reads("cleo") == ["other-rover", "elsewhere"]
    assert await world.reads("cleo", robot="*") == ["other-rover"]
    assert await world.reads("ann", robot="hidden") == []
    assert await world.reads("ann", robot="r*") == ["about-rover"]
    narrow = world.people["ann"]
    elsewhere = Principal(narrow.user_id, "ann", "default", False, 1, None, Scope("viewer@elsewhere"))
    assert await world.reads(elsewhere) == ["for-all"]


@pytest_twisted.ensureDeferred
async def test_restricted_names_are_left_out(world: EventWorld) -> None:
    world.collector.on_bus_event(
        BusEvent("call.begun", world.robots["rover"], "user:bob", {"service": "/reset"})
    )
    await world.writer.flush()
    await world.write("ann", {"kind": "x", "robot": "rover", "data": {"service": "/reset"}})
    wanted = {"data.service": "/reset"}
    assert await world.reads("ann") == ["x", "call.begun"]
    assert await world.reads("ann", **wanted) == []
    assert await world.reads("ann", source="ann", **wanted) == ["x"]
    with world.store.database.begin() as s:
        queries.grant_right(s, world.robots["rover"], "operator", user_id=world.people["ann"].user_id)
    await world.access.refresh()
    assert await world.reads("ann", **wanted) == ["x", "call.begun"]


@pytest_twisted.ensureDeferred
async def test_a_right_that_comes_or_goes_counts_at_once(world: EventWorld) -> None:
    await world.write("ann", {"kind": "x", "robot": "rover"})
    assert await world.reads("bob") == []
    with world.store.database.begin() as s:
        queries.grant_right(s, world.robots["rover"], "viewer", user_id=world.people["bob"].user_id)
    await world.access.refresh()
    assert await world.reads("bob") == ["x"]


WRONG: list[tuple[dict[str, Any], type[SwitchboardError]]] = [
    ({"kind": "x", "robot": "hidden"}, NotFound),
    ({"kind": "x", "robot": "nowhere"}, NotFound),
    ({"kind": "x", "source": "relay"}, Refused),
    ({"kind": "x", "source": "relay:rover"}, Refused),
    ({"kind": "x", "source": "relayed"}, Refused),
    ({"kind": "x", "source": "relay.dropped"}, Refused),
    ({"kind": "a\nb"}, Invalid),
    ({"kind": "x", "source": "a\u202eb"}, Invalid),
    ({"kind": "x", "data": [1]}, Invalid),
    ({"kind": "x", "data": None}, Invalid),
    ({"kind": "x", "data": {"a": "x" * 4090}}, Invalid),
    ({"kind": "x", "data": {"a": "ä" * 700}}, Invalid),
]


@pytest_twisted.ensureDeferred
async def test_invalid_event_refuses_the_whole_request(world: EventWorld) -> None:
    for event, error in WRONG:
        with pytest.raises(error) as caught:
            await world.write("ann", {"kind": "before"}, event)
        if error is NotFound:
            assert str(caught.value) == "there is no such robot, or you have no right on it"
    assert await world.reads("ann") == []


@pytest_twisted.ensureDeferred
async def test_as_much_as_fits_is_taken(world: EventWorld) -> None:
    """The limits are 4096 characters of data and 100 events per request."""
    [reported] = await world.write("ann", {"kind": "x", "data": {"a": "x" * (4096 - len('{"a":""}'))}})
    assert len(reported["data"]["a"]) == 4088
    assert len(await world.write("ann", *({"kind": "x"} for _ in range(100)))) == 100
    for events in ([], [{"kind": "x"}] * 101):
        with pytest.raises(Invalid):
            await world.write("ann", *events)


@pytest_twisted.ensureDeferred
async def test_returned_and_counted_events_count_as_used(world: EventWorld) -> None:
    await world.write("ann", *({"kind": "x", "data": {"n": n}} for n in range(3)))
    ann = world.people["ann"]
    assert await world.service.count(ann, parse_query({"data.n": "0"}, 0.0)) == (1, None)
    for _ in range(2):
        _, _, more = await world.service.page(ann, EventQuery(), 2)
        assert more is not None
    await world.service.page(ann, EventQuery(), 10, uses=False)
    await world.quota.run_once()
    found, _, _ = await world.service.page(ann, EventQuery(), 10)
    assert [(each.number, each.use_count) for each in found] == [(3, 2), (2, 2), (1, 1)]
    for _ in range(2):
        await world.write("bob", *({"kind": "y"} for _ in range(60)))
    assert await world.service.count(world.people["bob"], parse_query({"kind": "y"}, 0.0)) == (120, None)
    await world.quota.run_once()
    found, _, _ = await world.service.page(
        world.people["bob"], parse_query({"kind": "y"}, 0.0), 200, uses=False
    )
    assert {each.use_count for each in found} == {0}


@pytest_twisted.ensureDeferred
async def test_a_source_has_no_more_than_its_share(world: EventWorld) -> None:
    """The oldest of its least used types are removed; other sources, and the same source of another realm,
    keep theirs.
    """
    for _ in range(3):
        await world.write("ann", *({"kind": "x", "source": "busy"} for _ in range(10)))
        await world.service.page(world.people["ann"], EventQuery(), 1)
    await world.write("ann", {"kind": "y", "source": "quiet"})
    await world.write("cleo", {"kind": "x", "source": "busy"})
    await world.quota.run_once()
    found, _, _ = await world.service.page(world.people["ann"], parse_query({"source": "busy"}, 0.0), 100)
    # 10, 20 and 30 belong to robots that clients named. Of the others the newest stay.
    assert [each.number for each in found] == [*range(30, 11, -1), 10]
    assert await world.reads("ann", source="quiet") == ["y"]
    assert await world.reads("cleo") == ["x"]


@pytest_twisted.ensureDeferred
async def test_events_of_a_realm_are_limited_by_number_and_age(world: EventWorld) -> None:
    """The limit covers many sources with few events; the oldest are removed, and expired events always."""
    for each in range(60):
        await world.write("ann", {"kind": f"k{each}", "source": f"s{each}"})
        world.time.now += 1
    await world.quota.run_once()
    assert await world.reads("ann") == [f"k{each}" for each in range(59, 9, -1)]
    world.time.now = 1000.0 + 1000.0 + 55.5
    await world.quota.purge()
    assert await world.reads("ann") == [f"k{each}" for each in range(59, 55, -1)]


@pytest_twisted.ensureDeferred
async def test_a_realm_may_keep_events_for_a_time_of_its_own(world: EventWorld) -> None:
    """It may be shorter or longer than the relay's. Events of other realms are not affected."""
    await world.write("ann", {"kind": "here"})
    await world.write("cleo", {"kind": "there"})
    with world.store.database.begin() as s:
        queries.set_event_retention(s, "lab", 5000 / 86400)
    world.time.now += 4000
    await world.quota.purge()
    assert (await world.reads("ann"), await world.reads("cleo")) == ([], ["there"])
    with world.store.database.begin() as s:
        queries.set_event_retention(s, "lab", 1000 / 86400)
    await world.write("ann", {"kind": "later"})
    await world.quota.purge()
    assert (await world.reads("ann"), await world.reads("cleo")) == (["later"], [])


@pytest_twisted.ensureDeferred
async def test_a_follower_gets_new_events_that_it_may_see(world: EventWorld) -> None:
    ann = world.people["ann"]
    await world.write("ann", {"kind": "a"}, {"kind": "b"})
    begun = await world.service.follow_from(ann, None)
    again = await world.service.follow_from(ann, 1)
    assert (begun.number, (await world.service.follow_from(ann, 99)).number) == (2, 2)
    async with world.service.following(begun) as following:
        waiting = Deferred.fromCoroutine(following.news())
        assert not waiting.called
        await world.write("bob", {"kind": "secret", "robot": "hidden"}, {"kind": "c"})
        await waiting
        assert await new_types(world, following, ann) == ["c"]
        assert await new_types(world, following, ann) == []
    assert await new_types(world, again, ann) == ["b", "c"]
    world.recent = world.service._recent = RecentEvents(2)
    assert await new_types(world, EventFollower(0), ann) == ["a", "b", "c"]
    await world.write("ann", *({"kind": "d"} for _ in range(5)))
    assert await new_types(world, EventFollower(1), ann) == ["b", "c", *"ddddd"]
    assert await new_types(world, EventFollower(7), ann, kind="e") == []


async def new_types(world: EventWorld, following: EventFollower, who: Principal, **query: str) -> list[str]:
    """Types of the new events."""
    events, _, _ = await world.service.news(who, parse_query(query, 0.0), following)
    return [each.kind for each in events]


@pytest_twisted.ensureDeferred
async def test_an_oauth_client_writes_under_its_own_label(world: EventWorld) -> None:
    ann = world.people["ann"]
    with world.store.database.begin() as s:
        for token, label in ((31, "greeting"), (32, "")):
            queries.add_oauth_client(
                s, ann.user_id, f"key{token}", "0" * 64, scope=None, label=label, now=1.0
            )
        numbers = [each.id for each in queries.list_oauth_clients(s, ann.user_id)]
        tokens = [
            queries.create_token(
                s, ann.user_id, f"{at}" * 64, kind="access", expires=None, now=1.0, oauth_client_id=number
            )
            for at, number in enumerate(numbers)
        ]
    sources = []
    for token in tokens:
        by = Principal(ann.user_id, "ann", "default", False, token, None)
        for _ in range(2):
            [reported] = await world.service.write(by, [NewEvent("x")])
            sources.append((reported.source, reported.user))
    assert sources == [("greeting", "ann")] * 2 + [("ann", "ann")] * 2


QUERIES: list[dict[str, str]] = [
    {}, {"source": "a*"}, {"kind": "k1"}, {"robot": "rover"}, {"robot": "h*"}, {"user": "bob"}, {"data.n": "1"},
    {"data.n": "true"}, {"data.deep": "1"}, {"since": "1001"}, {"until": "1001", "kind": "k*"},
]  # fmt: skip


@pytest_twisted.ensureDeferred
async def test_the_stream_and_the_database_see_the_same(world: EventWorld) -> None:
    await world.write(
        "ann", {"kind": "k1", "data": {"n": 1}}, {"kind": "k2", "robot": "rover", "data": {"n": "1"}}
    )
    world.time.now += 1
    await world.write(
        "bob", {"kind": "login", "data": {"n": True}}, {"kind": "k1", "robot": "hidden", "source": "a"}
    )
    await world.write("bob", {"kind": "k11", "source": "abc", "data": {"in": {"deep": 1}, "n": 11}})
    world.collector.on_bus_event(BusEvent("login.refused", None, "relay", {}))
    await world.writer.flush()
    for query in QUERIES:
        for who in ("ann", "bob", "root", "cleo"):
            asked = await world.reads(who, **query)
            assert await new_types(world, EventFollower(0), world.people[who], **query) == asked[::-1], (
                who,
                query,
            )


class Slow:
    """A database whose thread works until the test releases it, even if its callers have left."""

    def __init__(self) -> None:
        self.reads: list[Deferred[Any]] = []

    async def read(self, query: Any, *args: Any) -> Any:
        """Begins another read."""
        self.reads.append(Deferred())
        return await self.reads[-1]


@pytest.fixture
def slow(world: EventWorld) -> Slow:
    """The slow database under the event service; rights are read from the real one."""
    made: Any = Slow()
    world.service._store = made
    return made


async def counting(world: EventWorld, who: str) -> Deferred[Any]:
    """A user counts events."""
    await world.access.robots(world.people[who])
    return Deferred.fromCoroutine(world.service.count(world.people[who], EventQuery()))


@pytest_twisted.ensureDeferred
async def test_a_cancelled_read_keeps_its_turn_until_it_ends(
    world: EventWorld, slow: Slow, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_READS", 3)
    first, second, third = [await counting(world, who) for who in ("ann", "bob", "root")]
    for each in (first, second):
        each.addErrback(lambda failure: None)
        each.cancel()
    assert len(slow.reads) == 1 and not slow.reads[0].called
    await counting(world, "bob")
    with pytest.raises(Unavailable):
        await (await counting(world, "cleo"))
    slow.reads[0].callback(StoredEventCounts(1, [1], None))
    assert len(slow.reads) == 2
    slow.reads[1].callback(StoredEventCounts(7, [], None))
    assert await third == (7, None)
    assert len(slow.reads) == 3


@pytest_twisted.ensureDeferred
async def test_a_read_that_fails_is_not_the_end_of_reading(world: EventWorld, slow: Slow) -> None:
    first, second = await counting(world, "ann"), await counting(world, "bob")
    slow.reads[0].errback(Unavailable("locked"))
    with pytest.raises(Unavailable, match="locked"):
        await first
    slow.reads[1].callback(StoredEventCounts(1, [1], None))
    assert await second == (1, None)


@pytest_twisted.ensureDeferred
async def test_queue_of_reads_is_limited_per_user(
    world: EventWorld, slow: Slow, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_READS_PER_USER", 2)
    mine = [await counting(world, "ann") for _ in range(2)]
    with pytest.raises(Unavailable, match="more than 2"):
        await (await counting(world, "ann"))
    other = await counting(world, "bob")
    for at in range(3):
        slow.reads[at].callback(StoredEventCounts(at, [], None))
    assert [(await each)[0] for each in (*mine, other)] == [0, 1, 2]
    again = await counting(world, "ann")
    slow.reads[3].callback(StoredEventCounts(5, [], None))
    assert await again == (5, None)


@pytest_twisted.ensureDeferred
async def test_impossible_query_reads_no_rows(world: EventWorld, slow: Slow) -> None:
    ann = world.people["ann"]
    for robot in ("nosuch", "hidden", "x*"):
        ask = parse_query({"robot": robot}, 0.0)
        found, _, more = await world.service.page(ann, ask, 10)
        assert (found, more, await world.service.count(ann, ask)) == ([], None, (0, None))
        after = ask._replace(after=queries.EventCursor(1.0, 1))
        assert (await world.service.page(ann, after, 10))[2] is None
    assert slow.reads == []


@pytest_twisted.ensureDeferred
async def test_a_page_reads_a_bounded_number_of_rows_and_has_a_cursor(
    world: EventWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_SCANS", 2)
    monkeypatch.setattr(event_search, "MAX_SCANNED", 4)
    monkeypatch.setattr(event_search, "_SLICES", (1, 1, 4))
    ann, sizes, numbers = world.people["ann"], [], []
    await world.write("ann", *({"kind": "k", "data": {"n": n % 15}} for n in range(30)))
    ask = parse_query({"data.n": "0"}, 0.0)
    while True:
        found, _, place = await world.service.page(ann, ask, 5)
        sizes.append(len(found))
        numbers += [each.number for each in found]
        if place is None:
            break
        ask = ask._replace(after=place)
    assert (sizes, numbers) == ([0, 1, 0, 1], [16, 1])
    counts, place = [], None
    while not counts or place is not None:
        count, place = await world.service.count(ann, parse_query({"data.n": "0"}, 0.0)._replace(after=place))
        counts.append(count)
    assert counts == [0, 1, 0, 1]


@pytest_twisted.ensureDeferred
async def test_few_that_were_counted_are_used_wherever_they_were_found(
    world: EventWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A small count is shared between cursors and callers. Lower bounds and large counts are not shared."""
    monkeypatch.setattr(module, "MAX_SCANS", 4)
    monkeypatch.setattr(module, "MAX_COUNTED_AS_USED", 2)
    monkeypatch.setattr(event_search, "MAX_SCANNED", 4)
    await world.write(
        "ann", *({"kind": "k", "data": {"n": n, "of7": n % 7, "of8": n % 8}} for n in range(15))
    )
    ann = world.people["ann"]
    for query, count in (({"data.n": "4"}, 1), ({"data.of8": "0"}, 2), ({"data.of7": "0"}, 3), ({}, 15)):
        assert await world.service.count(ann, parse_query(query, 0.0)) == (count, None)
    monkeypatch.setattr(module, "MAX_SCANS", 2)
    assert (await world.service.count(ann, parse_query({"data.n": "13"}, 0.0)))[1] == queries.EventCursor(
        1000.0, 8
    )
    await world.quota.run_once()
    found, _, _ = await world.service.page(ann, parse_query({"kind": "k"}, 0.0), 20, uses=False)
    assert {each.number for each in found if each.use_count} == {1, 5, 9}


async def emptied(world: EventWorld) -> None:
    """The other realm is removed with its content, and created again."""
    with world.store.database.begin() as s:
        queries.remove_robot(s, 3)
        queries.remove_user(s, world.people["cleo"].user_id)
        queries.remove_realm(s, "lab")
        queries.add_realm(s, "lab")


@pytest_twisted.ensureDeferred
async def test_followers_of_a_removed_realm_get_nothing_from_a_new_one(world: EventWorld) -> None:
    await world.write("cleo", {"kind": "former"})
    await world.write("ann", {"kind": "here"})
    await emptied(world)
    world.recent.forget_realm("lab")
    assert await new_types(world, EventFollower(0), world.people["cleo"]) == []
    assert world.recent.since("default", 0) is not None


@pytest_twisted.ensureDeferred
async def test_events_of_a_removed_realm_do_not_count_for_a_new_one(world: EventWorld) -> None:
    cleo = world.people["cleo"]
    for each in range(50):
        await world.write("cleo", {"kind": "former", "source": f"s{each}"})
    await world.reads("cleo")
    await emptied(world)
    world.quota.forget_realm("lab")
    with world.store.database.begin() as s:
        fresh = [
            queries.NewStoredEvent("lab", 1000.0, f"n{each}", "fresh", None, None, "{}") for each in range(5)
        ]
        world.quota.on_written([each for each in queries.store_events(s, fresh) if each is not None])
    await world.quota.run_once()
    page = await world.service.page(cleo, EventQuery(), 100, uses=False)
    assert [(each.kind, each.use_count) for each in page[0]] == [("fresh", 0)] * 5
    world.quota.forget_realm("lab")
    world.time.now += 2000
    await world.quota.purge()
    assert (await world.service.page(cleo, EventQuery(), 100))[0] == []
