"""Moves finished recordings from the relay's disk into the storage of files, one after the other."""

from __future__ import annotations

import threading
from collections.abc import Awaitable, Callable

from twisted.internet.defer import Deferred, DeferredLock, succeed
from twisted.logger import Logger

from relay_protocol.errors import Unavailable
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.database import BoundedThreadPool
from relay_server.files.storage import StoringStopped
from relay_server.recordings.library import READABLE, Library, RecordingEntry

RETRY_SECONDS = 60.0
"""Seconds until recordings that could not be moved are tried again."""


class RecordingArchive:
    """Moves recordings; does nothing if they stay on the relay's disk.

    A recording is on the disk until the storage has all of it, so the relay may die at any moment:
    :meth:`recover` goes on.

    :param stopping: set when the relay shuts down
    :param save: saves the description of a recording; returns whether that worked
    :ivar done: fires when everything that waits has been tried
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        library: Library,
        threads: BoundedThreadPool,
        stopping: threading.Event,
        save: Callable[[RecordingEntry], Awaitable[bool]],
    ) -> None:
        self._clock = clock
        self._library = library
        self._threads = threads
        self._stopping = stopping
        self._save = save
        self._waiting: dict[str, RecordingEntry] = {}
        self._one_at_a_time = DeferredLock()
        self._withdrawn = threading.Event()
        """Set when the recording that is being moved is withdrawn."""
        self._moving: RecordingEntry | None = None
        self._retry: Timer | None = None
        self._failing = False
        self.done: Deferred[None] = succeed(None)

    def add(self, entry: RecordingEntry) -> None:
        """Move a recording soon, if it is finished."""
        if self._library.has_storage and entry.state in READABLE:
            self._waiting[entry.id] = entry
            self._begin()

    async def recover(self) -> None:
        """Add all finished recordings that are on the disk."""
        if not self._library.has_storage:
            return
        try:
            found = await self._threads.run(self._library.on_disk)
        except (OSError, Unavailable) as error:
            self.log.error("recordings stay on the disk for now: {reason}", reason=str(error))
            return
        for entry in self._library:
            if entry.id in found and entry is not self._moving:
                self.add(entry)

    async def withdraw(self, entry: RecordingEntry) -> None:
        """End moving a recording; returns when no thread uses its file."""
        self._waiting.pop(entry.id, None)
        if self._moving is entry:
            self._withdrawn.set()
            async with self._one_at_a_time:
                pass

    def shut(self) -> None:
        """Begin nothing more."""
        cancel(self._retry)
        self._waiting.clear()

    def _begin(self) -> None:
        if self.done.called and not self._stopping.is_set():
            cancel(self._retry)
            self.done = Deferred.fromCoroutine(self._run())

    async def _run(self) -> None:
        """Try all recordings that wait. Those that can't be moved wait again."""
        failed: dict[str, RecordingEntry] = {}
        while self._waiting and not self._stopping.is_set():
            entry = self._waiting.pop(next(iter(self._waiting)))
            async with self._one_at_a_time:
                self._moving = entry
                self._withdrawn.clear()
                moved = await self._move(entry)
                self._moving = None
                if not moved and not self._withdrawn.is_set():
                    failed[entry.id] = entry
        if failed and not self._stopping.is_set():
            self._waiting.update(failed)
            self._retry = self._clock.callLater(RETRY_SECONDS, self._begin)

    async def _move(self, entry: RecordingEntry) -> bool:
        """Move one; returns whether it need not be tried again."""
        if not self._library.has(entry):
            return True
        # The next relay must know that it is finished, since it finds no file to repair.
        if not await self._save(entry):
            return False
        try:
            await self._threads.run(
                self._library.move, entry, lambda: self._stopping.is_set() or self._withdrawn.is_set()
            )
        except StoringStopped:
            return False
        except (OSError, Unavailable) as error:
            if not self._failing:
                self._failing = True
                self.log.error(
                    "recording {id} stays on the disk for now: {reason}", id=entry.id, reason=str(error)
                )
            return False
        except Exception:
            # An error of one file must not stop the others.
            self.log.failure("recording {id} is not moved into the storage", id=entry.id)
            return False
        self._failing = False
        return True
