"""Recordings as users have them, on a real database and real files."""

from __future__ import annotations

import errno
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import CancelledError, Deferred, DeferredLock

from relay_db import queries
from relay_db.queries import RobotRecord
from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable
from relay_protocol.realms import DEFAULT_REALM
from relay_server.access import NO_ROBOT, Access, Principal
from relay_server.common.database import AsyncDatabase
from relay_server.events.bus import EventBus
from relay_server.recordings import recordings as module
from relay_server.recordings.library import NO_ROOM_NOW, Library, RecordingEntry
from relay_server.recordings.mcap_file import McapFile
from relay_server.recordings.recordings import (
    FINISH_SECONDS,
    THREADS,
    USER_RECORDINGS,
    WAITING,
    RecordingRequest,
    Recordings,
)
from relay_server.recordings.repair import PAUSE_SECONDS
from relay_server.recordings.rights import why_denied
from relay_server.recordings.service import FETCH_SECONDS, RecordingService
from relay_server.recordings.writer import RecordingWriter
from relay_server.sessions.manager import AuthorizedSession
from tests.relay_server.edges.robot_ends import until
from tests.relay_server.memory import World, text
from tests.relay_server.recording.reading import read

HERE = "192.0.2.1"
CHATTER = RecordingRequest(topics=["chatter"], megabytes=1)
ROVER = RobotRecord(1, "rover", "default", "")


class Doors:
    """Lets in who has a right; of the front desk no more is needed."""

    def __init__(self, store: AsyncDatabase, access: Access, world: World) -> None:
        self._store = store
        self._access = access
        self._world = world
        self.inside = 0

    async def admit(self, principal: Principal, robot: str, address: str) -> AuthorizedSession:
        """Somebody who has a right on the robot."""
        record = await self._store.read(queries.find_robot, robot, principal.realm)
        permit = None if record is None else await self._access.permit(principal, record)
        if permit is None:
            raise NotFound(NO_ROBOT)
        self.inside += 1
        return AuthorizedSession(permit, self._world.robot, address)

    def turn_away(self, admission: AuthorizedSession) -> None:
        """He leaves."""
        self.inside -= 1
        self._access.release(admission.permit)


