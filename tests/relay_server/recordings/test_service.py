"""The recording service, with a real database and real files."""

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
from relay_server.channels import subscriptions
from relay_server.common.database import AsyncDatabase
from relay_server.events.bus import BusEvent, EventBus
from relay_server.recordings import recordings as module
from relay_server.recordings.library import NO_ROOM_NOW, Library, RecordingEntry, why_denied
from relay_server.recordings.mcap_file import McapFile
from relay_server.recordings.recordings import (
    FINISH_SECONDS,
    STORAGE_THREADS,
    USER_RECORDINGS,
    WAITING,
    RecordingRequest,
    Recordings,
)
from relay_server.recordings.repair import PAUSE_SECONDS
from relay_server.recordings.service import RecordingService
from relay_server.recordings.writer import RecordingWriter
from relay_server.sessions.download_audit import REPEAT_SECONDS
from relay_server.sessions.manager import Admission, SessionManager
from tests.worlds.mcap_reader import read
from tests.worlds.relay import World, text
from tests.worlds.robot_links import until

HERE = "192.0.2.1"
CHATTER = RecordingRequest(topics=["chatter"], megabytes=1)
ROVER = RobotRecord(1, "rover", "default", "")


class FakeAdmissions:
    """Admits users with a right; the recording service needs no more of the session manager."""

    def __init__(self, store: AsyncDatabase, access: Access, world: World) -> None:
        self._store = store
        self._access = access
        self._world = world
        self.inside = 0

    async def admit(self, principal: Principal, robot: str, address: str) -> Admission:
        """Admits a user with a right on the robot."""
        record = await self._store.read(queries.find_robot, robot, principal.realm)
        permit = None if record is None else await self._access.permit(principal, record)
        if permit is None:
            raise NotFound(NO_ROBOT)
        self.inside += 1
        return Admission(permit, self._world.robot, address)

    admitted: Any = SessionManager.admitted

    def release(self, admission: Admission) -> None:
        """Releases the permit."""
        self.inside -= 1
        self._access.release(admission.permit)


class RecordingsWorld:
    """A recording service and its parts."""

    def __init__(self, store: AsyncDatabase, folder: Path) -> None:
        self.store = store
        self.folder = folder
        self.world = World()
        self.access = Access(store, self.wall)
        self.doors = FakeAdmissions(store, self.access, self.world)
        self.recordings = self.begins()
        self.bus = EventBus()
        self.published: list[BusEvent] = []
        self.bus.subscribe(self.published.append)
        # The service needs only admissions of the session manager.
        self.service = RecordingService(self.doors, self.recordings, store, self.bus, self.wall)  # type: ignore[arg-type]
        with store.database.begin() as session:
            self._robot = queries.add_robot(session, "rover").id
        self.ann, self.bob, self.eve = (self._principal(name) for name in ("ann", "bob", "eve"))

    def begins(self) -> Recordings:
        """Starts a relay on the folder."""
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
        """A running recording of another realm."""
        entry = RecordingEntry("z", 99, "rover", 99, "zoe", ("/odom",), (), 1.0, limit, 60.0, realm="lab1")
        self.recordings.library.add(entry)
        return entry

    def moves(self, realm: str, name: str) -> Principal:
        """Moves the robot to another realm, in which the returned user may record it."""
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
        """Revokes a right."""
        who = {"ann": self.ann, "bob": self.bob}[name]
        await self.store.write(queries.revoke_right, self._robot, user_id=who.user_id)
        await self.access.refresh()

    async def deny(self, name: str, *patterns: str) -> None:
        """Narrows an operator's right."""
        who = {"ann": self.ann, "bob": self.bob}[name]
        await self.store.write(
            queries.grant_right, self._robot, "operator", user_id=who.user_id, deny=list(patterns)
        )
        await self.access.refresh()

    def says(self, *words: str) -> None:
        """The online robot publishes a text."""
        number = self.world.link.all(link.Subscribe)[-1].number
        self.world.subscribed(number)
        self.world.define()
        for stamp, word in enumerate(words):
            self.world.channel.sample(number, text(word), stamp + 1)

    def publishes_images(self) -> None:
        """The robot reports that its topic carries images."""
        image = link.Topic(types=["sensor_msgs/msg/Image"], publishers=["/camera"])
        self.world.registry.graph(self.world.robot, link.Graph(topics={"/chatter": image}))

    async def recorded(self, who: Principal, *words: str) -> dict[str, Any]:
        """A finished recording."""
        begun = await self.service.start(who, "rover", CHATTER, HERE)
        self.says(*words)
        return await self.service.stop(who, "rover", begun["id"], HERE)

    async def all(self, who: Principal) -> list[dict[str, Any]]:
        """The list of recordings, which must fit on one page."""
        page = await self.service.all(who, "rover", HERE)
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
        """The content of the file."""
        file = await self.service.download(who, "rover", id, HERE)
        try:
            await file.begin()
            return await file.part(0, file.size + 1)
        finally:
            file.close()

    async def audit(self) -> list[tuple[str, str, str]]:
        """Audit entries, oldest first: actor, action and origin."""
        entries = await self.store.read(queries.list_audit)
        return [(each.actor, each.action, each.origin) for each in reversed(entries)]


