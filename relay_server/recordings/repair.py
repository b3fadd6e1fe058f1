"""Makes readable what broke off: one file after the other, where the disk has room for a copy."""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Awaitable, Callable
from typing import NamedTuple

from twisted.internet.defer import Deferred, DeferredLock, succeed
from twisted.logger import Logger

from relay_protocol.errors import Unavailable
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.database import BoundedThreadPool
from relay_server.recordings.library import Library, RecordingEntry, RecordingState
from relay_server.recordings.mcap_file import repair_file
from relay_server.recordings.writer import NEARLY_FULL

PAUSE_SECONDS = 60.0
TRIES = 3
"""What breaks off while the relay runs is mended after a pause, so often; then again whenever all are."""

NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT})
"""What has none is tried again after each pause until it has, and that does not count as a try."""

LOOK_SECONDS = 1.0
"""How often the disk is looked at while a file is copied."""


class Mended(NamedTuple):
    """What came of a file.

    :param messages: that are in it now
    :param size: bytes
    :param written: when the last of it had been written, Unix seconds
    """

    messages: int
    size: int
    written: float


class Repair:
    """Looks after the recordings of a library that are incomplete.

    :param stopping: set when the relay goes down
    :param busy: whether something else is done with the files of a recording just now
    :param save: puts on the disk what a recording has become
    :param drop: takes one off the disk that never had a file
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        library: Library,
        threads: BoundedThreadPool,
        stopping: threading.Event,
        *,
        busy: Callable[[RecordingEntry], bool],
        save: Callable[[RecordingEntry], Awaitable[object]],
        drop: Callable[[RecordingEntry], Awaitable[None]],
    ) -> None:
        self._clock = clock
        self._library = library
        self._threads = threads
        self._stopping = stopping
        self._busy = busy
        self._save = save
        self._drop = drop
        self._one_at_a_time = DeferredLock()
        self._timers: dict[str, Timer] = {}
        self._lacking: set[str] = set()
        """Those that wait for room: that is logged once."""
        self.current: RecordingEntry | None = None
        """What is being mended, or is about to be."""
        self.done: Deferred[None] = succeed(None)
        """Fires when all has been tried that was asked for last."""

    def recover(self) -> None:
        """Begin to mend all that is incomplete; nothing, if that is under way."""
        if self.done.called:
            self.done = Deferred.fromCoroutine(self._recover())

    def later(self, entry: RecordingEntry, tries: int = TRIES) -> None:
        """A recording broke off: mend it after a pause."""
        if not self._stopping.is_set():
            cancel(self._timers.get(entry.id))
            self._timers[entry.id] = self._clock.callLater(PAUSE_SECONDS, self._again, entry, tries)

    def shut(self) -> None:
        """Begin nothing more."""
        for timer in self._timers.values():
            cancel(timer)
        self._timers.clear()

    def _again(self, entry: RecordingEntry, tries: int) -> None:
        del self._timers[entry.id]
        Deferred.fromCoroutine(self._try(entry, tries - 1))

    async def _recover(self) -> None:
        for entry in self._library.incomplete():
            await self._try(entry)

    def _open(self, entry: RecordingEntry) -> bool:
        return (
            self._library.has(entry)
            and entry.state is RecordingState.INCOMPLETE
            and not self._stopping.is_set()
        )

    async def _try(self, entry: RecordingEntry, more: int = 0) -> None:
        """Mend one, if nothing is in the way.

        :param more: tries there are after this one
        """
        async with self._one_at_a_time:
            if not self._open(entry):
                self._lacking.discard(entry.id)
                return
            if self._busy(entry):
                return
            self.current = entry
            try:
                room = await self._has_room(entry)
            finally:
                self.current = None
            if not self._open(entry):
                return
            if not room and entry.id not in self._timers:
                self.later(entry, more + 1)
            elif more:
                self.later(entry, more)

    async def _has_room(self, entry: RecordingEntry) -> bool:
        """Mend one, if that can be done; whether there is room for it."""
        error: OSError | Unavailable | None = None
        try:
            await self._mend(entry)
        except (OSError, Unavailable) as found:
            error = found
        except Exception:
            # Whatever this one has, others may be better.
            self.log.failure("recording {id} is not recovered", id=entry.id)
        lacking = isinstance(error, OSError) and error.errno in NO_ROOM
        if error is not None and not (lacking and entry.id in self._lacking):
            reason = error.strerror if isinstance(error, OSError) else str(error)
            self.log.error("recording {id} is not recovered: {reason}", id=entry.id, reason=reason)
        if lacking:
            self._lacking.add(entry.id)
        else:
            self._lacking.discard(entry.id)
        return not lacking

    async def _mend(self, entry: RecordingEntry) -> None:
        # The copy takes room beside the file. Asked of the disk, not of what recordings may have in all: else one
        # that has more than half of that would be lost.
        self._library.copied = entry
        try:
            mended = await self._threads.run(self._work, entry)
        except FileNotFoundError:
            # It had just been wanted.
            await self._drop(entry)
            self._library.forget(entry)
            return
        finally:
            self._library.copied = None
        if mended is not None:
            entry.messages, entry.bytes = mended.messages, mended.size
            entry.state, entry.ended = RecordingState.RECOVERED, entry.ended or mended.written
            self.log.info(
                "recording {id} was recovered: {count} messages", id=entry.id, count=mended.messages
            )
            await self._save(entry)

    # --- in a thread --------------------------------------------------------------------------------------

    def _work(self, entry: RecordingEntry) -> Mended | None:
        """What became of the file; ``None`` when the relay goes down before.

        :raises OSError: it can't be mended; :class:`FileNotFoundError` when there is none
        """
        path = self._library.path(entry)
        found = path.stat()
        if self._library.spare() < found.st_size:
            raise OSError(
                errno.ENOSPC, f"{NEARLY_FULL}: a copy of {found.st_size / 10**6:.0f} MB has no room"
            )
        watch = _Watch(self._library, self._stopping)
        messages = repair_file(path, watch)
        if messages is None and watch.nearly_full:
            raise OSError(errno.ENOSPC, NEARLY_FULL)
        return None if messages is None else Mended(messages, path.stat().st_size, found.st_mtime)


class _Watch:
    """Says when a copy has to stop: the relay goes down, or others have taken the room."""

    def __init__(self, library: Library, stopping: threading.Event) -> None:
        self._library = library
        self._stopping = stopping
        self._look_at = time.monotonic() + LOOK_SECONDS
        self.nearly_full = False

    def __call__(self) -> bool:
        now = time.monotonic()
        if now >= self._look_at:
            self._look_at = now + LOOK_SECONDS
            self.nearly_full = self._library.nearly_full()
        return self.nearly_full or self._stopping.is_set()
