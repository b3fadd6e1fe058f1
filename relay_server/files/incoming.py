"""Files that are being received: each is a file of its own in a folder, and its size is how far the upload has come.

All functions block, and run in threads.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from pathlib import Path

from relay_protocol.limits import MIB
from relay_server.files.storage import FileStorage, free_bytes, hash_of_stored, sync_folder


class DiskFull(OSError):
    """The disk has no space to spare for a file."""


class WrongContents(Exception):
    """The received bytes differ from the offered file."""


class IncomingFolder:
    """The folder of incoming files.

    :param reserve: bytes of the disk that stay free for other data of the relay
    """

    def __init__(self, folder: Path, storage: FileStorage, reserve: int) -> None:
        self._folder = folder
        self._storage = storage
        self._reserve = reserve

    def open(self, key: str, size: int) -> IncomingFile:
        """Open an incoming file. One that was received in part is continued.

        :raises DiskFull: the rest of it does not fit
        :raises OSError: it can't be opened
        """
        path = self._path(key)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            received = os.fstat(descriptor).st_size
            if received > size:
                os.ftruncate(descriptor, 0)
                received = 0
            self.check_space(size - received)
        except BaseException:
            os.close(descriptor)
            raise
        return IncomingFile(self, path, descriptor, received)

    def check_space(self, size: int) -> None:
        """:raises DiskFull: the disk has no room for so many bytes"""
        if free_bytes(self._folder) - self._reserve < size:
            raise DiskFull("the relay's disk is full")

    def store(self, file: IncomingFile, key: str, size: int, sha256: str) -> None:
        """Make a file that is complete durable, check its contents, and move it into the storage.

        :raises WrongContents: it has other contents than offered; it is empty again
        :raises OSError: it can't be stored
        """
        if file.received != size or file.sync_and_hash() != sha256:
            file.clear()
            raise WrongContents
        file.close()
        sync_folder(self._folder)
        self._storage.store(file.path, key)
        sync_folder(self._folder)

    def hash_of(self, source: Path) -> tuple[str, int]:
        """SHA-256 and bytes of a file.

        :raises OSError: it can't be read
        """
        digest, size = hashlib.sha256(), 0
        with source.open("rb") as stream:
            while part := stream.read(MIB):
                digest.update(part)
                size += len(part)
        return digest.hexdigest(), size

    def copy(self, source: Path, storage: FileStorage, key: str, size: int, sha256: str) -> None:
        """Store a copy of a file.

        :raises OSError: it can't be stored, or has changed since it was hashed
        """
        if storage.size(key) == size and hash_of_stored(storage, key) == sha256:
            return
        self.delete(key)
        file = self.open(key, size)
        try:
            with source.open("rb") as stream:
                while part := stream.read(MIB):
                    file.write(part)
            self.store(file, key, size, sha256)
        except WrongContents:
            raise OSError("it has changed meanwhile") from None
        finally:
            file.close()

    def delete(self, key: str) -> None:
        """Delete an incoming file, if there is one.

        :raises OSError: it can't be deleted
        """
        with contextlib.suppress(FileNotFoundError):
            self._path(key).unlink()

    def prepare(self) -> None:
        """Make the folder.

        :raises OSError: it can't be made
        """
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)

    def _path(self, key: str) -> Path:
        return self._folder / str(int(key))


class IncomingFile:
    """One incoming file, open for writing.

    :ivar received: bytes that are written
    """

    def __init__(self, folder: IncomingFolder, path: Path, descriptor: int, received: int) -> None:
        self.path = path
        self.received = received
        self._folder = folder
        self._descriptor: int | None = descriptor

    def write(self, data: bytes) -> None:
        """Write the next bytes.

        :raises DiskFull: the disk has no space to spare
        :raises OSError: they can't be written
        """
        assert self._descriptor is not None
        self._folder.check_space(len(data))
        left = memoryview(data)
        while left:
            written = os.pwrite(self._descriptor, left, self.received)
            self.received += written
            left = left[written:]

    def sync_and_hash(self) -> str:
        """Make the contents durable, and read them back.

        :returns: their SHA-256
        :raises OSError: the disk failed
        """
        assert self._descriptor is not None
        try:
            os.fsync(self._descriptor)
        except OSError:
            # The kernel has dropped the pages, and a second fsync would succeed: the contents can't be continued.
            with contextlib.suppress(OSError):
                self.path.unlink()
            raise
        digest, offset = hashlib.sha256(), 0
        while part := os.pread(self._descriptor, MIB, offset):
            digest.update(part)
            offset += len(part)
        return digest.hexdigest()

    def clear(self) -> None:
        """Begin again with nothing.

        :raises OSError: the disk failed
        """
        assert self._descriptor is not None
        os.ftruncate(self._descriptor, 0)
        self.received = 0

    def close(self) -> None:
        """End writing; what is written stays."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)