@pytest.fixture
def scene(store: AsyncDatabase, tmp_path: Path) -> Iterator[RecordingsWorld]:
    """A recording service, and a robot that is online."""
    made = RecordingsWorld(store, tmp_path / "recordings")
    made.world.at_work()
    yield made
    pytest_twisted.blockon(Deferred.fromCoroutine(made.recordings.shut("the test is over")))
    made.recordings.close()


async def failure(work: Any, kind: type[SwitchboardError]) -> str:
    """The text of an error."""
    with pytest.raises(kind) as caught:
        await work
    return str(caught.value)


@pytest_twisted.ensureDeferred
async def test_a_recording_is_started_read_stopped_and_downloaded(
    scene: RecordingsWorld, tmp_path: Path
) -> None:
    """The file has the messages published meanwhile; all permits are released."""
    begun = await scene.service.start(scene.ann, "rover", CHATTER, HERE)
    assert (begun["state"], begun["topics"], begun["megabytes"]) == ("recording", ["/chatter"], 1.0)
    assert "robot_id" not in begun
    scene.world.clock.advance(2)
    assert (await scene.service.one(scene.ann, "rover", begun["id"], HERE))["lasted"] == 2.0
    scene.says("a", "b")
    assert "still being recorded" in await failure(
        scene.service.download(scene.ann, "rover", begun["id"], HERE), Unavailable
    )
    done = await scene.service.stop(scene.ann, "rover", begun["id"], HERE)
    scene.world.clock.advance(1)
    assert done["lasted"] == 2.0
    assert (done["state"], done["messages"], done["drops"]) == ("complete", 2, 0)
    assert done["reason"] == "stopped by ann"
    path = tmp_path / "copy.mcap"
    path.write_bytes(await scene.fetch(scene.bob, begun["id"]))
    assert [each.body for each in read(path)] == [text("a"), text("b")]
    assert path.stat().st_size == done["bytes"]
    assert await scene.all(scene.bob) == [done]
    assert await scene.service.one(scene.ann, "rover", begun["id"], HERE) == done
    assert scene.doors.inside == 0


@pytest_twisted.ensureDeferred
async def test_actions_are_in_the_audit_log(scene: RecordingsWorld) -> None:
    """The entry is written before the action; events report its result."""
    done = await scene.recorded(scene.ann, "a")
    await scene.fetch(scene.bob, done["id"])
    await scene.service.delete(scene.ann, "rover", done["id"], HERE)
    assert await scene.audit() == [
        ("user:ann", "recording.start", HERE),
        ("user:bob", "recording.download", HERE),
        ("user:ann", "recording.delete", HERE),
    ]
    assert [each.kind for each in scene.published] == ["recording.started", "recording.ended"]
    assert list(scene.folder.iterdir()) == []
    assert await scene.all(scene.ann) == []