class Desk:
    """A desk, and what it is made of."""

    def __init__(self, store: AsyncDatabase, folder: Path) -> None:
        self.store = store
        self.folder = folder
        self.world = World()
        self.access = Access(store, self.wall)
        self.doors = Doors(store, self.access, self.world)
        self.recordings = self.begins()
        self.journal = EventBus(store, self.wall)
        # Doors are all of a front desk that it needs.
        self.desk = RecordingService(self.doors, self.recordings, store, self.journal, self.wall)  # type: ignore[arg-type]
        with store.database.begin() as session:
            self._robot = queries.add_robot(session, "rover").id
        self.ann, self.bob, self.eve = (self._principal(name) for name in ("ann", "bob", "eve"))

    def begins(self) -> Recordings:
        """A relay that starts on the folder."""
        library = Library(self.folder, 5 * 10**6)
        world = self.world
        made = Recordings(reactor, world.clock, library, world.channels, world.videos, self.wall)
        made.open()
        made.recover()
        return made

    def wall(self) -> float:
        """Unix time."""
        return 1000.0 + self.world.clock.seconds()

    def others(self, limit: int) -> RecordingEntry:
        """A recording of another realm, that runs."""
        entry = RecordingEntry("z", 99, "rover", 99, "zoe", ("/odom",), (), 1.0, limit, 60.0, realm="lab1")
        self.recordings.library.add(entry)
        return entry

    def moves(self, realm: str, name: str) -> Principal:
        """The robot at work is one of another realm from now on, where somebody may record it."""
        with self.store.database.begin() as session:
            queries.add_realm(session, realm)
            self._robot = queries.add_robot(session, "rover", realm=realm).id
        self.world.robot.realm = realm
        return self._principal(name, realm)

    def _principal(self, name: str, realm: str = DEFAULT_REALM) -> Principal:
        with self.store.database.begin() as session:
            user = queries.add_user(session, name, None, realm=realm)
            token = queries.create_token(
                session, user.id, name.encode().hex().ljust(64, "0"), kind="access", expires=None, now=1000.0
            )
            level = "viewer" if name == "eve" else "operator"
            queries.grant_right(session, self._robot, level, user_id=user.id)
        return Principal(user.id, name, user.realm, False, token, None)

    async def revoke(self, name: str) -> None:
        """A right is gone."""
        who = {"ann": self.ann, "bob": self.bob}[name]
        await self.store.write(queries.revoke_right, self._robot, user_id=who.user_id)
        await self.access.refresh()

    async def deny(self, name: str, *patterns: str) -> None:
        """An operator's right is narrowed."""
        who = {"ann": self.ann, "bob": self.bob}[name]
        await self.store.write(
            queries.grant_right, self._robot, "operator", user_id=who.user_id, deny=list(patterns)
        )
        await self.access.refresh()

    def says(self, *words: str) -> None:
        """The robot, which is at work, says something."""
        number = self.world.link.all(link.Subscribe)[-1].number
        self.world.subscribed(number)
        self.world.define()
        for stamp, word in enumerate(words):
            self.world.channel.sample(number, text(word), stamp + 1)

    def shows_pictures(self) -> None:
        """The robot tells that its topic carries pictures now."""
        image = link.Topic(types=["sensor_msgs/msg/Image"], publishers=["/eye"])
        self.world.registry.graph(self.world.robot, link.Graph(topics={"/chatter": image}))

    async def recorded(self, who: Principal, *words: str) -> dict[str, Any]:
        """A recording that is finished."""
        begun = await self.desk.start(who, "rover", CHATTER, HERE)
        self.says(*words)
        return await self.desk.stop(who, "rover", begun["id"], HERE)

    async def all(self, who: Principal) -> list[dict[str, Any]]:
        """What is listed, when it is few."""
        page = await self.desk.all(who, "rover", HERE)
        assert page["next"] is None
        return list(page["recordings"])

    def breaks(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The disk fails when the next file is finished."""

        def fails(file: McapFile) -> None:
            monkeypatch.undo()
            file.flush()
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(McapFile, "finish", fails)

    async def fetch(self, who: Principal, id: str) -> bytes:
        """The file."""
        file = await self.desk.download(who, "rover", id, HERE)
        try:
            await file.begin()
            return await file.part(0, file.size + 1)
        finally:
            file.close()

    async def audit(self) -> list[tuple[str, str, str]]:
        """Who did what from where, the oldest first."""
        entries = await self.store.read(queries.list_audit)
        return [(each.actor, each.action, each.origin) for each in reversed(entries)]


@pytest.fixture
def desk(store: AsyncDatabase, tmp_path: Path) -> Iterator[Desk]:
    """A desk, and a robot that is at work."""
    made = Desk(store, tmp_path / "recordings")
    made.world.at_work()
    yield made
    pytest_twisted.blockon(Deferred.fromCoroutine(made.recordings.shut("the test is over")))
    made.recordings.close()


async def failure(work: Any, kind: type[SwitchboardError]) -> str:
    """How something fails, in words."""
    with pytest.raises(kind) as caught:
        await work
    return str(caught.value)


@pytest_twisted.ensureDeferred
async def test_a_recording_is_begun_looked_at_stopped_and_fetched(desk: Desk, tmp_path: Path) -> None:
    """The file holds what was said meanwhile; nobody stays inside."""
    begun = await desk.desk.start(desk.ann, "rover", CHATTER, HERE)
    assert (begun["state"], begun["topics"], begun["megabytes"]) == ("recording", ("/chatter",), 1.0)
    assert "robot_id" not in begun
    desk.world.clock.advance(2)
    assert (await desk.desk.one(desk.ann, "rover", begun["id"], HERE))["lasted"] == 2.0
    desk.says("a", "b")
    assert "still being recorded" in await failure(
        desk.desk.download(desk.ann, "rover", begun["id"], HERE), Unavailable
    )
    done = await desk.desk.stop(desk.ann, "rover", begun["id"], HERE)
    desk.world.clock.advance(1)
    assert done["lasted"] == 2.0
    assert (done["state"], done["messages"], done["drops"]) == ("complete", 2, 0)
    assert done["reason"] == "stopped by ann"
    path = tmp_path / "copy.mcap"
    path.write_bytes(await desk.fetch(desk.bob, begun["id"]))
    assert [each.body for each in read(path)] == [text("a"), text("b")]
    assert path.stat().st_size == done["bytes"]
    assert await desk.all(desk.bob) == [done]
    assert await desk.desk.one(desk.ann, "rover", begun["id"], HERE) == done
    assert desk.doors.inside == 0


@pytest_twisted.ensureDeferred
async def test_who_does_what_is_on_record(desk: Desk) -> None:
    """In the audit before it is done; what becomes of it in the journal."""
    done = await desk.recorded(desk.ann, "a")
    await desk.fetch(desk.bob, done["id"])
    await desk.desk.delete(desk.ann, "rover", done["id"], HERE)
    assert await desk.audit() == [
        ("user:ann", "recording.start", HERE),
        ("user:bob", "recording.download", HERE),
        ("user:ann", "recording.delete", HERE),
    ]
    kinds = [each.kind for each in await desk.store.read(queries.list_events)]
    assert kinds == ["recording.ended", "recording.started"]
    assert list(desk.folder.iterdir()) == []
    assert await desk.all(desk.ann) == []


@pytest_twisted.ensureDeferred
async def test_a_download_in_parts_is_on_record_once(desk: Desk) -> None:
    """Of each who has it; after a while again."""
    done = await desk.recorded(desk.ann, "a")
    for who in (desk.ann, desk.bob, desk.ann, desk.bob):
        await desk.fetch(who, done["id"])
    fetched = [actor for actor, action, _ in await desk.audit() if action == "recording.download"]
    assert fetched == ["user:ann", "user:bob"]
    desk.world.clock.advance(FETCH_SECONDS)
    await desk.fetch(desk.ann, done["id"])
    assert (await desk.audit())[-1][:2] == ("user:ann", "recording.download")
    assert len(await desk.audit()) == 4


@pytest_twisted.ensureDeferred
async def test_who_may_not_see_or_record_it_does_not_find_it(desk: Desk) -> None:
    """A viewer can't get by the file at what he may not record; nor can a stranger."""
    done = await desk.recorded(desk.ann, "a")
    assert "needs the level operator" in await failure(
        desk.desk.start(desk.eve, "rover", CHATTER, HERE), Refused
    )
    assert await desk.all(desk.eve) == []
    for ask in (desk.desk.one, desk.desk.stop, desk.desk.delete, desk.desk.download):
        assert "no such recording" in await failure(ask(desk.eve, "rover", done["id"], HERE), NotFound)
        assert await failure(ask(desk.ann, "tank", done["id"], HERE), NotFound) == NO_ROBOT
    assert desk.doors.inside == 0


@pytest_twisted.ensureDeferred
async def test_what_could_be_recorded_is_told(desk: Desk) -> None:
    """To each what is his, with the room there is; to who may record nothing, why."""
    desk.world.robot.cameras = (link.Camera(name="/camera", type="sensor_msgs/msg/Image"),)
    found = await desk.desk.possible(desk.ann, "rover", HERE)
    assert found == {
        "topics": sorted(desk.world.robot.graph.topics),
        "cameras": ["/camera"],
        "denied": "",
        "megabytes": 5.0,
        "left": 5.0,
        "full": "",
    }
    assert "/chatter" in found["topics"]
    await desk.recorded(desk.ann, "a")
    await desk.desk.start(desk.ann, "rover", CHATTER, HERE)
    assert 3.9 < (await desk.desk.possible(desk.ann, "rover", HERE))["left"] < 4
    none = await desk.desk.possible(desk.eve, "rover", HERE)
    assert (none["topics"], none["cameras"]) == ([], [])
    assert "needs the level operator" in none["denied"]


@pytest_twisted.ensureDeferred
async def test_pictures_are_not_to_be_had_by_recording_their_topic(desk: Desk) -> None:
    """Nor is the file, for who may not view them; also after the topic has gone, and after a restart."""
    image = link.Topic(types=["sensor_msgs/msg/CompressedImage"], publishers=["/eye"])
    desk.world.registry.graph(desk.world.robot, link.Graph(topics={"/eye/compressed": image}))
    wanted = RecordingRequest(topics=["/eye/compressed"], megabytes=1)
    done = await desk.desk.start(desk.bob, "rover", wanted, HERE)
    await desk.desk.stop(desk.bob, "rover", done["id"], HERE)
    await desk.deny("ann", "view:/eye/*")
    assert "view on /eye/compressed is denied" in await failure(
        desk.desk.start(desk.ann, "rover", wanted, HERE), Refused
    )
    assert "/eye/compressed" not in (await desk.desk.possible(desk.ann, "rover", HERE))["topics"]
    assert "/eye/compressed" in (await desk.desk.possible(desk.bob, "rover", HERE))["topics"]
    desk.world.robot_goes()
    desk.recordings.library.open()
    assert await desk.all(desk.ann) == []
    await failure(desk.desk.download(desk.ann, "rover", done["id"], HERE), NotFound)
    assert [each["id"] for each in await desk.all(desk.bob)] == [done["id"]]


@pytest_twisted.ensureDeferred
async def test_a_topic_that_begins_to_carry_pictures_does_so_after_a_crash(desk: Desk) -> None:
    """It is on the disk at once, so that who may not view them does not get what is recovered."""
    begun = await desk.desk.start(desk.bob, "rover", CHATTER, HERE)
    desk.shows_pictures()
    async with desk.recordings._saving.setdefault(begun["id"], DeferredLock()):
        # What was being saved has been.
        found = Library(desk.folder, 10**6)
        found.open()
    (entry,) = found.of(1)
    assert (entry.state.value, entry.pictures) == ("incomplete", ("/chatter",))
    await desk.deny("ann", "view:/chatter")
    permit = await desk.access.permit(desk.ann, ROVER)
    assert permit is not None
    assert "view on /chatter is denied" in why_denied(permit, entry)
    done = await desk.desk.stop(desk.bob, "rover", begun["id"], HERE)
    assert (done["state"], done["problems"]) == ("complete", [])


@pytest_twisted.ensureDeferred
async def test_a_recording_is_put_on_record_by_one_thread_at_a_time(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may end while it is being saved: what is on the disk then is how it ended."""
    begun = await desk.desk.start(desk.bob, "rover", CHATTER, HERE)
    library = desk.recordings.library
    save, go_on, texts = library.save, threading.Event(), list[bytes]()

    def slowly(id: str, body: bytes) -> None:
        texts.append(body)
        go_on.wait(10)
        save(id, body)

    monkeypatch.setattr(library, "save", slowly)
    desk.shows_pictures()
    stopped = Deferred.fromCoroutine(desk.desk.stop(desk.bob, "rover", begun["id"], HERE))
    await until(lambda: library.find(1, begun["id"]).state.value == "complete")
    assert desk.recordings._threads._under_way == 1
    go_on.set()
    await stopped
    again = Library(desk.folder, 10**6)
    again.open()
    (entry,) = again.of(1)
    assert (len(texts), entry.state.value, entry.pictures) == (2, "complete", ("/chatter",))


@pytest_twisted.ensureDeferred
async def test_only_its_maker_or_an_owner_stops_and_deletes_it(desk: Desk) -> None:
    """Others with the right to record may have the file."""
    done = await desk.recorded(desk.ann, "a")
    for ask in (desk.desk.stop, desk.desk.delete):
        assert "a recording of ann" in await failure(ask(desk.bob, "rover", done["id"], HERE), Refused)


@pytest_twisted.ensureDeferred
async def test_a_right_that_is_revoked_ends_recording_and_download(desk: Desk) -> None:
    """The file is whole."""
    await desk.desk.start(desk.ann, "rover", CHATTER, HERE)
    desk.says("a")
    done = await desk.recorded(desk.bob, "b")
    download = await desk.desk.download(desk.ann, "rover", done["id"], HERE)
    denied: list[str] = []
    download.watch(denied.append)
    await desk.revoke("ann")
    assert denied == ["your right on this robot was revoked"]
    download.close()
    await desk.recordings.shut("over")
    (found,) = [each for each in await desk.all(desk.bob) if each["user"] == "ann"]
    assert (found["state"], found["reason"]) == ("complete", "your right on this robot was revoked")
    assert desk.doors.inside == 0


@pytest_twisted.ensureDeferred
async def test_names_without_slash_are_taken_as_if_they_had_one(desk: Desk) -> None:
    """Those of cameras like those of topics; what is named in both ways is recorded once."""
    ask = RecordingRequest(topics=["chatter", "/chatter"], cameras=["camera", "/camera"], megabytes=1)
    begun = await desk.desk.start(desk.ann, "rover", ask, HERE)
    assert (begun["topics"], begun["cameras"]) == (("/chatter",), ("/camera",))
    await desk.desk.stop(desk.ann, "rover", begun["id"], HERE)


@pytest_twisted.ensureDeferred
async def test_what_can_not_be_recorded_leaves_nothing(desk: Desk) -> None:
    """No file, no place taken, nobody inside."""
    for ask in (
        RecordingRequest(),
        RecordingRequest(topics=["no name"]),
        RecordingRequest(topics=["/camera/compressed"], cameras=["/camera"]),
        RecordingRequest(topics=["/camera/compressed"], cameras=["camera"]),
        RecordingRequest(cameras=["/"]),
        RecordingRequest(cameras=["a\nb"]),
        RecordingRequest(topics=["/nowhere"], megabytes=1),
    ):
        await failure(desk.desk.start(desk.ann, "rover", ask, HERE), Invalid)
    assert list(desk.folder.iterdir()) == []
    assert desk.recordings.library.used == 0
    assert desk.doors.inside == 0


@pytest_twisted.ensureDeferred
async def test_no_more_is_recorded_than_there_is_room_for(desk: Desk) -> None:
    """By the size of all together, and by how many run for one user."""
    assert "of which 5 MB are left" in await failure(
        desk.desk.start(desk.ann, "rover", RecordingRequest(topics=["/chatter"], megabytes=6), HERE),
        Unavailable,
    )
    for _ in range(USER_RECORDINGS):
        await desk.desk.start(desk.ann, "rover", CHATTER, HERE)
    assert "recordings running" in await failure(
        desk.desk.start(desk.ann, "rover", CHATTER, HERE), Unavailable
    )
    await desk.desk.start(desk.bob, "rover", CHATTER, HERE)


@pytest_twisted.ensureDeferred
async def test_what_other_realms_record_is_told_nobody(desk: Desk) -> None:
    """Neither how much room is left, nor how many run: only that there is no room, where they take it."""
    desk.others(limit=4 * 10**6 + 1)
    assert (await desk.desk.possible(desk.ann, "rover", HERE))["left"] == 5.0
    assert (await desk.desk.possible(desk.ann, "rover", HERE))["full"] == NO_ROOM_NOW
    assert await failure(desk.desk.start(desk.ann, "rover", CHATTER, HERE), Unavailable) == NO_ROOM_NOW
    assert desk.doors.inside == 0


@pytest_twisted.ensureDeferred
async def test_how_many_others_run_is_told_nobody(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who runs them himself is told the most there may be."""
    monkeypatch.setattr(module, "RECORDINGS", 2)
    other = desk.others(limit=1)
    desk.recordings._starting[other.id] = other
    await desk.desk.start(desk.ann, "rover", CHATTER, HERE)
    assert await failure(desk.desk.start(desk.bob, "rover", CHATTER, HERE), Unavailable) == NO_ROOM_NOW
    del desk.recordings._starting[other.id]
    await desk.desk.start(desk.ann, "rover", CHATTER, HERE)
    assert "2 recordings run, the most there may be" in await failure(
        desk.desk.start(desk.bob, "rover", CHATTER, HERE), Unavailable
    )


@pytest_twisted.ensureDeferred
async def test_a_recording_is_of_the_realm_of_its_robot(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its file says so; who looks at it is told nothing of realms, and the journal counts it by the full name."""
    causes: list[str] = []
    event = desk.journal.event

    def noted(kind: str, source: str, *, cause: str, **more: Any) -> bool:
        causes.append(cause)
        return event(kind, source, cause=cause, **more)

    monkeypatch.setattr(desk.journal, "event", noted)
    zoe = desk.moves("lab1", "zoe")
    done = await desk.recorded(zoe, "a")
    (entry,) = desk.recordings.library
    assert (entry.realm, "realm" in done) == ("lab1", False)
    assert b'"realm":"lab1"' in (desk.folder / f"{entry.id}.json").read_bytes()
    assert causes == ["user:zoe@lab1", "user:zoe@lab1"]
    assert [each.target for each in await desk.store.read(queries.list_audit)] == [f"rover@lab1/{entry.id}"]


@pytest_twisted.ensureDeferred
async def test_what_a_killed_relay_left_is_made_readable(desk: Desk) -> None:
    """At the next start; a recording whose file had not begun is forgotten."""
    done = await desk.recorded(desk.ann, "a", "b")
    other = await desk.recorded(desk.ann, "c")
    for each in (done, other):
        file = desk.folder / f"{each['id']}.json"
        file.write_bytes(file.read_bytes().replace(b'"complete"', b'"recording"'))
    path = desk.folder / f"{done['id']}.mcap"
    path.write_bytes(path.read_bytes()[:-50])
    (desk.folder / f"{other['id']}.mcap").unlink()
    again = desk.begins()
    await again.mended
    (found,) = again.library.of(1)
    assert (found.state.value, found.messages, found.ended is not None) == ("recovered", 2, True)
    assert [each.body for each in read(path)] == [text("a"), text("b")]
    again.close()


@pytest_twisted.ensureDeferred
async def test_what_breaks_off_is_mended_by_the_same_relay(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a while; until then it counts for what it takes of the disk."""
    desk.breaks(monkeypatch)
    broken = await desk.recorded(desk.ann, "a", "b")
    assert (broken["state"], broken["reason"]) == ("incomplete", "stopped by ann")
    size = (desk.folder / f"{broken['id']}.mcap").stat().st_size
    assert desk.recordings.library.used == broken["bytes"] == size > 0
    assert "not recovered yet" in await failure(
        desk.desk.download(desk.ann, "rover", broken["id"], HERE), Unavailable
    )
    desk.world.clock.advance(PAUSE_SECONDS)
    async with desk.recordings._mender._one_at_a_time:
        # What was tried after the pause has been.
        pass
    found = await desk.desk.one(desk.ann, "rover", broken["id"], HERE)
    assert (found["state"], found["messages"]) == ("recovered", 2)
    (desk.folder / "copy").write_bytes(await desk.fetch(desk.ann, broken["id"]))
    assert [each.body for each in read(desk.folder / "copy")] == [text("a"), text("b")]


@pytest_twisted.ensureDeferred
async def test_a_disk_that_is_nearly_full_takes_no_recording(desk: Desk) -> None:
    """Who asks is told why, also before he asks for one; what runs is whole."""
    begun = await desk.desk.start(desk.ann, "rover", CHATTER, HERE)
    ended: Deferred[None] = Deferred()
    desk.recordings._ended[begun["id"]].append(lambda entry: ended.callback(None))
    desk.says("a")
    desk.recordings.library.reserve = 2**62
    await ended
    done = await desk.desk.one(desk.ann, "rover", begun["id"], HERE)
    assert (done["state"], done["reason"], done["messages"]) == ("complete", "the disk is nearly full", 1)
    words = await failure(desk.desk.start(desk.ann, "rover", CHATTER, HERE), Unavailable)
    assert "the disk is nearly full" in words and "delete some recordings" in words
    assert (await desk.desk.possible(desk.ann, "rover", HERE))["full"] == words
    assert [each["id"] for each in await desk.all(desk.ann)] == [begun["id"]]
    assert desk.doors.inside == 0


@pytest_twisted.ensureDeferred
async def test_asking_for_many_at_once_is_no_way_around_the_limits(desk: Desk) -> None:
    """What is about to begin counts."""
    permit = await desk.access.permit(desk.ann, ROVER)
    assert permit is not None
    robot, ends = desk.world.robot, list[str]()
    asked = [desk.recordings.entry(CHATTER, robot, permit) for _ in range(5)]
    begun = [
        Deferred.fromCoroutine(
            desk.recordings.start(each, robot, permit, lambda entry: ends.append(entry.id))
        ).addErrback(lambda failure: str(failure.value))
        for each in asked
    ]
    outcomes = [await each for each in begun]
    assert outcomes[:USER_RECORDINGS] == [None] * USER_RECORDINGS
    (words,) = outcomes[USER_RECORDINGS:]
    assert words is not None and "recordings running" in words


@pytest_twisted.ensureDeferred
async def test_what_is_just_being_begun_is_neither_stopped_nor_deleted(desk: Desk) -> None:
    """Or it would run, and nobody knew of it."""
    permit = await desk.access.permit(desk.ann, ROVER)
    assert permit is not None
    entry = desk.recordings.entry(CHATTER, desk.world.robot, permit)
    starting = Deferred.fromCoroutine(
        desk.recordings.start(entry, desk.world.robot, permit, lambda entry: None)
    )
    assert "being begun" in await failure(desk.recordings.delete(entry), Unavailable)
    with pytest.raises(Unavailable, match="being begun"):
        desk.recordings.stop(entry, "too early")
    await starting
    await desk.recordings.stop(entry, "enough")
    await desk.recordings.delete(entry)
    assert list(desk.folder.iterdir()) == []


@pytest_twisted.ensureDeferred
async def test_downloads_wait_for_their_turn(desk: Desk) -> None:
    """However many there are, none that has begun is refused; nor is who does something else meanwhile."""
    done = await desk.recorded(desk.ann, "a")
    path = desk.folder / f"{done['id']}.mcap"
    go = threading.Event()
    held = [Deferred.fromCoroutine(desk.recordings._threads.run(go.wait, 20)) for _ in range(THREADS)]
    reads = [Deferred.fromCoroutine(desk.recordings.read(path, 0, 8)) for _ in range(2 * WAITING)]
    for left in reads[::2]:
        left.addErrback(lambda failure: failure.trap(CancelledError))
        left.cancel()
    starting = Deferred.fromCoroutine(desk.desk.start(desk.ann, "rover", CHATTER, HERE))
    go.set()
    for each in (*held, starting):
        await each
    assert {await each for each in reads[1::2]} == {path.read_bytes()[:8]}


@pytest_twisted.ensureDeferred
async def test_a_long_list_comes_in_pages(desk: Desk) -> None:
    """The latest first, of those one may have; what is deleted meanwhile moves nothing."""
    for _ in range(7):
        await desk.recorded(desk.ann, "a")
        desk.world.clock.advance(0.5)
    whole = await desk.all(desk.ann)
    assert len(whole) == 7
    page = await desk.desk.all(desk.ann, "rover", HERE, limit=3)
    assert page["recordings"] == whole[:3]
    await desk.desk.delete(desk.ann, "rover", whole[2]["id"], HERE)
    page = await desk.desk.all(desk.ann, "rover", HERE, limit=3, before=page["next"])
    assert page["recordings"] == whole[3:6]
    page = await desk.desk.all(desk.ann, "rover", HERE, limit=1, before=page["next"])
    assert page == {"recordings": whole[6:], "next": None}
    assert await desk.desk.all(desk.eve, "rover", HERE, limit=1) == {"recordings": [], "next": None}
    for wrong in ("yesterday", "inf_a", "nan_a", "_"):
        assert "'before' is what" in await failure(
            desk.desk.all(desk.ann, "rover", HERE, before=wrong), Invalid
        )


@pytest_twisted.ensureDeferred
async def test_a_disk_that_hangs_does_not_keep_the_relay(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """It leaves; the file is recovered at the next start."""
    finish, stuck = RecordingWriter.finish, list[RecordingWriter]()
    monkeypatch.setattr(RecordingWriter, "finish", lambda writer: stuck.append(writer))
    begun = await desk.desk.start(desk.ann, "rover", CHATTER, HERE)
    leaving = Deferred.fromCoroutine(desk.recordings.shut("going down"))
    desk.world.clock.advance(FINISH_SECONDS)
    await leaving
    assert desk.recordings.library.find(1, begun["id"]).state.value == "finishing"
    monkeypatch.undo()
    finish(stuck[0])
