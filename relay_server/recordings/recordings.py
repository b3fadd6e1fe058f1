"""All recordings of a relay: those that run, and those in the library."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any
from weakref import WeakValueDictionary

import msgspec
from msgspec import Meta
from twisted.internet.defer import Deferred, DeferredList, DeferredLock, DeferredSemaphore, TimeoutError
from twisted.logger import Logger

from relay_protocol.errors import Invalid, Refused, Unavailable
from relay_protocol.limits import NAME
from relay_protocol.text import legible
from relay_server.access import Permit, is_image_topic
from relay_server.channels.channels import Channels
from relay_server.channels.robot_link import resolve
from relay_server.common.clock import Clock, as_twisted, shield
from relay_server.common.database import BoundedThreadPool
from relay_server.recordings import recorder as compressed
from relay_server.recordings.library import (
    NO_ROOM_NOW,
    SMALLEST,
    Library,
    RecordingEntry,
    RecordingState,
    text_of,
)
from relay_server.recordings.recorder import Recorder
from relay_server.recordings.repair import Repair
from relay_server.recordings.rights import why_denied
from relay_server.recordings.writer import NEARLY_FULL, RecordingWriter, WriteOutcome
from relay_server.robots.registry import RobotState
from relay_server.video.streams import CameraStreams

ROBOT_RECORDINGS = 8
USER_RECORDINGS = 4
RECORDINGS = 16
"""Recordings that may run on one robot, for one user, and in all; each has a thread and a queue."""

THREADS = 2
WAITING = 64
"""Pieces of work on files that may be under way or wait."""

READING = WAITING // 2
"""Of them, parts of downloads. Further ones wait for their turn: a download that has begun can't be refused."""

FINISH_SECONDS = 5.0
"""A relay that is going down waits no longer for the disk."""

SECONDS = 86400.0
MEGABYTES = 100_000

_Name = Annotated[str, Meta(min_length=1, max_length=NAME)]


