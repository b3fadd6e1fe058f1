"""Storage of the contents of files, and the one in a folder of the relay. Their methods block, and run in threads."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Generic, Protocol, TypeVar

from twisted.internet.defer import Deferred

from relay_protocol.limits import MIB
from relay_server.common.concurrency import shield
from relay_server.common.database import BoundedThreadPool

FOLDERS = 256
"""Folders over which contents are spread."""


class Closable(Protocol):
    """An open file."""

    def close(self) -> None:
        """Close it."""


C = TypeVar("C", bound=Closable)


async def open_in_thread(pool: BoundedThreadPool, work: Callable[..., C], *arguments: object) -> C:
    """Open something in a thread. It is closed if its caller leaves meanwhile.

    :raises OSError: it can't be opened
    :raises Unavailable: too much work waits
    """
    opening = _Opening(work, arguments)
    try:
        return await pool.run(opening.run)
    except BaseException:
        opening.abandon()
        raise


class _Opening(Generic[C]):
    """Something that is being opened; may be used in any thread."""

    def __init__(self, work: Callable[..., C], arguments: tuple[object, ...]) -> None:
        self._work = work
        self._arguments = arguments
        self._lock = threading.Lock()
        self._opened: C | None = None
        self._abandoned = False

    def run(self) -> C:
        opened = self._work(*self._arguments)
        with self._lock:
            self._opened = opened
            if self._abandoned:
                opened.close()
        return opened

    def abandon(self) -> None:
        with self._lock:
            self._abandoned = True
            if self._opened is not None:
                self._opened.close()


class StoredContent(Protocol):
    """The contents of one file, open for reading."""

    def read(self, offset: int, size: int) -> bytes:
        """Some bytes; fewer at the end.

        :raises OSError: they can't be read
        """

    def close(self) -> None:
        """End reading."""


def hash_of_stored(storage: FileStorage, key: str) -> str:
    """SHA-256 of contents that are stored, hexadecimal.

    :raises OSError: they can't be read
    """
    digest, offset, content = hashlib.sha256(), 0, storage.open(key)
    try:
        while part := content.read(offset, MIB):
            digest.update(part)
            offset += len(part)
    finally:
        content.close()
    return digest.hexdigest()


class ContentReader:
    """Reads contents for one receiver, which must close it. A thread that still reads then closes them.

    :param pool: of the threads that read
    """

    def __init__(self, pool: BoundedThreadPool, content: StoredContent) -> None:
        self._pool = pool
        self._content = content
        self._reading = 0
        self._closed = False

    async def part(self, offset: int, size: int) -> bytes:
        """Some bytes; fewer at the end.

        :raises OSError: they can't be read
        :raises Unavailable: too much work waits
        """
        return await shield(Deferred.fromCoroutine(self._read(offset, size)))

    async def _read(self, offset: int, size: int) -> bytes:
        self._reading += 1
        try:
            return await self._pool.run(self._content.read, offset, size)
        finally:
            self._reading -= 1
            if self._closed and not self._reading:
                self._content.close()

    def close(self) -> None:
        """End reading."""
        if self._closed:
            return
        self._closed = True
        if not self._reading:
            self._content.close()


class StoringStopped(OSError):
    """Storing was stopped before its end."""


def never() -> bool:
    """Storing is not stopped."""
    return False


class FileStorage(Protocol):
    """Keeps contents by key."""

    def store(self, source: Path, key: str, stopping: Callable[[], bool] = never) -> None:
        """Move a file into the storage. When this returns, the contents survive a loss of power.

        :param stopping: asked again and again; when true, storing ends
        :raises StoringStopped: it was stopped; the source is still there
        :raises OSError: it can't be stored; the source is still there
        """

    def size(self, key: str) -> int | None:
        """Bytes of stored contents, ``None`` if there are none.

        :raises OSError: the storage does not answer
        """

    def open(self, key: str) -> StoredContent:
        """Open contents for reading.

        :raises OSError: they can't be opened
        """

    def delete(self, key: str) -> None:
        """Delete contents, if there are any.

        :raises OSError: they can't be deleted
        """


class LocalContent:
    """A file of a disk, open for reading.

    :raises OSError: it can't be opened
    """

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)

    def read(self, offset: int, size: int) -> bytes:
        """See :class:`StoredContent`."""
        return os.pread(self._file, size, offset)

    def close(self) -> None:
        """End reading."""
        os.close(self._file)


class LocalStorage:
    """A folder on the disk that also holds incoming files."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def store(self, source: Path, key: str, stopping: Callable[[], bool] = never) -> None:
        """See :meth:`FileStorage.store`. Renaming is quick, and is not stopped."""
        target = self._path(key)
        if not target.parent.is_dir():
            target.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            sync_folder(self._folder)
        source.replace(target)
        sync_folder(target.parent)

    def size(self, key: str) -> int | None:
        """See :meth:`FileStorage.size`."""
        try:
            return self._path(key).stat().st_size
        except FileNotFoundError:
            return None

    def open(self, key: str) -> StoredContent:
        """See :meth:`FileStorage.open`."""
        return LocalContent(self._path(key))

    def delete(self, key: str) -> None:
        """See :meth:`FileStorage.delete`."""
        with contextlib.suppress(FileNotFoundError):
            self._path(key).unlink()

    def _path(self, key: str) -> Path:
        return self._folder / place_of(key)


def place_of(key: str) -> str:
    """The path of a file's contents below a folder: the same in all kinds of storage."""
    return f"{int(key) % FOLDERS:02x}/{int(key)}"


def sync_folder(folder: Path) -> None:
    """Make changes of a folder's entries durable.

    :raises OSError: that failed
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def free_bytes(folder: Path) -> int:
    """Free bytes of a folder's disk.

    :raises OSError: the folder can't be read
    """
    return shutil.disk_usage(folder).free
