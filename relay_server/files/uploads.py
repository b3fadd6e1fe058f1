"""Uploads of files: each is received, made durable, checked, and only then listed and confirmed.

The row of a file is written before its contents, and is ``incoming`` until they are durable. So a relay that dies at
any moment finds by the row what it has, and the sender continues there.
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_db import queries
from relay_db.queries import FileQuotas, FileRecord, NewFile
from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable
from relay_protocol.limits import FILE_NAME
from relay_server.common.database import AsyncDatabase, BoundedThreadPool
from relay_server.events.bus import EventBus
from relay_server.files.incoming import DiskFull, IncomingFile, IncomingFolder, WrongContents
from relay_server.files.storage import FileStorage, hash_of_stored, open_in_thread

T = TypeVar("T")

RETRY_SECONDS = 60.0
"""After this time a sender that was refused may try again."""

SOON_SECONDS = 5.0
"""The same where the cause is likely to pass."""


_STATUS = {"name": 400, "quota": 409, "mismatch": 422}
"""Statuses of HTTP by the codes of :class:`UploadRefused`; that of others is 503."""


class UploadRefused(Refused):
    """An upload has ended without being stored.

    :ivar code: as of :class:`relay_protocol.link.FileRefused`
    """

    def __init__(self, code: str, reason: str, retry_after: float = RETRY_SECONDS) -> None:
        super().__init__(reason)
        self.code = code
        self.retry_after = retry_after
        self.http_status = _STATUS.get(code, 503)


def check_file_name(name: str) -> None:
    """:raises Invalid: it can't be the name of a file"""
    if len(name.encode("utf-8", "surrogatepass")) > FILE_NAME:
        raise Invalid(f"a name may have {FILE_NAME} bytes")
    if any(part in ("", ".", "..") for part in name.split("/")):
        raise Invalid("a name is made of parts with '/' between them, none of which is empty, '.' or '..'")
    if any(ord(each) < 32 or ord(each) in (127, 0xFFFD) or 0xD800 <= ord(each) < 0xE000 for each in name):
        raise Invalid("a name may contain no control characters and no U+FFFD, and must be UTF-8")


@dataclass
class UploadProgress:
    """An upload as users see it.

    :param started: Unix time in seconds
    """

    file: FileRecord
    received: int
    started: float


class Uploads:
    """All uploads of a relay.

    :param pool: threads for the disk
    :param storing: threads that store and hash whole files
    :param wall: Unix time in seconds
    :ivar version: changes with each upload that begins, goes on or ends
    """

    log = Logger()

    def __init__(
        self,
        *,
        database: AsyncDatabase,
        pool: BoundedThreadPool,
        storing: BoundedThreadPool,
        incoming: IncomingFolder,
        storage: FileStorage,
        quotas: FileQuotas,
        bus: EventBus,
        wall: Callable[[], float],
    ) -> None:
        self._database = database
        self.pool = pool
        self._storing = storing
        self._incoming = incoming
        self._storage = storage
        self._quotas = quotas
        self._bus = bus
        self._wall = wall
        self._active: dict[int, Upload] = {}

    def of(self, robot_id: int) -> Iterator[UploadProgress]:
        """The uploads to a robot's files that are going on."""
        for each in list(self._active.values()):
            if each.file.robot_id == robot_id:
                yield UploadProgress(each.file, each.received, each.started)

    def is_active(self, file_id: int) -> bool:
        """Whether a file is being uploaded."""
        return file_id in self._active

    async def begin(self, robot_id: int, new: NewFile) -> Upload | FileRecord:
        """Begin or continue an upload. An older upload of the same file ends.

        :returns: the file, if it is stored already
        :raises UploadRefused: it can't be stored
        """
        try:
            check_file_name(new.name)
        except Invalid as error:
            raise UploadRefused("name", str(error), retry_after=3600.0) from None
        file = await self._row(robot_id, new)
        if file.state == "stored":
            if await self.on_disk(self._storage.size, str(file.id)) == file.size:
                return file
            file = await self._lost(file)
        await self.end(file.id)
        if file.state != "incoming" or self.is_active(file.id):
            raise UploadRefused("unavailable", "this file is being deleted or uploaded", SOON_SECONDS)
        upload = self._active[file.id] = Upload(self, file, self._wall())
        return upload if await upload.open() else file

    async def _lost(self, file: FileRecord) -> FileRecord:
        """A stored file, whose contents are not in the storage, as one that is uploaded again."""
        self.log.error("the contents of file {id} are missing; it is uploaded again", id=file.id)
        try:
            there = await self._database.write(queries.file_lost, file.id, self._wall())
        except Unavailable as error:
            raise UploadRefused("unavailable", str(error), SOON_SECONDS) from None
        if not there:
            raise UploadRefused("unavailable", "this file is being deleted", SOON_SECONDS)
        return file._replace(state="incoming")

    async def _row(self, robot_id: int, new: NewFile) -> FileRecord:
        try:
            return await self._database.write(queries.add_file, robot_id, new, self._quotas, self._wall())
        except queries.FileQuotaExceeded as error:
            raise UploadRefused("quota", str(error)) from None
        except Invalid as error:
            raise UploadRefused("mismatch", str(error), SOON_SECONDS) from None
        except (NotFound, Unavailable) as error:
            raise UploadRefused("unavailable", str(error), SOON_SECONDS) from None

    async def open_incoming(self, file: FileRecord) -> IncomingFile | None:
        """Open the incoming file; ``None`` if the contents are stored already, and are listed now.

        :raises UploadRefused: it can't be opened
        """
        stored = await self.on_disk(self._storage.size, str(file.id))
        # The relay may have died between storing the contents and listing them. Or the storage has a file of this
        # number that the database does not know, because an older state of it was restored.
        if (
            stored == file.size
            and await self._with_whole_file(hash_of_stored, self._storage, str(file.id)) == file.sha256
        ):
            await self._listed(file)
            await self.on_disk(self._incoming.delete, str(file.id))
            return None
        with self._disk_errors():
            return await open_in_thread(self.pool, self._incoming.open, str(file.id), file.size)

    async def end(self, file_id: int) -> None:
        """End an upload of a file, if there is one; what was received stays."""
        active = self._active.get(file_id)
        if active is not None:
            await active.cancel()

    def forget(self, upload: Upload) -> None:
        """An upload has ended."""
        if self._active.get(upload.file.id) is upload:
            del self._active[upload.file.id]

    async def store(self, upload: Upload, incoming: IncomingFile) -> None:
        """Store a file that was received whole, and list it.

        :raises UploadRefused: it can't be stored
        """
        file = upload.file
        try:
            work = self._incoming.store
            await self._with_whole_file(work, incoming, str(file.id), file.size, file.sha256)
        except WrongContents:
            reason = "what arrived is not what was offered: the file has changed, or the transfer was damaged"
            raise UploadRefused("mismatch", reason, SOON_SECONDS) from None
        await self._listed(file)

    async def _listed(self, file: FileRecord) -> None:
        try:
            there = await self._database.write(queries.file_stored, file.id, self._wall())
        except SwitchboardError as error:
            raise UploadRefused("unavailable", str(error), SOON_SECONDS) from None
        if not there:
            raise UploadRefused("unavailable", "the file was deleted while it was uploaded", SOON_SECONDS)
        self._bus.publish("file.stored", file.robot_id, file=file.name, bytes=file.size, sha256=file.sha256)

    async def on_disk(self, work: Callable[..., T], *arguments: object) -> T:
        """Do something with the disk in a thread.

        :raises UploadRefused: the disk refused
        """
        with self._disk_errors():
            return await self.pool.run(work, *arguments)

    async def _with_whole_file(self, work: Callable[..., T], *arguments: object) -> T:
        """As :meth:`on_disk`, for what takes long."""
        with self._disk_errors():
            return await self._storing.run(work, *arguments)

    @contextmanager
    def _disk_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise self._disk_error(error) from None
        except Unavailable as error:
            raise UploadRefused("unavailable", str(error), SOON_SECONDS) from None

    def _disk_error(self, error: OSError) -> UploadRefused:
        if isinstance(error, DiskFull) or error.errno in (errno.ENOSPC, errno.EDQUOT):
            return UploadRefused("disk_full", "the relay's disk is full; its administrator must make room")
        self.log.error("storing a file failed: {reason}", reason=str(error), limited="storing a file failed")
        return UploadRefused("unavailable", "the relay can't write to its storage; see its log")


