"""All recordings of a relay: those that run, and those in the library."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable
from typing import Annotated, Any
from weakref import WeakValueDictionary

import msgspec
from msgspec import Meta
from twisted.internet.defer import Deferred, DeferredList, DeferredLock, DeferredSemaphore, TimeoutError
from twisted.logger import Logger

from relay_protocol.errors import Invalid, Refused, Unavailable
from relay_protocol.limits import NAME
from relay_protocol.text import is_printable
from relay_server.access import Permit, is_image_topic
from relay_server.channels.channel import Channels
from relay_server.channels.names import resolve
from relay_server.common.clock import Clock, as_twisted
from relay_server.common.concurrency import shield
from relay_server.common.database import BoundedThreadPool
from relay_server.files.storage import ContentReader, open_in_thread
from relay_server.recordings import recorder as compressed
from relay_server.recordings.archive import RecordingArchive
from relay_server.recordings.library import (
    NO_ROOM_NOW,
    SMALLEST,
    Library,
    RecordingEntry,
    RecordingState,
    text_of,
    why_denied,
)
from relay_server.recordings.recorder import Recorder
from relay_server.recordings.repair import Repair
from relay_server.recordings.writer import NEARLY_FULL, RecordingWriter, WriteOutcome
from relay_server.robots.registry import RobotState
from relay_server.video.streams import CameraStreams

ROBOT_RECORDINGS = 8
USER_RECORDINGS = 4
RECORDINGS = 16
"""Most recordings that run on one robot, for one user, and in all; each has a thread and a queue."""

THREADS = 2
STORAGE_THREADS = 4
WAITING = 64
"""File operations that may run or wait; those of finished files, which may be in a remote storage, for themselves."""

READING = WAITING // 2
"""Of these, parts of downloads. Further ones wait, since a download that has begun cannot be rejected."""

FINISH_SECONDS = 5.0
"""A relay that shuts down waits this long for the disk."""

SECONDS = 86400.0
MEGABYTES = 100_000

_Name = Annotated[str, Meta(min_length=1, max_length=NAME)]


class RecordingRequest(msgspec.Struct, forbid_unknown_fields=True):
    """A request for a recording.

    :param seconds: longest duration
    :param megabytes: largest size of the file, in 10⁶ bytes
    """

    topics: Annotated[list[_Name], Meta(max_length=64)] = []
    cameras: Annotated[list[_Name], Meta(max_length=8)] = []
    seconds: Annotated[float, Meta(ge=1, le=SECONDS)] = 600.0
    megabytes: Annotated[float, Meta(ge=SMALLEST // 10**6, le=MEGABYTES)] = 1000.0


class Recordings:
    """Starts recordings, and repairs those that broke off.

    :param reactor: Twisted's reactor, for results of threads
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
        self._finished: Deferred[None] | None = None
        self._threads = BoundedThreadPool(
            reactor, "recordings", THREADS, WAITING, "too many file operations of recordings wait; try again"
        )
        self._contents = BoundedThreadPool(
            reactor,
            "recordings-storage",
            STORAGE_THREADS,
            WAITING,
            "too many files of recordings are being read; try again",
        )
        self._read_slots = DeferredSemaphore(READING)
        self._archive = RecordingArchive(clock, library, self._contents, self._stopping, self._save)
        self._repair = Repair(
            clock,
            library,
            self._threads,
            self._stopping,
            busy=lambda entry: entry.id in self._running or entry.id in self._deleting,
            save=self._save,
            drop=self._undo_start,
            repaired=self._archive.add,
        )

    # --- life of the relay --------------------------------------------------------------------------------

    def open(self) -> None:
        """Read the library.

        :raises Invalid: the folder cannot be used
        """
        self.library.open()
        self._threads.start()
        self._contents.start()

    def recover(self) -> None:
        """Begin to repair unfinished recordings, and to move finished ones into the storage."""
        self._repair.recover()
        Deferred.fromCoroutine(self._archive.recover())

    @property
    def mended(self) -> Deferred[None]:
        """Fires when all that can be repaired is readable."""
        return self._repair.done

    def begin_shutdown(self, reason: str) -> None:
        """Begin to finish all running recordings; :meth:`shut_down` waits for it."""
        self._finished = Deferred.fromCoroutine(self.shut(reason))

    async def shut_down(self) -> None:
        """Wait for the end of :meth:`begin_shutdown`, at most :data:`FINISH_SECONDS`."""
        if self._finished is not None:
            await self._finished

    async def shut(self, reason: str) -> None:
        """Finish all running recordings."""
        self._stopping.set()
        self._repair.shut()
        self._archive.shut()
        running = list(self._running.values())
        stopping = [self.stop(recorder.entry, reason) for recorder in running]
        finishing = DeferredList(stopping, consumeErrors=True)
        finishing.addTimeout(FINISH_SECONDS, as_twisted(self._clock))
        try:
            await finishing
        except TimeoutError:
            self.log.error(
                "recordings are not finished within {limit} s; they are recovered at the next start",
                limit=FINISH_SECONDS,
            )

    def close(self) -> None:
        """Finish all file operations. Blocks for as long as that takes."""
        self._threads.stop()
        self._contents.stop()

    # --- running ------------------------------------------------------------------------------------------

    def entry(self, ask: RecordingRequest, robot: RobotState, permit: Permit) -> RecordingEntry:
        """The entry of a new recording.

        :raises Invalid: there is nothing to record, a name is not valid, or something would be recorded twice
        """
        topics = tuple(dict.fromkeys(resolve(topic) for topic in ask.topics))
        cameras = tuple(dict.fromkeys(_camera(name) for name in ask.cameras))
        if not topics and not cameras:
            raise Invalid("there is nothing to record: send 'topics', 'cameras' or both")
        written = [compressed.topic_of(camera) for camera in cameras]
        twice = [topic for topic in written if topic in topics or written.count(topic) > 1]
        if twice:
            raise Invalid(f"{twice[0]} would be recorded twice, also as the images of a camera")
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
        """Start a recording.

        :param ended: called once at its end, if it has begun
        :raises Unavailable: too many run, there is no space, or the disk cannot be written
        :raises SwitchboardError: something cannot be recorded
        """
        self._check_room(entry)
        self.library.add(entry)
        self._starting[entry.id] = entry
        try:
            await self._threads.run(self._write_new, entry.id, text_of(entry))
            reason = why_denied(permit, entry)
            if reason:
                raise Refused(reason)
            if self._stopping.is_set():
                raise Unavailable("the relay is going down")
            self._recorder(entry, robot, permit).start()
        except BaseException as error:
            self._running.pop(entry.id, None)
            self.library.forget(entry)
            await self._undo_start(entry)
            if isinstance(error, OSError):
                raise Unavailable(f"recordings cannot be written: {error.strerror}") from None
            raise
        finally:
            del self._starting[entry.id]
        self._ended[entry.id] = [ended]

    def stop(self, entry: RecordingEntry, reason: str) -> Deferred[None]:
        """Finish a recording; fires when it is finished.

        :raises Unavailable: it is just starting
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

    def records(self, robot_id: int) -> bool:
        """Whether a recording of a robot runs."""
        return any(each.entry.robot_id == robot_id for each in self._running.values())

    def updated(self, entry: RecordingEntry) -> RecordingEntry:
        """A recording with current numbers."""
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
            ended=self._recorder_ended,
        )
        return recorder

    async def full(self, robot: RobotState, realm: str) -> str:
        """Why there cannot be one more recording of a robot, whatever its size; empty if there can.

        :param realm: that it would belong to
        :raises Unavailable: too many file operations wait
        """
        full = self.library.full(robot.robot_id, realm)
        try:
            return full or await self._threads.run(self._why_nearly_full)
        except OSError as error:
            return f"recordings cannot be written: {error.strerror}"

    def _why_nearly_full(self) -> str:
        """Runs in a thread."""
        if not self.library.nearly_full():
            return ""
        return f"{NEARLY_FULL}: {self.library.reserve / 10**6:.0f} MB of it must stay free; delete some recordings"

    def _write_new(self, id: str, text: bytes) -> None:
        """Write the description of a new recording. Runs in a thread.

        :raises Unavailable: the disk is nearly full
        :raises OSError: it cannot be written
        """
        full = self._why_nearly_full()
        if full:
            raise Unavailable(full)
        self.library.save(id, text)

    def _recorder_ended(self, recorder: Recorder) -> None:
        entry = recorder.entry
        saving = Deferred.fromCoroutine(self._save_end(entry))

        def saved(_: object) -> None:
            del self._running[entry.id]
            for each in self._ended.pop(entry.id):
                each(entry)
            if entry.state is RecordingState.INCOMPLETE:
                self._repair.later(entry)
            else:
                self._archive.add(entry)

        saving.addBoth(saved)

    async def _save_end(self, entry: RecordingEntry) -> None:
        """Save how a recording ended."""
        if entry.state is RecordingState.INCOMPLETE:
            try:
                entry.bytes = await self._threads.run(self.library.size, entry)
            except (OSError, Unavailable):
                self.log.error("the final size of recording {id} is not known", id=entry.id)
        await self._save(entry)

    async def _undo_start(self, entry: RecordingEntry) -> None:
        try:
            await self._threads.run(self.library.discard, entry.id)
        except (OSError, Unavailable) as error:
            self.log.error(
                "recording {id} did not begin, and its description stays: {reason}",
                id=entry.id,
                reason=str(error),
            )

    async def _save(self, entry: RecordingEntry) -> bool:
        """Save a recording's description; returns whether that worked."""
        try:
            # One at a time: two threads would write the same file.
            async with self._saving.setdefault(entry.id, DeferredLock()):
                await self._threads.run(self.library.save, entry.id, text_of(entry))
        except (OSError, Unavailable) as error:
            self.log.error(
                "the description of recording {id} cannot be saved: {reason}", id=entry.id, reason=str(error)
            )
            return False
        return True

    def _check_begun(self, entry: RecordingEntry) -> None:
        if entry.id in self._starting:
            raise Unavailable("it is just starting; try again in a moment")

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

    # --- files --------------------------------------------------------------------------------------------

    async def delete(self, entry: RecordingEntry) -> None:
        """Delete a recording that does not run.

        :raises Unavailable: it cannot be deleted
        """
        self._check_begun(entry)
        if self._repair.current is entry:
            raise Unavailable("it is being recovered; try again in a moment")
        self._deleting.add(entry.id)
        try:
            await shield(Deferred.fromCoroutine(self._delete(entry)))
        except OSError as error:
            raise Unavailable(f"the recording cannot be deleted: {error.strerror}") from None

    async def _delete(self, entry: RecordingEntry) -> None:
        # Finished even if the client has left: a half-deleted recording would be missing in every count.
        try:
            await self._archive.withdraw(entry)
            await self._contents.run(self.library.delete, entry.id)
            self.library.forget(entry)
        except BaseException:
            self._archive.add(entry)
            raise
        finally:
            self._deleting.discard(entry.id)

    async def open_content(self, entry: RecordingEntry) -> ContentReader:
        """The file of a finished recording; it must be closed.

        :raises OSError: it cannot be opened
        :raises Unavailable: too many are being read
        """
        content = await open_in_thread(self._contents, self.library.open_content, entry)
        return ContentReader(self._contents, content)

    async def read(self, entry: RecordingEntry, content: ContentReader, offset: int, size: int) -> bytes:
        """A part of a recording's file; none when it has been deleted.

        :raises OSError: it cannot be read
        """
        await self._read_slots.acquire()
        # A client that leaves keeps its slot until the thread is done, so reconnecting does not fill the
        # queue.
        return await shield(Deferred.fromCoroutine(self._read_in_slot(entry, content, offset, size)))

    async def _read_in_slot(
        self, entry: RecordingEntry, content: ContentReader, offset: int, size: int
    ) -> bytes:
        try:
            return await content.part(offset, size) if self.library.has(entry) else b""
        finally:
            self._read_slots.release()


def _camera(name: str) -> str:
    """A camera's full name; the leading slash may be missing.

    :raises Invalid: it is not a valid name
    """
    full = name if name.startswith("/") else f"/{name}"
    if not full.strip("/") or len(full) > NAME or not is_printable(full):
        raise Invalid(f"the name of a camera may have at most {NAME} printable characters")
    return full
