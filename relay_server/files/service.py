"""Files of robots as users list, download, upload and delete them, by their rights on the names."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Awaitable, Callable
from typing import Annotated, Any, NamedTuple

import msgspec
from twisted.internet.defer import Deferred
from twisted.internet.task import LoopingCall
from twisted.logger import Logger

from relay_db import queries
from relay_db.queries import FileRecord, NewFile
from relay_protocol.errors import Invalid, NotFound, Refused, Unavailable
from relay_protocol.rights import Operation
from relay_server.access import Permit, Principal
from relay_server.common.database import AsyncDatabase
from relay_server.events.bus import EventBus
from relay_server.files.build import FileCore
from relay_server.files.schemas import FileInfo, FilePage, UploadInfo
from relay_server.files.storage import ContentReader, StoredContent, open_in_thread
from relay_server.files.uploads import Upload, UploadProgress, check_file_name
from relay_server.sessions.download_audit import DownloadAudit
from relay_server.sessions.manager import Admission, SessionManager

PAGE = 100
PAGE_MOST = 500
"""Files on a page: by default, and at most."""

ABANDONED_SECONDS = 7 * 86400.0
"""An upload that has not gone on for so long is deleted."""

PURGE_SECONDS = 3600.0

PURGE_BATCH = 200
"""Files that are deleted between two looks at the database."""


class UploadGap(Refused):
    """A part begins behind the bytes that the relay has.

    :param received: at which the next part must begin
    """

    code = "gap"
    http_status = 409

    def __init__(self, received: int) -> None:
        super().__init__(f"the next part must begin at byte {received}")
        self.problem_fields = {"received": received}


class UploadPart(NamedTuple):
    """A part of a file that a user uploads.

    :param sha256: of the whole file
    :param size: bytes of the whole file
    :param modified: when the file was changed last, Unix seconds
    :param offset: of the first byte of ``data``; ``None`` to ask where to go on
    """

    sha256: str
    size: int
    modified: float
    offset: int | None
    data: bytes


_FileId = Annotated[int, msgspec.Meta(ge=0, lt=2**63)]


class FileDownload:
    """A file that is being downloaded. It must be closed.

    :ivar name: file name for the client
    :ivar size: bytes
    :ivar tag: entity tag; a file of this content never changes
    :ivar begin: writes the audit entry
    """

    def __init__(
        self,
        files: FileCore,
        file: FileRecord,
        content: StoredContent,
        permit: Permit,
        begin: Callable[[], Awaitable[None]],
        release: Callable[[], None],
    ) -> None:
        self.name = file.name.rpartition("/")[2]
        self.size = file.size
        self.tag = file.sha256
        self.begin = begin
        self._file = file
        self._content = ContentReader(files.pool, content)
        self.permit = permit
        self._release = release
        self._closed = False

    def allowed(self) -> bool:
        """Whether it may go on."""
        return may_download(self.permit, self._file.name)

    async def part(self, offset: int, size: int) -> bytes:
        """Some bytes of the file.

        :raises OSError: they can't be read
        """
        return await self._content.part(offset, size)

    def close(self) -> None:
        """End the download."""
        if self._closed:
            return
        self._closed = True
        self._content.close()
        self._release()


def resource_of(name: str) -> str:
    """The name of a file as the resource of a right: ``download:/bags/*``."""
    return "/" + name


class FileService:
    """Files of robots for users.

    :param quota: most bytes of a robot's files
    :param wall: Unix time in seconds
    """

    log = Logger()

    def __init__(
        self,
        sessions: SessionManager,
        files: FileCore,
        database: AsyncDatabase,
        bus: EventBus,
        quota: int,
        wall: Callable[[], float],
    ) -> None:
        self._sessions = sessions
        self._files = files
        self._database = database
        self._bus = bus
        self._quota = quota
        self._wall = wall
        self._loop = LoopingCall(self._purge_safely)
        self._downloads = DownloadAudit(wall)
        self.on_removed: Callable[[int], object] = lambda file_id: None
        """Called with the id of each file that was removed."""

    async def page(
        self, principal: Principal, robot: str, address: str, *, limit: int, after: str, prefix: str
    ) -> FilePage:
        """The files of a robot that the principal may download, by name.

        :param after: ``next`` of an earlier page
        :param prefix: of their names
        :raises NotFound: no such robot, or no right on it
        :raises Invalid: ``after`` is not of an earlier page
        """
        behind = _place_of(after) if after else None
        async with self._sessions.admitted(principal, robot, address) as admission:
            robot_id, permit = admission.robot.robot_id, admission.permit
            found, following = await self._visible(permit, prefix, behind, limit)
            usage = await self._database.read(queries.usage_of_robot, robot_id)
            return FilePage(
                files=[info_of(each) for each in found],
                next=following,
                uploads=self._uploads(admission),
                count=usage.files,
                used=usage.bytes,
                quota=self._quota,
                may_manage=permit.decide(Operation.MANAGE, "").allowed,
            )

    async def _visible(
        self, permit: Permit, prefix: str, behind: tuple[str, int] | None, limit: int
    ) -> tuple[list[FileRecord], str | None]:
        """Files that may be downloaded, and the cursor of the next page.

        One look at the database sees a page of rows, so a page may have fewer files than ``limit``.
        """
        rows = await self._database.read(queries.list_files, permit.robot_id, prefix, behind, limit + 1)
        following = _cursor_of(rows[limit - 1]) if len(rows) > limit else None
        return [each for each in rows[:limit] if may_download(permit, each.name)], following

    def _uploads(self, admission: Admission) -> list[UploadInfo]:
        return [
            progress_of(each)
            for each in self._files.uploads.of(admission.robot.robot_id)
            if may_download(admission.permit, each.file.name)
        ]

    async def download(
        self, principal: Principal, robot: str, name: str, address: str, sha256: str | None
    ) -> FileDownload:
        """The newest file of this name, or the one with this content; it must be closed.

        :raises NotFound: no such robot or file, or no right to download it
        :raises Unavailable: the storage does not answer
        """
        admission = await self._sessions.admit(principal, robot, address)
        try:
            if not may_download(admission.permit, name):
                raise NotFound(queries.NO_FILE)
            file = await self._database.read(queries.find_file, admission.robot.robot_id, name, sha256)
            content = await self._open(file)
        except BaseException:
            self._sessions.release(admission)
            raise
        return FileDownload(
            self._files,
            file,
            content,
            admission.permit,
            lambda: self._downloads.write_once(
                admission, file.id, lambda: self._audit("file.download", file, admission)
            ),
            lambda: self._sessions.release(admission),
        )

    async def _open(self, file: FileRecord) -> StoredContent:
        try:
            return await open_in_thread(self._files.pool, self._files.storage.open, str(file.id))
        except FileNotFoundError:
            raise NotFound(queries.NO_FILE) from None
        except OSError:
            raise Unavailable("the file can't be read now; try again later") from None

    async def upload(
        self, principal: Principal, robot: str, name: str, address: str, part: UploadPart
    ) -> FileInfo | UploadInfo:
        """Take a part of a file. Bytes that the relay has already are skipped, so a part may be sent again.

        The caller must not be cancelled, since a thread may be writing.

        :returns: the file once it is stored, the upload before
        :raises NotFound: no such robot, or no right to download a file of this name
        :raises Refused: no right to manage it
        :raises UploadGap: bytes before the part are missing
        :raises UploadRefused: it can't be stored
        """
        check_file_name(name)
        async with self._sessions.admitted(principal, robot, address) as admission:
            if not may_download(admission.permit, name):
                raise NotFound(queries.NO_FILE)
            _check_managed(admission.permit, name)
            origin = f"user:{admission.robot.name_of(principal.name, principal.realm)}"
            new = NewFile(name, part.sha256, part.size, origin, part.modified)
            begun = await self._files.uploads.begin(admission.robot.robot_id, new)
            if isinstance(begun, FileRecord):
                return info_of(begun)
            try:
                if not begun.received:
                    await self._audit("file.put", begun.file, admission)
                return await _take(begun, part, self._wall())
            finally:
                await begun.cancel()

    async def delete(
        self, principal: Principal, robot: str, name: str, address: str, sha256: str | None
    ) -> None:
        """Delete the files of this name, or the one with this content, also those that are being uploaded.

        :raises NotFound: no such robot or file, or no right to download it
        :raises Refused: no right to manage it
        """
        async with self._sessions.admitted(principal, robot, address) as admission:
            permit, robot_id = admission.permit, admission.robot.robot_id
            if not may_download(permit, name):
                raise NotFound(queries.NO_FILE)
            found = await self._database.read(queries.files_named, robot_id, name)
            wanted = [each for each in found if sha256 in (None, each.sha256)]
            if not wanted:
                raise NotFound(queries.NO_FILE)
            _check_managed(permit, name)
            for file in wanted:
                await self._audit("file.delete", file, admission)
                await self.remove(file)
                self._publish("file.deleted", file, admission)

    async def remove(self, file: FileRecord) -> None:
        """Delete the contents of a file, then its row.

        :raises Unavailable: the database or the storage does not answer; it is tried again later
        """
        await self._files.uploads.end(file.id)
        if await self._database.write(queries.begin_file_removal, file.id, self._wall()):
            await self._remove_begun(file)

    async def _remove_begun(self, file: FileRecord) -> None:
        """Delete a file whose row says that it is removed."""
        # An upload may have begun before the row said that the file is removed.
        await self._files.uploads.end(file.id)
        await self._delete_contents(file.id)
        await self._database.write(queries.remove_file, file.id)
        self.on_removed(file.id)

    async def delete_removed(self, file_id: int) -> None:
        """Delete what this relay has of a file that another relay says is removed, unless the database has it still.

        :raises Unavailable: the database or the storage does not answer
        """
        if not await self._database.read(queries.file_exists, file_id):
            await self._delete_contents(file_id)

    async def _delete_contents(self, file_id: int) -> None:
        """Delete what this relay has of a file: its contents, and parts of an upload.

        :raises Unavailable: the storage does not answer
        """
        try:
            await self._files.pool.run(self._files.storage.delete, str(file_id))
            await self._files.pool.run(self._files.incoming.delete, str(file_id))
        except OSError:
            raise Unavailable("the file can't be deleted now; it is tried again later") from None

    def start(self) -> None:
        """Purge now and every hour."""
        self._loop.start(PURGE_SECONDS, now=True)

    def stop(self) -> None:
        """End purging."""
        if self._loop.running:
            self._loop.stop()

    def _purge_safely(self) -> Deferred[None]:
        return Deferred.fromCoroutine(self.purge()).addErrback(
            lambda failure: self.log.error("files to delete stay for now: {reason}", reason=failure.value)
        )

    async def purge(self) -> None:
        """Delete the files of removed robots, those whose removal was interrupted, and abandoned uploads.

        :raises Unavailable: the database or the storage does not answer; other files have been deleted
        """
        before, after, failed = self._wall() - ABANDONED_SECONDS, 0, None
        while found := await self._database.read(queries.files_to_delete, before, after, PURGE_BATCH):
            after = found[-1].id
            for file in found:
                if self._files.uploads.is_active(file.id):
                    continue
                try:
                    # An upload may have gone on since the list was read, and be stored and confirmed by now.
                    if await self._database.write(queries.begin_purge, file.id, before, self._wall()):
                        await self._remove_begun(file)
                except Unavailable as error:
                    failed = error
        if failed is not None:
            raise failed

    # --- audit entries and events --------------------------------------------------------------------------

    async def _audit(self, action: str, file: FileRecord, admission: Admission) -> None:
        """Write the audit entry of a request before it is carried out.

        :raises Unavailable: it cannot be written
        """
        await self._database.write(
            queries.append_audit,
            at=self._wall(),
            actor=f"user:{admission.permit.principal.full}",
            action=action,
            target=admission.robot.full,
            origin=admission.address,
            data={"file": file.name, "sha256": file.sha256, "bytes": file.size},
        )

    def _publish(self, kind: str, file: FileRecord, admission: Admission, **data: Any) -> None:
        principal = admission.permit.principal
        source = f"user:{admission.robot.name_of(principal.name, principal.realm)}"
        self._bus.publish(kind, file.robot_id, source, file=file.name, bytes=file.size, **data)


def _check_managed(permit: Permit, name: str) -> None:
    """:raises Refused: no right to manage a file of this name"""
    decision = permit.decide(Operation.MANAGE, resource_of(name))
    if not decision.allowed:
        raise Refused(decision.reason)


async def _take(upload: Upload, part: UploadPart, now: float) -> FileInfo | UploadInfo:
    """Write the bytes of a part that are new; store the file if they are its last."""
    offset = upload.received if part.offset is None else part.offset
    if offset > upload.received:
        raise UploadGap(upload.received)
    fresh = part.data[upload.received - offset :]
    if fresh:
        await upload.write(fresh)
    if upload.received < part.size:
        return progress_of(upload)
    await upload.store()
    return info_of(upload.file._replace(state_since=now))


def may_download(permit: Permit, name: str) -> bool:
    """Whether a file of this name may be downloaded, and listed."""
    return permit.decide(Operation.DOWNLOAD, resource_of(name)).allowed


def info_of(file: FileRecord) -> FileInfo:
    """A file as clients see it."""
    return FileInfo(
        name=file.name,
        size=file.size,
        sha256=file.sha256,
        origin=file.origin,
        modified=file.modified,
        stored=file.state_since,
    )


def progress_of(upload: Upload | UploadProgress) -> UploadInfo:
    """An upload as clients see it."""
    return UploadInfo(
        name=upload.file.name,
        size=upload.file.size,
        received=upload.received,
        origin=upload.file.origin,
        started=upload.started,
    )


def _cursor_of(file: FileRecord) -> str:
    return base64.urlsafe_b64encode(msgspec.json.encode((file.name, file.id))).decode().rstrip("=")


def _place_of(cursor: str) -> tuple[str, int]:
    """:raises Invalid: it is no cursor of :func:`_cursor_of`"""
    try:
        text = base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4))
        return msgspec.json.decode(text, type=tuple[str, _FileId])
    except (ValueError, binascii.Error, msgspec.MsgspecError, RecursionError):
        raise Invalid("'after' must be 'next' of an earlier page") from None