class Upload:
    """One upload. Parts are written in the order in which they come.

    :param started: Unix time in seconds
    """

    def __init__(self, uploads: Uploads, file: FileRecord, started: float) -> None:
        self.file = file
        self.started = started
        self.incoming: IncomingFile | None = None
        self._uploads = uploads
        self._cancelled = False
        self._busy = False
        self._ended = False
        self._waiting: list[Deferred[None]] = []

    @property
    def received(self) -> int:
        """Bytes that are written."""
        return 0 if self.incoming is None else self.incoming.received

    @property
    def ended(self) -> bool:
        """Whether it was cancelled, refused or stored."""
        return self._ended or self._cancelled

    async def open(self) -> bool:
        """Open the incoming file; false if the contents are stored already. The upload has ended then.

        :raises UploadRefused: it can't be opened, or the upload was cancelled
        """
        self._busy = True
        try:
            self.incoming = await self._uploads.open_incoming(self.file)
        finally:
            self._cancelled = self._cancelled or self.incoming is None
            self._end_step()
        if self.incoming is None:
            return False
        if self.ended:
            raise UploadRefused("unavailable", "this upload has ended", SOON_SECONDS)
        return True

    async def write(self, data: bytes) -> None:
        """Write the next bytes; only one call at a time. After an error the upload has ended.

        :raises UploadRefused: they can't be written, or the upload was cancelled
        """
        incoming = self._begin()
        try:
            if incoming.received + len(data) > self.file.size:
                raise UploadRefused(
                    "mismatch", f"more came than the {self.file.size} bytes that were offered"
                )
            await self._uploads.on_disk(incoming.write, data)
        except BaseException:
            self._cancelled = True
            raise
        finally:
            self._end_step()

    async def store(self) -> None:
        """Store the whole file; when this returns it is durable and listed. The upload has ended in any case.

        :raises UploadRefused: it can't be stored
        """
        incoming = self._begin()
        try:
            await self._uploads.store(self, incoming)
        finally:
            self._cancelled = True
            self._end_step()

    async def cancel(self) -> None:
        """End the upload once the step in progress is done; what was received stays."""
        self._cancelled = True
        if self._busy:
            waiting: Deferred[None] = Deferred()
            self._waiting.append(waiting)
            await waiting
        self.finished()

    def finished(self) -> None:
        """The upload has ended: release the file."""
        if self._ended:
            return
        self._ended = self._cancelled = True
        if self.incoming is not None:
            self.incoming.close()
        self._uploads.forget(self)

    def _begin(self) -> IncomingFile:
        if self.ended or self._busy or self.incoming is None:
            raise UploadRefused("unavailable", "this upload has ended", SOON_SECONDS)
        self._busy = True
        return self.incoming

    def _end_step(self) -> None:
        self._busy = False
        if self._cancelled:
            self.finished()
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            each.callback(None)
