"""Who may write and read what of the memory, on a real database."""

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
from relay_server.events.collector import EventCollector
from relay_server.events.query import EventQuery, ask_of
from relay_server.events.quota import EventQuota
from relay_server.events.service import EventFollower, EventService, NewEvent, RecentEvents
from relay_server.events.writer import EventWriter
from relay_server.robots.registry import RobotRegistry
from tests.relay_server.memory import Time


class Room:
    """A memory: ann may use rover, bob hidden, root administers; cleo is of another realm, with a rover of her own."""

    def __init__(self, store: AsyncDatabase, time: Time) -> None:
        self.store, self.time = store, time
        self.access = Access(store, time)
        self.recent = RecentEvents(100)
        self.quota = EventQuota(Clock(), store, time, of_source=20, kept=1000.0, of_realm=50)
        self.writer = EventWriter(reactor, store, time, self._written)
        self.desk = EventService(store, self.access, self.writer, self.quota, self.recent, time)
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
            self.registry.presence(number, name, "default")
        self.noticing = EventCollector(self.writer, self.registry, time, lambda: time.now)

    def _written(self, events: list[queries.StoredEventRecord]) -> None:
        self.quota.written(events)
        self.recent.written(events)

    async def write(self, who: str, *events: dict[str, Any]) -> list[dict[str, Any]]:
        """Somebody writes."""
        new = [msgspec.json.decode(msgspec.json.encode(each), type=NewEvent) for each in events]
        return decoded(await self.desk.write(self.people[who], new))

    async def reads(self, who: str | Principal, **query: str) -> list[str]:
        """The kinds of what somebody reads, the newest first."""
        principal = self.people[who] if isinstance(who, str) else who
        ask = ask_of(query, self.time())
        found, forms, _ = await self.desk.page(principal, ask, ask.limit)
        assert await self.desk.count(principal, ask) == (len(found), None)
        return [each["kind"] for each in decoded([forms.json(each) for each in found])]