class RecordingRequest(msgspec.Struct, forbid_unknown_fields=True):
    """What is to be recorded.

    :param seconds: it may take
    :param megabytes: the file may have, each of 10⁶ bytes
    """

    topics: Annotated[list[_Name], Meta(max_length=64)] = []
    cameras: Annotated[list[_Name], Meta(max_length=8)] = []
    seconds: Annotated[float, Meta(ge=1, le=SECONDS)] = 600.0
    megabytes: Annotated[float, Meta(ge=SMALLEST // 10**6, le=MEGABYTES)] = 1000.0


class Recordings:
    """Starts recordings, and looks after what they leave.

    :param reactor: Twisted's, for what threads have to say
    :param wall: Unix time in seconds
    """

    log = Logger()

    def __init__(
        self,
        reactor: Any,
        clock: Clock,
        library: Library,
        channels: Channels,
        videos: CameraStreams,
        wall: Callable[[], float],
    ) -> None:
        self._reactor = reactor
        self._clock = clock
        self.library = library
        self._channels = channels
        self._videos = videos
        self._wall = wall
        self._starting: dict[str, RecordingEntry] = {}
        self._deleting: set[str] = set()
        self._running: dict[str, Recorder] = {}
        self._ended: dict[str, list[Callable[[RecordingEntry], None]]] = {}
        self._saving: WeakValueDictionary[str, DeferredLock] = WeakValueDictionary()
        self._stopping = threading.Event()
        self._threads = BoundedThreadPool(
            reactor, "recordings", THREADS, WAITING, "too much is done with recordings now; try again"
        )
        self._turns = DeferredSemaphore(READING)
        self._mender = Repair(
            clock,
            library,
            self._threads,
            self._stopping,
            busy=lambda entry: entry.id in self._running or entry.id in self._deleting,
            save=self._save,
            drop=self._take_back,
        )

    # --- life of the relay --------------------------------------------------------------------------------

    def open(self) -> None:
        """Find out what is there.

        :raises Invalid: the folder can't be used
        """
        self.library.open()
        self._threads.start()

    def recover(self) -> None:
        """Begin to mend what was not finished."""
        self._mender.recover()

    @property
    def mended(self) -> Deferred[None]:
        """Fires when all is readable that can be."""
        return self._mender.done

    async def shut(self, reason: str) -> None:
        """Finish all that run."""
        self._stopping.set()
        self._mender.shut()
        running = list(self._running.values())
        stopping = [self.stop(recorder.entry, reason) for recorder in running]
        finishing = DeferredList(stopping, consumeErrors=True)
        finishing.addTimeout(FINISH_SECONDS, as_twisted(self._clock))
        try:
            await finishing
        except TimeoutError:
            self.log.error(
                "recordings are not finished within {limit} s; they are recovered later", limit=FINISH_SECONDS
            )

    def close(self) -> None:
        """Finish what is being done with files; blocks for as long as that takes."""
        self._threads.stop()

    # --- running ------------------------------------------------------------------------------------------

    def entry(self, ask: RecordingRequest, robot: RobotState, permit: Permit) -> RecordingEntry:
        """What a recording would be.

        :raises Invalid: there is nothing to record, a bad name, or something would be recorded twice
        """
        topics = tuple(dict.fromkeys(resolve(topic) for topic in ask.topics))
        cameras = tuple(dict.fromkeys(_camera(name) for name in ask.cameras))
        if not topics and not cameras:
            raise Invalid("say what to record: 'topics', 'cameras' or both")
        written = [compressed.topic_of(camera) for camera in cameras]
        twice = [topic for topic in written if topic in topics or written.count(topic) > 1]
        if twice:
            raise Invalid(f"{twice[0]} would be recorded twice, as a camera's pictures too")
        begun = self._wall()
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(begun))
        return RecordingEntry(
            id=f"{stamp}-{secrets.token_hex(4)}",
            robot_id=robot.robot_id,
            robot=robot.name,
            user_id=permit.principal.user_id,
            user=permit.principal.name,
            topics=topics,
            cameras=cameras,
            begun=begun,
            seconds=ask.seconds,
            pictures=tuple(topic for topic in topics if is_image_topic(robot, topic)),
            limit=round(ask.megabytes * 10**6),
            realm=permit.principal.realm,
            home="" if robot.realm == permit.principal.realm else robot.realm,
        )

    async def start(
        self,
        entry: RecordingEntry,
        robot: RobotState,
        permit: Permit,
        ended: Callable[[RecordingEntry], None],
    ) -> None:
        """Begin a recording.

        :param ended: called once when it is over, if it has begun
        :raises Unavailable: too many run, there is no room, or the disk can't be written
        :raises SwitchboardError: something can't be recorded
        """
        self._check_room(entry)
        self.library.add(entry)
        self._starting[entry.id] = entry
        try:
            await self._threads.run(self._begin, entry.id, text_of(entry))
            reason = why_denied(permit, entry)
            if reason:
                raise Refused(reason)
            if self._stopping.is_set():
                raise Unavailable("the relay is going down")
            self._recorder(entry, robot, permit).start()
        except BaseException as error:
            self._running.pop(entry.id, None)
            self.library.forget(entry)
            await self._take_back(entry)
            if isinstance(error, OSError):
                raise Unavailable(f"recordings can't be written: {error.strerror}") from None
            raise
        finally:
            del self._starting[entry.id]
        self._ended[entry.id] = [ended]

    def stop(self, entry: RecordingEntry, reason: str) -> Deferred[None]:
        """Finish a recording; fires when it has.

        :raises Unavailable: it is just being begun
        """
        self._check_begun(entry)
        done: Deferred[None] = Deferred()
        running = self._running.get(entry.id)
        if running is None:
            done.callback(None)
        else:
            self._ended[entry.id].append(lambda _: done.callback(None))
            running.stop(reason)
        return done

    def look(self, entry: RecordingEntry) -> RecordingEntry:
        """A recording, brought up to date."""
        running = self._running.get(entry.id)
        if running is not None:
            running.count()
        return entry

    def _recorder(self, entry: RecordingEntry, robot: RobotState, permit: Permit) -> Recorder:
        path = self.library.path(entry)
        ros = not robot.encodings or "cdr" in robot.encodings

        def make_writer(ended: Callable[[WriteOutcome], None]) -> RecordingWriter:
            return RecordingWriter(self._reactor, path, entry.limit, ros, self.library.nearly_full, ended)

        recorder = self._running[entry.id] = Recorder(
            self._clock,
            entry,
            permit,
            self._channels.of(robot),
            self._videos,
            make_writer,
            wall=self._wall,
            changed=lambda entry: Deferred.fromCoroutine(self._save(entry)),
            ended=self._over,
        )
        return recorder

    async def full(self, robot: RobotState, realm: str) -> str:
        """Why there can't be one more recording of a robot, however small; empty when there can.

        :param realm: whose it would be
        :raises Unavailable: too much is done with recordings to find out
        """
        full = self.library.full(robot.robot_id, realm)
        try:
            return full or await self._threads.run(self._why_nearly_full)
        except OSError as error:
            return f"recordings can't be written: {error.strerror}"

    def _why_nearly_full(self) -> str:
        """In a thread."""
        if not self.library.nearly_full():
            return ""
        return f"{NEARLY_FULL}: {self.library.reserve / 10**6:.0f} MB of it must stay free; delete some recordings"

    def _begin(self, id: str, text: bytes) -> None:
        """In a thread: a recording that may begin is put on the disk.

        :raises Unavailable: the disk is nearly full
        :raises OSError: it can't be written
        """
        full = self._why_nearly_full()
        if full:
            raise Unavailable(full)
        self.library.save(id, text)

    def _over(self, recorder: Recorder) -> None:
        entry = recorder.entry
        saving = Deferred.fromCoroutine(self._put_down(entry))

        def told(_: object) -> None:
            del self._running[entry.id]
            for each in self._ended.pop(entry.id):
                each(entry)
            if entry.state is RecordingState.INCOMPLETE:
                self._mender.later(entry)

        saving.addBoth(told)

    async def _put_down(self, entry: RecordingEntry) -> None:
        """Put on record how a recording ended."""
        if entry.state is RecordingState.INCOMPLETE:
            try:
                entry.bytes = await self._threads.run(self.library.size, entry)
            except (OSError, Unavailable):
                self.log.error("nobody knows how large recording {id} became", id=entry.id)
        await self._save(entry)

    async def _take_back(self, entry: RecordingEntry) -> None:
        try:
            await self._threads.run(self.library.delete, entry.id)
        except (OSError, Unavailable) as error:
            self.log.error(
                "recording {id} did not begin, and stays: {reason}", id=entry.id, reason=str(error)
            )

    async def _save(self, entry: RecordingEntry) -> bool:
        """Put on the disk what a recording is; whether that was done."""
        try:
            # One after the other: two threads would write the same file.
            async with self._saving.setdefault(entry.id, DeferredLock()):
                await self._threads.run(self.library.save, entry.id, text_of(entry))
        except (OSError, Unavailable) as error:
            self.log.error("recording {id} can't be put on record: {reason}", id=entry.id, reason=str(error))
            return False
        return True

    def _check_begun(self, entry: RecordingEntry) -> None:
        if entry.id in self._starting:
            raise Unavailable("it is just being begun; try again in a moment")

    def _check_room(self, entry: RecordingEntry) -> None:
        begun = {id: recorder.entry for id, recorder in self._running.items()}
        running = {**self._starting, **begun}.values()
        if sum(each.realm == entry.realm for each in running) >= RECORDINGS:
            raise Unavailable(f"{RECORDINGS} recordings run, the most there may be")
        of_robot = (each for each in running if each.robot_id == entry.robot_id)
        if sum(each.realm == entry.realm for each in of_robot) >= ROBOT_RECORDINGS:
            raise Unavailable(f"{ROBOT_RECORDINGS} recordings of this robot run, the most there may be")
        if sum(each.user_id == entry.user_id for each in running) >= USER_RECORDINGS:
            raise Unavailable(f"you have {USER_RECORDINGS} recordings running, the most one user may have")
        if len(running) >= RECORDINGS:
            raise Unavailable(NO_ROOM_NOW)

    # --- what is kept -------------------------------------------------------------------------------------

    async def delete(self, entry: RecordingEntry) -> None:
        """Take a recording that does not run off the disk.

        :raises Unavailable: it can't be deleted
        """
        self._check_begun(entry)
        if self._mender.current is entry:
            raise Unavailable("it is being recovered; try again in a moment")
        self._deleting.add(entry.id)
        try:
            await shield(Deferred.fromCoroutine(self._delete(entry)))
        except OSError as error:
            raise Unavailable(f"the recording can't be deleted: {error.strerror}") from None

    async def _delete(self, entry: RecordingEntry) -> None:
        # To the end, also when who asked has left: what is half gone is kept by nobody's count.
        try:
            await self._threads.run(self.library.delete, entry.id)
            self.library.forget(entry)
        finally:
            self._deleting.discard(entry.id)

    async def read(self, path: Path, offset: int, size: int) -> bytes:
        """A part of a file.

        :raises OSError: it can't be read
        """

        def work() -> bytes:
            # Opened for each part: who downloads may be gone before the thread is done.
            with path.open("rb") as file:
                file.seek(offset)
                return file.read(size)

        await self._turns.acquire()
        # Who leaves keeps his turn until the thread is done: else coming and going would fill the queue.
        return await shield(Deferred.fromCoroutine(self._in_turn(work)))

    async def _in_turn(self, work: Callable[[], bytes]) -> bytes:
        try:
            return await self._threads.run(work)
        finally:
            self._turns.release()


def _camera(name: str) -> str:
    """A camera's full name; one without slash in front is taken as if it had it.

    :raises Invalid: no name a camera could have
    """
    full = name if name.startswith("/") else f"/{name}"
    if not full.strip("/") or len(full) > NAME or not legible(full):
        raise Invalid(f"the name of a camera has at most {NAME} characters that can be printed")
    return full
