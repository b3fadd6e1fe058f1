"""All recordings of a relay: those that run, and those in the library."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta
from twisted.internet.defer import Deferred, DeferredList, TimeoutError, succeed
from twisted.logger import Logger

from relay_protocol.errors import Invalid, Refused, Unavailable
from relay_protocol.limits import NAME
from relay_server.access import Permit
from relay_server.channel import Channels, resolve
from relay_server.clock import Clock, as_twisted
from relay_server.recording import compressed
from relay_server.recording.library import Entry, Library, State, text_of
from relay_server.recording.mcap_file import mend
from relay_server.recording.recorder import Recorder, why_denied
from relay_server.recording.writer import Outcome, Writer
from relay_server.registry import Presence
from relay_server.sight import carries_pictures
from relay_server.store import Threads
from relay_server.video import Videos

ROBOT_RECORDINGS = 8
USER_RECORDINGS = 4
RECORDINGS = 16
"""Recordings that may run on one robot, for one user, and in all; each has a thread and a queue."""

THREADS = 2
WAITING = 64
"""Pieces of work on files that may be under way or wait."""

FINISH_SECONDS = 5.0
"""A relay that is going down waits no longer for the disk."""

SECONDS = 86400.0
MEGABYTES = 100_000

_Name = Annotated[str, Meta(min_length=1, max_length=NAME)]


class Ask(msgspec.Struct, forbid_unknown_fields=True):
    """What is to be recorded.

    :param seconds: it may take
    :param megabytes: the file may have, each of 10⁶ bytes
    """

    topics: Annotated[list[_Name], Meta(max_length=64)] = []
    cameras: Annotated[list[_Name], Meta(max_length=8)] = []
    seconds: Annotated[float, Meta(ge=1, le=SECONDS)] = 600.0
    megabytes: Annotated[float, Meta(ge=1, le=MEGABYTES)] = 1000.0


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
        videos: Videos,
        wall: Callable[[], float],
    ) -> None:
        self._reactor = reactor
        self._clock = clock
        self.library = library
        self._channels = channels
        self._videos = videos
        self._wall = wall
        self._running: dict[str, Recorder] = {}
        self._ended: dict[str, list[Callable[[Entry], None]]] = {}
        self._stopping = threading.Event()
        self._mending: Entry | None = None
        self.mended: Deferred[None] = succeed(None)
        """Fires when all is readable that can be."""
        self._threads = Threads(
            reactor, "recordings", THREADS, WAITING, "too much is done with recordings now; try again"
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
        self.mended = Deferred.fromCoroutine(self._mend_all()).addErrback(
            lambda failure: self.log.failure("recordings could not be mended", failure)
        )

    async def shut(self, reason: str) -> None:
        """Finish all that run."""
        self._stopping.set()
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

    def entry(self, ask: Ask, robot: Presence, permit: Permit) -> Entry:
        """What a recording would be.

        :raises Invalid: there is nothing to record, a bad name, or something would be recorded twice
        """
        topics = tuple(dict.fromkeys(resolve(topic) for topic in ask.topics))
        cameras = tuple(dict.fromkeys(ask.cameras))
        if not topics and not cameras:
            raise Invalid("say what to record: 'topics', 'cameras' or both")
        written = [compressed.topic_of(camera) for camera in cameras]
        twice = [topic for topic in written if topic in topics or written.count(topic) > 1]
        if twice:
            raise Invalid(f"{twice[0]} would be recorded twice, as a camera's pictures too")
        begun = self._wall()
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(begun))
        return Entry(
            id=f"{stamp}-{secrets.token_hex(4)}",
            robot_id=robot.robot_id,
            robot=robot.name,
            user_id=permit.principal.user_id,
            user=permit.principal.name,
            topics=topics,
            cameras=cameras,
            begun=begun,
            seconds=ask.seconds,
            pictures=tuple(topic for topic in topics if carries_pictures(robot, topic)),
            limit=round(ask.megabytes * 10**6),
        )

    async def start(
        self, entry: Entry, robot: Presence, permit: Permit, ended: Callable[[Entry], None]
    ) -> None:
        """Begin a recording.

        :param ended: called once when it is over, if it has begun
        :raises Unavailable: too many run, there is no room, or the disk can't be written
        :raises SwitchboardError: something can't be recorded
        """
        self._check_room(entry)
        self.library.add(entry)
        try:
            await self._threads.run(self.library.save, entry.id, text_of(entry))
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
        self._ended[entry.id] = [ended]

    def stop(self, entry: Entry, reason: str) -> Deferred[None]:
        """Finish a recording; fires when it has."""
        done: Deferred[None] = Deferred()
        running = self._running.get(entry.id)
        if running is None:
            done.callback(None)
        else:
            self._ended[entry.id].append(lambda _: done.callback(None))
            running.stop(reason)
        return done

    def look(self, entry: Entry) -> Entry:
        """A recording, brought up to date."""
        running = self._running.get(entry.id)
        if running is not None:
            running.count()
        return entry

    def _recorder(self, entry: Entry, robot: Presence, permit: Permit) -> Recorder:
        path = self.library.path(entry)
        ros = not robot.encodings or "cdr" in robot.encodings

        def make_writer(ended: Callable[[Outcome], None]) -> Writer:
            return Writer(self._reactor, path, entry.limit, ros, ended)

        recorder = self._running[entry.id] = Recorder(
            self._clock,
            entry,
            permit,
            self._channels.of(robot),
            self._videos,
            make_writer,
            wall=self._wall,
            ended=self._over,
        )
        return recorder

    def _over(self, recorder: Recorder) -> None:
        entry = recorder.entry
        saving = Deferred.fromCoroutine(self._save(entry))

        def told(_: object) -> None:
            del self._running[entry.id]
            for each in self._ended.pop(entry.id):
                each(entry)

        saving.addBoth(told)

    async def _take_back(self, entry: Entry) -> None:
        try:
            await self._threads.run(self.library.delete, entry.id)
        except (OSError, Unavailable) as error:
            self.log.error(
                "recording {id} did not begin, and stays: {reason}", id=entry.id, reason=str(error)
            )

    async def _save(self, entry: Entry) -> None:
        try:
            await self._threads.run(self.library.save, entry.id, text_of(entry))
        except (OSError, Unavailable) as error:
            self.log.error("recording {id} can't be put on record: {reason}", id=entry.id, reason=str(error))

    def _check_room(self, entry: Entry) -> None:
        running = [recorder.entry for recorder in self._running.values()]
        if len(running) >= RECORDINGS:
            raise Unavailable(f"{RECORDINGS} recordings run, the most there may be")
        if sum(each.robot_id == entry.robot_id for each in running) >= ROBOT_RECORDINGS:
            raise Unavailable(f"{ROBOT_RECORDINGS} recordings of this robot run, the most there may be")
        if sum(each.user_id == entry.user_id for each in running) >= USER_RECORDINGS:
            raise Unavailable(f"you have {USER_RECORDINGS} recordings running, the most one user may have")

    # --- what is kept -------------------------------------------------------------------------------------

    async def delete(self, entry: Entry) -> None:
        """Take a recording that does not run off the disk.

        :raises Unavailable: it can't be deleted
        """
        if self._mending is entry:
            raise Unavailable("it is being recovered; try again in a moment")
        try:
            await self._threads.run(self.library.delete, entry.id)
        except OSError as error:
            raise Unavailable(f"the recording can't be deleted: {error.strerror}") from None
        self.library.forget(entry)

    async def read(self, path: Path, offset: int, size: int) -> bytes:
        """A part of a file.

        :raises OSError: it can't be read
        """

        def work() -> bytes:
            # Opened for each part: who downloads may be gone before the thread is done.
            with path.open("rb") as file:
                file.seek(offset)
                return file.read(size)

        return await self._threads.run(work)

    async def _mend_all(self) -> None:
        for entry in self.library.incomplete():
            if self.library.has(entry) and not self._stopping.is_set():
                self._mending = entry
                try:
                    await self._mend(entry)
                except (OSError, Unavailable) as error:
                    self.log.error(
                        "recording {id} is not recovered: {reason}", id=entry.id, reason=str(error)
                    )
                finally:
                    self._mending = None

    async def _mend(self, entry: Entry) -> None:
        path = self.library.path(entry)
        try:
            messages = await self._threads.run(mend, path, self._stopping.is_set)
        except FileNotFoundError:
            # It had just been wanted.
            await self._take_back(entry)
            self.library.forget(entry)
            return
        if messages is not None:
            found = path.stat()
            entry.messages, entry.bytes = messages, found.st_size
            entry.state, entry.ended = State.RECOVERED, entry.ended or found.st_mtime
            self.log.info("recording {id} was recovered: {count} messages", id=entry.id, count=messages)
            await self._save(entry)
