"""Contents of files in an S3-compatible storage. All methods block, and run in threads."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from os import environ
from pathlib import Path
from typing import Any, BinaryIO

from relay_protocol.errors import Invalid
from relay_protocol.limits import MIB
from relay_server.files.storage import StoredContent, StoringStopped, never, place_of

SCHEME = "s3://"
PART_BYTES = 8 * MIB
"""A larger file is uploaded in parts, of which some are under way at a time."""

PARTS_AT_ONCE = 4
READ_BYTES = 2 * MIB
"""Bytes of one request while a file is read."""

CLIENT: Any = {"timeout": "120s", "connect_timeout": "10s"}
"""A request carries one part at most."""


RETRY: Any = {"max_retries": 3, "retry_timeout": timedelta(seconds=30)}


class ObjectStorage:
    """A bucket, or a folder of one. Credentials, region and endpoint are in the environment (``AWS_…``).

    The storage checks the SHA-256 of each part that it gets, and shows a file only when it has all of it.

    :param url: ``s3://bucket/folder``
    :param place: the path of contents by their key, below that folder
    :raises Invalid: it is no such URL, or the package for it is missing
    """

    def __init__(self, url: str, place: Callable[[str], str] = place_of) -> None:
        if not url.startswith(SCHEME) or url == SCHEME:
            raise Invalid(f"the storage of files must be such as s3://bucket/folder, not '{url[:100]}'")
        try:
            import obstore
            from obstore.store import S3Store
        except ImportError:
            raise Invalid("for a storage of files by S3: pip install 'robot-switchboard[s3]'") from None
        self._api: Any = obstore
        self._place = place
        try:
            self._store = S3Store.from_url(
                url,
                config={"checksum_algorithm": "SHA256"},
                client_options={**CLIENT, "allow_http": environ.get("AWS_ALLOW_HTTP", "") == "true"},
                retry_config=RETRY,
            )
        except obstore.exceptions.BaseError as error:
            raise Invalid(f"the storage of files can't be used: {_first_line(error)}") from None

    def store(self, source: Path, key: str, stopping: Callable[[], bool] = never) -> None:
        """See :meth:`relay_server.files.storage.FileStorage.store`. What is stopped leaves no parts behind."""
        size = source.stat().st_size
        with self._errors(), source.open("rb") as stream:
            sent = _Source(stream, stopping)
            try:
                self._api.put(
                    self._store, self._place(key), sent, chunk_size=PART_BYTES, max_concurrency=PARTS_AT_ONCE
                )
            except OSError:
                # obstore turns errors of a source into one of its own.
                if sent.stopped:
                    raise StoringStopped("storing was stopped") from None
                raise
        if self.size(key) != size:
            raise OSError(errno.EIO, "the storage has another size of a file than was sent")
        source.unlink()

    def size(self, key: str) -> int | None:
        """See :meth:`relay_server.files.storage.FileStorage.size`."""
        try:
            with self._errors():
                return int(self._api.head(self._store, self._place(key))["size"])
        except FileNotFoundError:
            return None

    def open(self, key: str) -> StoredContent:
        """See :meth:`relay_server.files.storage.FileStorage.open`."""
        with self._errors():
            size = int(self._api.head(self._store, self._place(key))["size"])
        return _ObjectContent(self, key, size)

    def delete(self, key: str) -> None:
        """See :meth:`relay_server.files.storage.FileStorage.delete`."""
        try:
            with self._errors():
                self._api.delete(self._store, self._place(key))
        except FileNotFoundError:
            return

    def read(self, key: str, offset: int, size: int) -> bytes:
        """Some bytes of stored contents.

        :raises OSError: they can't be read
        """
        with self._errors():
            return bytes(self._api.get_range(self._store, self._place(key), start=offset, length=size))

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Errors of the storage as those of a disk."""
        errors = self._api.exceptions
        try:
            yield
        except errors.NotFoundError as error:
            raise FileNotFoundError(errno.ENOENT, _first_line(error)) from None
        except errors.BaseError as error:
            words = f"the storage of files does not answer as it must: {_first_line(error)}"
            raise OSError(errno.EIO, words) from None


def _first_line(error: Exception) -> str:
    """An error in words, without the details below them."""
    return str(error).partition("\n")[0]


class _Source:
    """A file that is sent, as long as that is not stopped."""

    def __init__(self, stream: BinaryIO, stopping: Callable[[], bool]) -> None:
        self._stream = stream
        self._stopping = stopping
        self.stopped = False
        self.seek = stream.seek
        self.tell = stream.tell

    def read(self, size: int = -1) -> bytes:
        """The next bytes.

        :raises StoringStopped: nothing more is sent
        """
        if self._stopping():
            self.stopped = True
            raise StoringStopped("storing was stopped")
        return self._stream.read(size)


class _ObjectContent:
    """Contents that are read. Requests are larger than the pieces that are asked for."""

    def __init__(self, storage: ObjectStorage, key: str, size: int) -> None:
        self._storage = storage
        self._key = key
        self._size = size
        self._begin = 0
        self._held = b""

    def read(self, offset: int, size: int) -> bytes:
        """See :class:`relay_server.files.storage.StoredContent`."""
        stop = min(self._size, offset + size)
        if stop <= offset:
            return b""
        if not self._begin <= offset < stop <= self._begin + len(self._held):
            length = min(self._size - offset, max(size, READ_BYTES))
            self._held, self._begin = self._storage.read(self._key, offset, length), offset
        return self._held[offset - self._begin : stop - self._begin]

    def close(self) -> None:
        """End reading."""
        self._held = b""