def decoded(told: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """As a client reads it."""
    found: list[dict[str, Any]] = msgspec.json.decode(msgspec.json.encode(told))
    return found


@pytest.fixture
def room(store: AsyncDatabase, time: Time) -> Iterator[Room]:
    """Nothing is remembered."""
    yield Room(store, time)


@pytest_twisted.ensureDeferred
async def test_an_event_comes_back_as_it_was_written(room: Room) -> None:
    """From whom it is, by default from the user; what it says, and when."""
    [told] = await room.write("ann", {"kind": "greeted", "robot": "rover", "data": {"who": "Bö", "n": [1]}})
    assert told == {
        "id": 1,
        "source": "ann",
        "kind": "greeted",
        "robot": "rover",
        "user": "ann",
        "at": 1000.0,
        "data": {"who": "Bö", "n": [1]},
        "used": 0,
    }
    found, forms, more = await room.desk.page(room.people["ann"], EventQuery(), 10)
    assert decoded([forms.json(each) for each in found]) == [told] and more is None


@pytest_twisted.ensureDeferred
async def test_who_sees_what(room: Room) -> None:
    """Of robots who has a right on them; what is about none, all of the realm, but for logins and the relay's own."""
    await room.write("ann", {"kind": "about-rover", "robot": "rover"}, {"kind": "for-all"})
    await room.write("bob", {"kind": "about-hidden", "robot": "hidden"}, {"kind": "login.odd"})
    await room.write("cleo", {"kind": "elsewhere"}, {"kind": "other-rover", "robot": "rover"})
    room.writer.drop("default")
    room.noticing.happened("login.refused", "relay", None, {"user": "x", "address": "192.0.2.1"})
    await room.writer.flush()
    assert await room.reads("ann") == ["for-all", "about-rover"]
    assert await room.reads("bob") == ["about-hidden", "for-all"]
    assert await room.reads("root") == ["events.dropped", "login.refused", "login.odd", "for-all"]
    assert await room.reads("root", source="relay") == ["login.refused"]
    assert await room.reads("cleo") == ["other-rover", "elsewhere"]
    assert await room.reads("cleo", robot="*") == ["other-rover"]
    assert await room.reads("ann", robot="hidden") == []
    assert await room.reads("ann", robot="r*") == ["about-rover"]
    narrow = room.people["ann"]
    elsewhere = Principal(narrow.user_id, "ann", "default", False, 1, None, Scope("viewer@elsewhere"))
    assert await room.reads(elsewhere) == ["for-all"]


@pytest_twisted.ensureDeferred
async def test_what_one_may_not_use_is_not_named(room: Room) -> None:
    """Neither told, nor found by its name; what a program says of it is."""
    room.noticing.happened("call.begun", "user:bob", room.robots["rover"], {"service": "/reset"})
    await room.writer.flush()
    await room.write("ann", {"kind": "x", "robot": "rover", "data": {"service": "/reset"}})
    wanted = {"data.service": "/reset"}
    assert await room.reads("ann") == ["x", "call.begun"]
    assert await room.reads("ann", **wanted) == []
    assert await room.reads("ann", source="ann", **wanted) == ["x"]
    with room.store.database.begin() as s:
        queries.grant_right(s, room.robots["rover"], "operator", user_id=room.people["ann"].user_id)
    await room.access.refresh()
    assert await room.reads("ann", **wanted) == ["x", "call.begun"]


@pytest_twisted.ensureDeferred
async def test_a_right_that_comes_or_goes_counts_at_once(room: Room) -> None:
    """For what was written before as well."""
    await room.write("ann", {"kind": "x", "robot": "rover"})
    assert await room.reads("bob") == []
    with room.store.database.begin() as s:
        queries.grant_right(s, room.robots["rover"], "viewer", user_id=room.people["bob"].user_id)
    await room.access.refresh()
    assert await room.reads("bob") == ["x"]


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
async def test_what_may_not_be_written_is_refused_with_all_that_came_with_it(room: Room) -> None:
    """Of a robot of another's nobody learns that it is there."""
    for event, error in WRONG:
        with pytest.raises(error) as caught:
            await room.write("ann", {"kind": "before"}, event)
        if error is NotFound:
            assert str(caught.value) == "there is no such robot, or you have no right on it"
    assert await room.reads("ann") == []


@pytest_twisted.ensureDeferred
async def test_as_much_as_fits_is_taken(room: Room) -> None:
    """4096 characters of data, a hundred events at once."""
    [told] = await room.write("ann", {"kind": "x", "data": {"a": "x" * (4096 - len('{"a":""}'))}})
    assert len(told["data"]["a"]) == 4088
    assert len(await room.write("ann", *({"kind": "x"} for _ in range(100)))) == 100
    for events in ([], [{"kind": "x"}] * 101):
        with pytest.raises(Invalid):
            await room.write("ann", *events)


@pytest_twisted.ensureDeferred
async def test_what_a_query_gives_or_counts_is_used(room: Room) -> None:
    """What is not on the page is not, nor are all of many that are counted; it shows a little later."""
    await room.write("ann", *({"kind": "x", "data": {"n": n}} for n in range(3)))
    ann = room.people["ann"]
    assert await room.desk.count(ann, ask_of({"data.n": "0"}, 0.0)) == (1, None)
    for _ in range(2):
        _, _, more = await room.desk.page(ann, EventQuery(), 2)
        assert more is not None
    await room.desk.page(ann, EventQuery(), 10, uses=False)
    await room.quota.look()
    found, _, _ = await room.desk.page(ann, EventQuery(), 10)
    assert [(each.number, each.used) for each in found] == [(3, 2), (2, 2), (1, 1)]
    for _ in range(2):
        await room.write("bob", *({"kind": "y"} for _ in range(60)))
    assert await room.desk.count(room.people["bob"], ask_of({"kind": "y"}, 0.0)) == (120, None)
    await room.quota.look()
    found, _, _ = await room.desk.page(room.people["bob"], ask_of({"kind": "y"}, 0.0), 200, uses=False)
    assert {each.used for each in found} == {0}


@pytest_twisted.ensureDeferred
async def test_a_source_has_no_more_than_its_share(room: Room) -> None:
    """Its least used and oldest go; other sources keep theirs, and so does the same one of another realm."""
    for _ in range(3):
        await room.write("ann", *({"kind": "x", "source": "busy"} for _ in range(10)))
        await room.desk.page(room.people["ann"], EventQuery(), 1)
    await room.write("ann", {"kind": "y", "source": "quiet"})
    await room.write("cleo", {"kind": "x", "source": "busy"})
    await room.quota.look()
    found, _, _ = await room.desk.page(room.people["ann"], ask_of({"source": "busy"}, 0.0), 100)
    # 10, 20 and 30 were given to somebody. Of the others the newest stay.
    assert [each.number for each in found] == [*range(30, 11, -1), 10]
    assert await room.reads("ann", source="quiet") == ["y"]
    assert await room.reads("cleo") == ["x"]


@pytest_twisted.ensureDeferred
async def test_a_realm_has_no_more_than_its_share_and_nothing_is_kept_for_ever(room: Room) -> None:
    """Many sources of few events are bounded together, the oldest go; what is old goes in any case."""
    for each in range(60):
        await room.write("ann", {"kind": f"k{each}", "source": f"s{each}"})
        room.time.now += 1
    await room.quota.look()
    assert await room.reads("ann") == [f"k{each}" for each in range(59, 9, -1)]
    room.time.now = 1000.0 + 1000.0 + 55.5
    await room.quota.purge()
    assert await room.reads("ann") == [f"k{each}" for each in range(59, 55, -1)]


@pytest_twisted.ensureDeferred
async def test_a_realm_may_keep_events_for_a_time_of_its_own(room: Room) -> None:
    """Shorter or longer than the relay does; of the other realm nothing goes sooner or later."""
    await room.write("ann", {"kind": "here"})
    await room.write("cleo", {"kind": "there"})
    with room.store.database.begin() as s:
        queries.keep_events(s, "lab", 5000 / 86400)
    room.time.now += 4000
    await room.quota.purge()
    assert (await room.reads("ann"), await room.reads("cleo")) == ([], ["there"])
    with room.store.database.begin() as s:
        queries.keep_events(s, "lab", 1000 / 86400)
    await room.write("ann", {"kind": "later"})
    await room.quota.purge()
    assert (await room.reads("ann"), await room.reads("cleo")) == (["later"], [])


@pytest_twisted.ensureDeferred
async def test_who_follows_hears_what_is_new_and_his_to_see(room: Room) -> None:
    """Woken when it is safe; from an event on that he names, from the database where memory does not reach."""
    ann = room.people["ann"]
    await room.write("ann", {"kind": "a"}, {"kind": "b"})
    begun = await room.desk.follow_from(ann, None)
    again = await room.desk.follow_from(ann, 1)
    assert (begun.number, (await room.desk.follow_from(ann, 99)).number) == (2, 2)
    async with room.desk.following(begun) as following:
        waiting = Deferred.fromCoroutine(following.news())
        assert not waiting.called
        await room.write("bob", {"kind": "secret", "robot": "hidden"}, {"kind": "c"})
        await waiting
        assert await heard(room, following, ann) == ["c"]
        assert await heard(room, following, ann) == []
    assert await heard(room, again, ann) == ["b", "c"]
    room.recent = room.desk._recent = RecentEvents(2)
    assert await heard(room, EventFollower(0), ann) == ["a", "b", "c"]
    await room.write("ann", *({"kind": "d"} for _ in range(5)))
    assert await heard(room, EventFollower(1), ann) == ["b", "c", *"ddddd"]
    assert await heard(room, EventFollower(7), ann, kind="e") == []


async def heard(room: Room, following: EventFollower, who: Principal, **query: str) -> list[str]:
    """The kinds of what is new."""
    events, _, _ = await room.desk.news(who, ask_of(query, 0.0), following)
    return [each.kind for each in events]


@pytest_twisted.ensureDeferred
async def test_a_program_writes_under_its_own_name(room: Room) -> None:
    """And as its user, where nobody has named it."""
    ann = room.people["ann"]
    with room.store.database.begin() as s:
        for token, label in ((31, "greeting"), (32, "")):
            queries.add_program(s, ann.user_id, f"key{token}", "0" * 64, scope=None, label=label, now=1.0)
        numbers = [each.id for each in queries.list_programs(s, ann.user_id)]
        tokens = [
            queries.create_token(
                s, ann.user_id, f"{at}" * 64, kind="access", expires=None, now=1.0, program_id=number
            )
            for at, number in enumerate(numbers)
        ]
    sources = []
    for token in tokens:
        by = Principal(ann.user_id, "ann", "default", False, token, None)
        for _ in range(2):
            [told] = await room.desk.write(by, [NewEvent("x")])
            sources.append((told["source"], told["user"]))
    assert sources == [("greeting", "ann")] * 2 + [("ann", "ann")] * 2


QUERIES: list[dict[str, str]] = [
    {}, {"source": "a*"}, {"kind": "k1"}, {"robot": "rover"}, {"robot": "h*"}, {"user": "bob"}, {"data.n": "1"},
    {"data.n": "true"}, {"data.deep": "1"}, {"since": "1001"}, {"until": "1001", "kind": "k*"},
]  # fmt: skip


@pytest_twisted.ensureDeferred
async def test_the_stream_and_the_database_see_the_same(room: Room) -> None:
    """What follows is judged in one place, what is asked for in another."""
    await room.write(
        "ann", {"kind": "k1", "data": {"n": 1}}, {"kind": "k2", "robot": "rover", "data": {"n": "1"}}
    )
    room.time.now += 1
    await room.write(
        "bob", {"kind": "login", "data": {"n": True}}, {"kind": "k1", "robot": "hidden", "source": "a"}
    )
    await room.write("bob", {"kind": "k11", "source": "abc", "data": {"in": {"deep": 1}, "n": 11}})
    room.noticing.happened("login.refused", "relay", None, {})
    await room.writer.flush()
    for query in QUERIES:
        for who in ("ann", "bob", "root", "cleo"):
            asked = await room.reads(who, **query)
            assert await heard(room, EventFollower(0), room.people[who], **query) == asked[::-1], (who, query)


class Slow:
    """A database whose thread goes on until the test says that it is done, whoever waits for it."""

    def __init__(self) -> None:
        self.reads: list[Deferred[Any]] = []

    async def read(self, query: Any, *args: Any) -> Any:
        """One more is under way."""
        self.reads.append(Deferred())
        return await self.reads[-1]


@pytest.fixture
def slow(room: Room) -> Slow:
    """What events are asked of; rights are not."""
    made: Any = Slow()
    room.desk._store = made
    return made


async def counting(room: Room, who: str) -> Deferred[Any]:
    """Somebody asks how many events there are."""
    await room.access.robots(room.people[who])
    return Deferred.fromCoroutine(room.desk.count(room.people[who], EventQuery()))


@pytest_twisted.ensureDeferred
async def test_who_leaves_does_not_make_room_for_another_read_while_his_goes_on(
    room: Room, slow: Slow, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever waits and leaves is not asked for; the next has his turn when the thread is done."""
    monkeypatch.setattr(module, "ASKED", 3)
    first, second, third = [await counting(room, who) for who in ("ann", "bob", "root")]
    for each in (first, second):
        each.addErrback(lambda failure: None)
        each.cancel()
    assert len(slow.reads) == 1 and not slow.reads[0].called
    await counting(room, "bob")
    with pytest.raises(Unavailable):
        await (await counting(room, "cleo"))
    slow.reads[0].callback(StoredEventCounts(1, [1], None))
    assert len(slow.reads) == 2
    slow.reads[1].callback(StoredEventCounts(7, [], None))
    assert await third == (7, None)
    assert len(slow.reads) == 3


@pytest_twisted.ensureDeferred
async def test_a_read_that_fails_is_not_the_end_of_reading(room: Room, slow: Slow) -> None:
    """Its asker hears of it, and the next has his turn."""
    first, second = await counting(room, "ann"), await counting(room, "bob")
    slow.reads[0].errback(Unavailable("locked"))
    with pytest.raises(Unavailable, match="locked"):
        await first
    slow.reads[1].callback(StoredEventCounts(1, [1], None))
    assert await second == (1, None)


@pytest_twisted.ensureDeferred
async def test_nobody_takes_the_places_of_all(
    room: Room, slow: Slow, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A user has his share of those that wait, and gets his places back."""
    monkeypatch.setattr(module, "ASKED_EACH", 2)
    mine = [await counting(room, "ann") for _ in range(2)]
    with pytest.raises(Unavailable, match="more than 2"):
        await (await counting(room, "ann"))
    other = await counting(room, "bob")
    for at in range(3):
        slow.reads[at].callback(StoredEventCounts(at, [], None))
    assert [(await each)[0] for each in (*mine, other)] == [0, 1, 2]
    again = await counting(room, "ann")
    slow.reads[3].callback(StoredEventCounts(5, [], None))
    assert await again == (5, None)


@pytest_twisted.ensureDeferred
async def test_where_nothing_can_be_seen_nobody_looks(room: Room, slow: Slow) -> None:
    """Of a robot that there is not, or on which he has no right."""
    ann = room.people["ann"]
    for robot in ("nosuch", "hidden", "x*"):
        ask = ask_of({"robot": robot}, 0.0)
        found, _, more = await room.desk.page(ann, ask, 10)
        assert (found, more, await room.desk.count(ann, ask)) == ([], None, (0, None))
        after = ask._replace(after=queries.EventCursor(1.0, 1))
        assert (await room.desk.page(ann, after, 10))[2] is None
    assert slow.reads == []


@pytest_twisted.ensureDeferred
async def test_a_page_looks_at_so_much_and_says_where_the_next_one_begins(
    room: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where it found nothing yet; by and by all is found, and counted."""
    monkeypatch.setattr(module, "LOOKS", 2)
    monkeypatch.setattr(event_search, "LOOKED_AT", 4)
    monkeypatch.setattr(event_search, "_SLICES", (1, 1, 4))
    ann, sizes, numbers = room.people["ann"], [], []
    await room.write("ann", *({"kind": "k", "data": {"n": n % 15}} for n in range(30)))
    ask = ask_of({"data.n": "0"}, 0.0)
    while True:
        found, _, place = await room.desk.page(ann, ask, 5)
        sizes.append(len(found))
        numbers += [each.number for each in found]
        if place is None:
            break
        ask = ask._replace(after=place)
    assert (sizes, numbers) == ([0, 1, 0, 1], [16, 1])
    counts, place = [], None
    while not counts or place is not None:
        count, place = await room.desk.count(ann, ask_of({"data.n": "0"}, 0.0)._replace(after=place))
        counts.append(count)
    assert counts == [0, 1, 0, 1]


@pytest_twisted.ensureDeferred
async def test_few_that_were_counted_are_used_wherever_they_were_found(
    room: Room, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Behind the first look, too, and by several; not where there may be more, nor where they are too many."""
    monkeypatch.setattr(module, "LOOKS", 4)
    monkeypatch.setattr(module, "COUNTED_USED", 2)
    monkeypatch.setattr(event_search, "LOOKED_AT", 4)
    await room.write("ann", *({"kind": "k", "data": {"n": n, "of7": n % 7, "of8": n % 8}} for n in range(15)))
    ann = room.people["ann"]
    for query, count in (({"data.n": "4"}, 1), ({"data.of8": "0"}, 2), ({"data.of7": "0"}, 3), ({}, 15)):
        assert await room.desk.count(ann, ask_of(query, 0.0)) == (count, None)
    monkeypatch.setattr(module, "LOOKS", 2)
    assert (await room.desk.count(ann, ask_of({"data.n": "13"}, 0.0)))[1] == queries.EventCursor(1000.0, 8)
    await room.quota.look()
    found, _, _ = await room.desk.page(ann, ask_of({"kind": "k"}, 0.0), 20, uses=False)
    assert {each.number for each in found if each.used} == {1, 5, 9}


async def emptied(room: Room) -> None:
    """The other realm is removed, with all that was in it, and made anew."""
    with room.store.database.begin() as s:
        queries.remove_robot(s, 3)
        queries.remove_user(s, room.people["cleo"].user_id)
        queries.remove_realm(s, "lab")
        queries.add_realm(s, "lab")


@pytest_twisted.ensureDeferred
async def test_of_a_realm_that_is_gone_no_follower_hears_in_one_of_its_name(room: Room) -> None:
    """What happened in it is forgotten, and other realms' events are not."""
    await room.write("cleo", {"kind": "former"})
    await room.write("ann", {"kind": "here"})
    await emptied(room)
    room.recent.forget("lab")
    assert await heard(room, EventFollower(0), room.people["cleo"]) == []
    assert room.recent.since("default", 0) is not None


@pytest_twisted.ensureDeferred
async def test_a_realm_that_is_gone_counts_for_none_of_its_name(room: Room) -> None:
    """Neither how much it held, nor what of it was used; the new one's events grow old all the same."""
    cleo = room.people["cleo"]
    for each in range(50):
        await room.write("cleo", {"kind": "former", "source": f"s{each}"})
    await room.reads("cleo")
    await emptied(room)
    room.quota.forget("lab")
    with room.store.database.begin() as s:
        fresh = [
            queries.NewStoredEvent("lab", 1000.0, f"n{each}", "fresh", None, None, "{}") for each in range(5)
        ]
        room.quota.written([each for each in queries.remember(s, fresh) if each is not None])
    await room.quota.look()
    page = await room.desk.page(cleo, EventQuery(), 100, uses=False)
    assert [(each.kind, each.used) for each in page[0]] == [("fresh", 0)] * 5
    room.quota.forget("lab")
    room.time.now += 2000
    await room.quota.purge()
    assert (await room.desk.page(cleo, EventQuery(), 100))[0] == []