@pytest_twisted.ensureDeferred
async def test_a_download_in_parts_is_on_record_once(scene: RecordingsWorld) -> None:
    """Once per user; after a while again."""
    done = await scene.recorded(scene.ann, "a")
    for who in (scene.ann, scene.bob, scene.ann, scene.bob):
        await scene.fetch(who, done["id"])
    fetched = [actor for actor, action, _ in await scene.audit() if action == "recording.download"]
    assert fetched == ["user:ann", "user:bob"]
    scene.world.clock.advance(REPEAT_SECONDS)
    await scene.fetch(scene.ann, done["id"])
    assert (await scene.audit())[-1][:2] == ("user:ann", "recording.download")
    assert len(await scene.audit()) == 4


@pytest_twisted.ensureDeferred
async def test_recording_is_not_found_without_the_rights(scene: RecordingsWorld) -> None:
    """A viewer cannot read a topic by its recording; a user without a right gets the same error."""
    done = await scene.recorded(scene.ann, "a")
    assert "needs the level operator" in await failure(
        scene.service.start(scene.eve, "rover", CHATTER, HERE), Refused
    )
    assert await scene.all(scene.eve) == []
    for ask in (scene.service.one, scene.service.stop, scene.service.delete, scene.service.download):
        assert "no such recording" in await failure(ask(scene.eve, "rover", done["id"], HERE), NotFound)
        assert await failure(ask(scene.ann, "tank", done["id"], HERE), NotFound) == NO_ROBOT
    assert scene.doors.inside == 0


@pytest_twisted.ensureDeferred
async def test_recordable_topics_are_listed(scene: RecordingsWorld) -> None:
    """Each user gets their topics and the free space. A user who may record nothing gets the reason."""
    scene.world.robot.cameras = (link.Camera(name="/camera", type="sensor_msgs/msg/Image"),)
    found = await scene.service.possible(scene.ann, "rover", HERE)
    assert found == {
        "topics": sorted(scene.world.robot.graph.topics),
        "cameras": ["/camera"],
        "denied": "",
        "megabytes": 5.0,
        "left": 5.0,
        "full": "",
    }
    assert "/chatter" in found["topics"]
    await scene.recorded(scene.ann, "a")
    await scene.service.start(scene.ann, "rover", CHATTER, HERE)
    assert 3.9 < (await scene.service.possible(scene.ann, "rover", HERE))["left"] < 4
    none = await scene.service.possible(scene.eve, "rover", HERE)
    assert (none["topics"], none["cameras"]) == ([], [])
    assert "needs the level operator" in none["denied"]


@pytest_twisted.ensureDeferred
async def test_images_are_not_to_be_had_by_recording_their_topic(scene: RecordingsWorld) -> None:
    """The file is not available either to users who may not view them, even after the topic has gone and
    after a restart.
    """
    image = link.Topic(types=["sensor_msgs/msg/CompressedImage"], publishers=["/camera"])
    scene.world.registry.graph(scene.world.robot, link.Graph(topics={"/camera/compressed": image}))
    wanted = RecordingRequest(topics=["/camera/compressed"], megabytes=1)
    done = await scene.service.start(scene.bob, "rover", wanted, HERE)
    await scene.service.stop(scene.bob, "rover", done["id"], HERE)
    await scene.deny("ann", "view:/camera/*")
    assert "view on /camera/compressed is denied" in await failure(
        scene.service.start(scene.ann, "rover", wanted, HERE), Refused
    )
    assert "/camera/compressed" not in (await scene.service.possible(scene.ann, "rover", HERE))["topics"]
    assert "/camera/compressed" in (await scene.service.possible(scene.bob, "rover", HERE))["topics"]
    scene.world.robot_goes()
    scene.recordings.library.open()
    assert await scene.all(scene.ann) == []
    await failure(scene.service.download(scene.ann, "rover", done["id"], HERE), NotFound)
    assert [each["id"] for each in await scene.all(scene.bob)] == [done["id"]]


