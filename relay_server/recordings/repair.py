"""Repairs recordings that broke off: one file after the other, when the disk has space for a copy."""

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
"""A recording that breaks off while the relay runs is repaired after a pause, with this many tries."""

NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Without space for a copy a file is tried again after each pause, which does not count as a try."""

CHECK_SECONDS = 1.0
"""How often the free space is checked while a file is copied."""


class RepairResult(NamedTuple):
    """The result for one file.

    :param messages: number of messages in it now
    :param size: bytes
    :param written: when its last message was written, Unix seconds
    """

    messages: int
    size: int
    written: float


class Repair:
    """Repairs the incomplete recordings of a library.

    :param stopping: set when the relay shuts down
    :param busy: whether another file operation of a recording runs
    :param save: saves the description of a recording
    :param drop: deletes a recording that never had a file
    :param repaired: called with each recording that can be read again
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
        repaired: Callable[[RecordingEntry], None],
    ) -> None:
        self._clock = clock
        self._library = library
        self._threads = threads
        self._stopping = stopping
        self._busy = busy
        self._save = save
        self._drop = drop
        self._repaired = repaired
        self._one_at_a_time = DeferredLock()
        self._timers: dict[str, Timer] = {}
        self._without_space: set[str] = set()
        """Recordings that wait for space; that is logged once."""
        self.current: RecordingEntry | None = None
        """The recording that is being repaired, or comes next."""
        self.done: Deferred[None] = succeed(None)
        """Fires when everything that was requested has been tried."""

    def recover(self) -> None:
        """Begin to repair all that is incomplete, unless that is in progress."""
        if self.done.called:
            self.done = Deferred.fromCoroutine(self._recover())

    def later(self, entry: RecordingEntry, tries: int = TRIES) -> None:
        """A recording broke off: repair it after a pause."""
        if not self._stopping.is_set():
            cancel(self._timers.get(entry.id))
            self._timers[entry.id] = self._clock.callLater(PAUSE_SECONDS, self._retry, entry, tries)

    def shut(self) -> None:
        """Begin nothing more."""
        for timer in self._timers.values():
            cancel(timer)
        self._timers.clear()

    def _retry(self, entry: RecordingEntry, tries: int) -> None:
        del self._timers[entry.id]
        Deferred.fromCoroutine(self._attempt(entry, tries - 1))

    async def _recover(self) -> None:
        for entry in self._library.incomplete():
            await self._attempt(entry)

    def _open(self, entry: RecordingEntry) -> bool:
        return (
            self._library.has(entry)
            and entry.state is RecordingState.INCOMPLETE
            and not self._stopping.is_set()
        )

    async def _attempt(self, entry: RecordingEntry, more: int = 0) -> None:
        """Repair one, if nothing else uses it.

        :param more: tries left after this one
        """
        async with self._one_at_a_time:
            if not self._open(entry):
                self._without_space.discard(entry.id)
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
        """Repair one if possible; returns whether there was space for it."""
        error: OSError | Unavailable | None = None
        try:
            await self._repair(entry)
        except (OSError, Unavailable) as found:
            error = found
        except Exception:
            # An error of one file must not stop the others.
            self.log.failure("recording {id} is not recovered", id=entry.id)
        lacking = isinstance(error, OSError) and error.errno in NO_ROOM
        if error is not None and not (lacking and entry.id in self._without_space):
            reason = error.strerror if isinstance(error, OSError) else str(error)
            self.log.error("recording {id} is not recovered: {reason}", id=entry.id, reason=reason)
        if lacking:
            self._without_space.add(entry.id)
        else:
            self._without_space.discard(entry.id)
        return not lacking

    async def _repair(self, entry: RecordingEntry) -> None:
        # The copy takes space beside the file. The disk is asked, not the quota: otherwise a recording that
        # has more than half of the quota would be lost.
        self._library.copied = entry
        try:
            mended = await self._threads.run(self._repair_in_thread, entry)
        except FileNotFoundError:
            # It had just been deleted.
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
            self._repaired(entry)

    # --- in a thread --------------------------------------------------------------------------------------

    def _repair_in_thread(self, entry: RecordingEntry) -> RepairResult | None:
        """The result for a file; ``None`` when the relay shuts down meanwhile.

        :raises OSError: it cannot be repaired; :class:`FileNotFoundError` when there is none
        """
        path = self._library.path(entry)
        found = path.stat()
        if self._library.spare() < found.st_size:
            raise OSError(
                errno.ENOSPC, f"{NEARLY_FULL}: there is no space for a copy of {found.st_size / 10**6:.0f} MB"
            )
        watch = _StopCheck(self._library, self._stopping)
        messages = repair_file(path, watch)
        if messages is None and watch.nearly_full:
            raise OSError(errno.ENOSPC, NEARLY_FULL)
        return None if messages is None else RepairResult(messages, path.stat().st_size, found.st_mtime)


class _StopCheck:
    """Decides when a copy has to stop: the relay shuts down, or the space is used up."""

    def __init__(self, library: Library, stopping: threading.Event) -> None:
        self._library = library
        self._stopping = stopping
        self._check_at = time.monotonic() + CHECK_SECONDS
        self.nearly_full = False

    def __call__(self) -> bool:
        now = time.monotonic()
        if now >= self._check_at:
            self._check_at = now + CHECK_SECONDS
            self.nearly_full = self._library.nearly_full()
        return self.nearly_full or self._stopping.is_set()