@pytest_twisted.ensureDeferred
async def test_a_topic_that_begins_to_carry_images_does_so_after_a_crash(scene: RecordingsWorld) -> None:
    """This is stored at once, so that the repaired file has the same restriction."""
    begun = await scene.service.start(scene.bob, "rover", CHATTER, HERE)
    scene.publishes_images()
    async with scene.recordings._saving.setdefault(begun["id"], DeferredLock()):
        # Wait until the pending write is done.
        found = Library(scene.folder, 10**6)
        found.open()
    (entry,) = found.of(1)
    assert (entry.state.value, entry.pictures) == ("incomplete", ("/chatter",))
    await scene.deny("ann", "view:/chatter")
    permit = await scene.access.permit(scene.ann, ROVER)
    assert permit is not None
    assert "view on /chatter is denied" in why_denied(permit, entry)
    done = await scene.service.stop(scene.bob, "rover", begun["id"], HERE)
    assert (done["state"], done["problems"]) == ("complete", [])


@pytest_twisted.ensureDeferred
async def test_a_recording_is_put_on_record_by_one_thread_at_a_time(
    scene: RecordingsWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The recording may end while it is being saved: the stored state is its end."""
    begun = await scene.service.start(scene.bob, "rover", CHATTER, HERE)
    library = scene.recordings.library
    save, go_on, texts = library.save, threading.Event(), list[bytes]()

    def slowly(id: str, body: bytes) -> None:
        texts.append(body)
        go_on.wait(10)
        save(id, body)

    monkeypatch.setattr(library, "save", slowly)
    scene.publishes_images()
    stopped = Deferred.fromCoroutine(scene.service.stop(scene.bob, "rover", begun["id"], HERE))
    await until(lambda: library.find(1, begun["id"]).state.value == "complete")
    assert scene.recordings._threads._under_way == 1
    go_on.set()
    await stopped
    again = Library(scene.folder, 10**6)
    again.open()
    (entry,) = again.of(1)
    assert (len(texts), entry.state.value, entry.pictures) == (2, "complete", ("/chatter",))


@pytest_twisted.ensureDeferred
async def test_only_its_maker_or_an_owner_stops_and_deletes_it(scene: RecordingsWorld) -> None:
    """Others with the right to record may download the file."""
    done = await scene.recorded(scene.ann, "a")
    for ask in (scene.service.stop, scene.service.delete):
        assert "belongs to ann" in await failure(ask(scene.bob, "rover", done["id"], HERE), Refused)


@pytest_twisted.ensureDeferred
async def test_a_right_that_is_revoked_ends_recording_and_download(scene: RecordingsWorld) -> None:
    """The file is complete."""
    await scene.service.start(scene.ann, "rover", CHATTER, HERE)
    scene.says("a")
    done = await scene.recorded(scene.bob, "b")
    download = await scene.service.download(scene.ann, "rover", done["id"], HERE)
    denied: list[str] = []
    download.permit.on_revoke = lambda error: denied.append(str(error))
    assert download.allowed()
    await scene.revoke("ann")
    assert denied == ["your right on this robot was revoked"]
    download.close()
    await scene.recordings.shut("over")
    (found,) = [each for each in await scene.all(scene.bob) if each["user"] == "ann"]
    assert (found["state"], found["reason"]) == ("complete", "your right on this robot was revoked")
    assert scene.doors.inside == 0


@pytest_twisted.ensureDeferred
async def test_names_without_slash_are_taken_as_if_they_had_one(scene: RecordingsWorld) -> None:
    """This applies to cameras and topics; a topic named in both ways is recorded once."""
    ask = RecordingRequest(topics=["chatter", "/chatter"], cameras=["camera", "/camera"], megabytes=1)
    begun = await scene.service.start(scene.ann, "rover", ask, HERE)
    assert (begun["topics"], begun["cameras"]) == (["/chatter"], ["/camera"])
    await scene.service.stop(scene.ann, "rover", begun["id"], HERE)


@pytest_twisted.ensureDeferred
async def test_failed_recording_leaves_no_file(
    scene: RecordingsWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No place is taken, and no permit is left."""
    for ask in (
        RecordingRequest(),
        RecordingRequest(topics=["no name"]),
        RecordingRequest(topics=["/camera/compressed"], cameras=["/camera"]),
        RecordingRequest(topics=["/camera/compressed"], cameras=["camera"]),
        RecordingRequest(cameras=["/"]),
        RecordingRequest(cameras=["a\nb"]),
    ):
        await failure(scene.service.start(scene.ann, "rover", ask, HERE), Invalid)
    monkeypatch.setattr(subscriptions, "USER_TOPICS", 0)
    ask = RecordingRequest(topics=["/chatter"], megabytes=1)
    await failure(scene.service.start(scene.ann, "rover", ask, HERE), Refused)
    assert list(scene.folder.iterdir()) == []
    assert scene.recordings.library.used == 0
    assert scene.doors.inside == 0


@pytest_twisted.ensureDeferred
async def test_no_more_is_recorded_than_there_is_room_for(scene: RecordingsWorld) -> None:
    """Both the total size and the number per user are limited."""
    assert "of which 5 MB are left" in await failure(
        scene.service.start(scene.ann, "rover", RecordingRequest(topics=["/chatter"], megabytes=6), HERE),
        Unavailable,
    )
    for _ in range(USER_RECORDINGS):
        await scene.service.start(scene.ann, "rover", CHATTER, HERE)
    assert "recordings running" in await failure(
        scene.service.start(scene.ann, "rover", CHATTER, HERE), Unavailable
    )
    await scene.service.start(scene.bob, "rover", CHATTER, HERE)


@pytest_twisted.ensureDeferred
async def test_recordings_of_other_realms_are_hidden(scene: RecordingsWorld) -> None:
    """The errors disclose neither free space nor numbers, only that there is no room."""
    scene.others(limit=4 * 10**6 + 1)
    assert (await scene.service.possible(scene.ann, "rover", HERE))["left"] == 5.0
    assert (await scene.service.possible(scene.ann, "rover", HERE))["full"] == NO_ROOM_NOW
    assert await failure(scene.service.start(scene.ann, "rover", CHATTER, HERE), Unavailable) == NO_ROOM_NOW
    assert scene.doors.inside == 0


@pytest_twisted.ensureDeferred
async def test_the_number_of_other_recordings_is_not_disclosed(
    scene: RecordingsWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A user who runs all of them gets the maximum."""
    monkeypatch.setattr(module, "RECORDINGS", 2)
    other = scene.others(limit=1)
    scene.recordings._starting[other.id] = other
    await scene.service.start(scene.ann, "rover", CHATTER, HERE)
    assert await failure(scene.service.start(scene.bob, "rover", CHATTER, HERE), Unavailable) == NO_ROOM_NOW
    del scene.recordings._starting[other.id]
    await scene.service.start(scene.ann, "rover", CHATTER, HERE)
    assert "2 recordings run, the most there may be" in await failure(
        scene.service.start(scene.bob, "rover", CHATTER, HERE), Unavailable
    )


@pytest_twisted.ensureDeferred
async def test_a_recording_is_of_the_realm_of_its_robot(scene: RecordingsWorld) -> None:
    """The stored metadata has it; the description for clients does not."""
    zoe = scene.moves("lab1", "zoe")
    done = await scene.recorded(zoe, "a")
    (entry,) = scene.recordings.library
    assert (entry.realm, "realm" in done) == ("lab1", False)
    assert b'"realm":"lab1"' in (scene.folder / f"{entry.id}.json").read_bytes()
    assert [each.target for each in await scene.store.read(queries.list_audit)] == [f"rover@lab1/{entry.id}"]


@pytest_twisted.ensureDeferred
async def test_recordings_of_a_killed_relay_are_repaired(scene: RecordingsWorld) -> None:
    """At the next start. A recording without a file is removed."""
    done = await scene.recorded(scene.ann, "a", "b")
    other = await scene.recorded(scene.ann, "c")
    for each in (done, other):
        file = scene.folder / f"{each['id']}.json"
        file.write_bytes(file.read_bytes().replace(b'"complete"', b'"recording"'))
    path = scene.folder / f"{done['id']}.mcap"
    path.write_bytes(path.read_bytes()[:-50])
    (scene.folder / f"{other['id']}.mcap").unlink()
    again = scene.begins()
    await again.mended
    (found,) = again.library.of(1)
    assert (found.state.value, found.messages, found.ended is not None) == ("recovered", 2, True)
    assert [each.body for each in read(path)] == [text("a"), text("b")]
    again.close()


@pytest_twisted.ensureDeferred
async def test_interrupted_recording_is_repaired_by_the_same_relay(
    scene: RecordingsWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a while; until then its size on disk counts."""
    scene.breaks(monkeypatch)
    broken = await scene.recorded(scene.ann, "a", "b")
    assert (broken["state"], broken["reason"]) == ("incomplete", "stopped by ann")
    size = (scene.folder / f"{broken['id']}.mcap").stat().st_size
    assert scene.recordings.library.used == broken["bytes"] == size > 0
    assert "not recovered yet" in await failure(
        scene.service.download(scene.ann, "rover", broken["id"], HERE), Unavailable
    )
    scene.world.clock.advance(PAUSE_SECONDS)
    async with scene.recordings._repair._one_at_a_time:
        # Wait until the attempt after the pause is done.
        pass
    found = await scene.service.one(scene.ann, "rover", broken["id"], HERE)
    assert (found["state"], found["messages"]) == ("recovered", 2)
    (scene.folder / "copy").write_bytes(await scene.fetch(scene.ann, broken["id"]))
    assert [each.body for each in read(scene.folder / "copy")] == [text("a"), text("b")]


@pytest_twisted.ensureDeferred
async def test_a_disk_that_is_nearly_full_takes_no_recording(scene: RecordingsWorld) -> None:
    """The client gets the reason, also with the list of topics; running recordings are complete."""
    begun = await scene.service.start(scene.ann, "rover", CHATTER, HERE)
    ended: Deferred[None] = Deferred()
    scene.recordings._ended[begun["id"]].append(lambda entry: ended.callback(None))
    scene.says("a")
    scene.recordings.library.reserve = 2**62
    await ended
    done = await scene.service.one(scene.ann, "rover", begun["id"], HERE)
    assert (done["state"], done["reason"], done["messages"]) == ("complete", "the disk is nearly full", 1)
    words = await failure(scene.service.start(scene.ann, "rover", CHATTER, HERE), Unavailable)
    assert "the disk is nearly full" in words and "delete some recordings" in words
    assert (await scene.service.possible(scene.ann, "rover", HERE))["full"] == words
    assert [each["id"] for each in await scene.all(scene.ann)] == [begun["id"]]
    assert scene.doors.inside == 0


@pytest_twisted.ensureDeferred
async def test_limits_hold_for_concurrent_requests(scene: RecordingsWorld) -> None:
    """Recordings that are about to start count."""
    permit = await scene.access.permit(scene.ann, ROVER)
    assert permit is not None
    robot, ends = scene.world.robot, list[str]()
    asked = [scene.recordings.entry(CHATTER, robot, permit) for _ in range(5)]
    begun = [
        Deferred.fromCoroutine(
            scene.recordings.start(each, robot, permit, lambda entry: ends.append(entry.id))
        ).addErrback(lambda failure: str(failure.value))
        for each in asked
    ]
    outcomes = [await each for each in begun]
    assert outcomes[:USER_RECORDINGS] == [None] * USER_RECORDINGS
    (words,) = outcomes[USER_RECORDINGS:]
    assert words is not None and "recordings running" in words


@pytest_twisted.ensureDeferred
async def test_starting_recording_cannot_be_stopped_or_deleted(scene: RecordingsWorld) -> None:
    """Otherwise it would run unnoticed."""
    permit = await scene.access.permit(scene.ann, ROVER)
    assert permit is not None
    entry = scene.recordings.entry(CHATTER, scene.world.robot, permit)
    starting = Deferred.fromCoroutine(
        scene.recordings.start(entry, scene.world.robot, permit, lambda entry: None)
    )
    assert "just starting" in await failure(scene.recordings.delete(entry), Unavailable)
    with pytest.raises(Unavailable, match="just starting"):
        scene.recordings.stop(entry, "too early")
    await starting
    await scene.recordings.stop(entry, "enough")
    await scene.recordings.delete(entry)
    assert list(scene.folder.iterdir()) == []


@pytest_twisted.ensureDeferred
async def test_downloads_wait_for_their_turn(scene: RecordingsWorld) -> None:
    """Downloads that have begun are never refused, nor are other requests."""
    done = await scene.recorded(scene.ann, "a")
    path = scene.folder / f"{done['id']}.mcap"
    go = threading.Event()
    entry = scene.recordings.library.find(1, done["id"])
    content = await scene.recordings.open_content(entry)
    threads = scene.recordings._contents
    held = [Deferred.fromCoroutine(threads.run(go.wait, 20)) for _ in range(STORAGE_THREADS)]
    reads = [Deferred.fromCoroutine(scene.recordings.read(entry, content, 0, 8)) for _ in range(2 * WAITING)]
    for left in reads[::2]:
        left.addErrback(lambda failure: failure.trap(CancelledError))
        left.cancel()
    starting = Deferred.fromCoroutine(scene.service.start(scene.ann, "rover", CHATTER, HERE))
    go.set()
    for each in (*held, starting):
        await each
    assert {await each for each in reads[1::2]} == {path.read_bytes()[:8]}
    content.close()


@pytest_twisted.ensureDeferred
async def test_a_long_list_comes_in_pages(scene: RecordingsWorld) -> None:
    """Latest first, with only the permitted ones; deletions in between do not shift pages."""
    for _ in range(7):
        await scene.recorded(scene.ann, "a")
        scene.world.clock.advance(0.5)
    whole = await scene.all(scene.ann)
    assert len(whole) == 7
    page = await scene.service.all(scene.ann, "rover", HERE, limit=3)
    assert page["recordings"] == whole[:3]
    await scene.service.delete(scene.ann, "rover", whole[2]["id"], HERE)
    page = await scene.service.all(scene.ann, "rover", HERE, limit=3, before=page["next"])
    assert page["recordings"] == whole[3:6]
    page = await scene.service.all(scene.ann, "rover", HERE, limit=1, before=page["next"])
    assert page == {"recordings": whole[6:], "next": None}
    assert await scene.service.all(scene.eve, "rover", HERE, limit=1) == {"recordings": [], "next": None}
    for wrong in ("yesterday", "inf_a", "nan_a", "_"):
        assert "'before' must be" in await failure(
            scene.service.all(scene.ann, "rover", HERE, before=wrong), Invalid
        )


@pytest_twisted.ensureDeferred
async def test_a_disk_that_hangs_does_not_keep_the_relay(
    scene: RecordingsWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The shutdown does not wait; the file is repaired at the next start."""
    finish, stuck = RecordingWriter.finish, list[RecordingWriter]()
    monkeypatch.setattr(RecordingWriter, "finish", lambda writer: stuck.append(writer))
    begun = await scene.service.start(scene.ann, "rover", CHATTER, HERE)
    leaving = Deferred.fromCoroutine(scene.recordings.shut("going down"))
    scene.world.clock.advance(FINISH_SECONDS)
    await leaving
    assert scene.recordings.library.find(1, begun["id"]).state.value == "finishing"
    monkeypatch.undo()
    finish(stuck[0])
