"""A robot's file link (SPEC 2.7): offers and parts of files from the robot, confirmations to it."""

from __future__ import annotations

from collections import deque
from collections.abc import Coroutine
from typing import Any

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_db.queries import FileRecord, NewFile
from relay_protocol import jsontext, limits, link
from relay_protocol.errors import MalformedMessage
from relay_protocol.frames import FilePart, SampleFrame, VideoFrame, VideoFramePart
from relay_server.files.uploads import Upload, UploadRefused, Uploads
from relay_server.robots.connection import LinkHandler, RobotConnection
from relay_server.robots.registry import RobotState


class LinkUpload:
    """One upload of this link.

    :ivar expected: offset of the next part
    :ivar parts: received, not written yet
    """

    def __init__(self, offer: link.OfferFile) -> None:
        self.offer = offer
        self.upload: Upload | None = None
        self.expected = 0
        self.parts: deque[bytes] = deque()
        self.writing = False
        self.withdrawn = False


class FileLinkHandler(LinkHandler):
    """The robot's end of a file link.

    :param robot: whose files are uploaded
    """

    log = Logger()

    def __init__(self, uploads: Uploads, robot: RobotState, connection: RobotConnection) -> None:
        self.robot = robot
        self.connection = connection
        self._uploads = uploads
        self._incoming: dict[int, LinkUpload] = {}
        self._held = 0
        """Bytes received that are not written yet."""

    def message(self, body: bytes) -> None:
        """An offer, or the end of an upload."""
        message = jsontext.decode(link.robot_files_decoder, body)
        if isinstance(message, link.OfferFile):
            self._offered(message)
        elif isinstance(message, link.WithdrawFile):
            self._withdrawn(message.upload)
        else:
            self.connection.common_message(message)

    def sample(self, frame: SampleFrame) -> None:
        """A file link carries no samples."""
        raise MalformedMessage("samples go over the channel link, not the file link")

    def video_frame(self, frame: VideoFrame | VideoFramePart) -> None:
        """A file link carries no camera frames."""
        raise MalformedMessage("camera frames go over the link of a camera stream")

    def file_part(self, frame: FilePart) -> None:
        """The next part of a file."""
        incoming = self._incoming.get(frame.upload)
        if incoming is None:
            # The upload was refused while this part was on its way.
            return
        if incoming.upload is None or frame.offset != incoming.expected:
            raise MalformedMessage(
                f"byte {incoming.expected} of upload {frame.upload} must be next, not {frame.offset}"
            )
        incoming.expected += len(frame.body)
        self._held += len(frame.body)
        if incoming.expected > incoming.offer.size or self._held > limits.FILE_UNCONFIRMED:
            raise MalformedMessage(
                f"upload {frame.upload} sends more than its {incoming.offer.size} bytes, "
                f"or more than {limits.FILE_UNCONFIRMED} bytes are unconfirmed"
            )
        incoming.parts.append(frame.body)
        if not incoming.writing:
            self._run(frame.upload, self._receive(incoming))

    def lost(self, reason: str) -> None:
        """The link has ended; what was received stays."""
        for number in list(self._incoming):
            self._withdrawn(number)

    def _offered(self, offer: link.OfferFile) -> None:
        if offer.upload in self._incoming or len(self._incoming) >= limits.FILE_UPLOADS:
            raise MalformedMessage(
                f"upload {offer.upload} has begun already, or {limits.FILE_UPLOADS} uploads are open"
            )
        incoming = self._incoming[offer.upload] = LinkUpload(offer)
        self._run(offer.upload, self._begin(incoming))

    def _withdrawn(self, number: int) -> None:
        incoming = self._incoming.pop(number, None)
        if incoming is None:
            return
        incoming.withdrawn = True
        self._drop_parts(incoming)
        if incoming.upload is not None:
            self._run(number, incoming.upload.cancel())

    async def _begin(self, incoming: LinkUpload) -> None:
        offer = incoming.offer
        new = NewFile(offer.name, offer.sha256, offer.size, offer.group, offer.modified)
        begun = await self._uploads.begin(self.robot.robot_id, new)
        if isinstance(begun, FileRecord):
            self._confirm(incoming)
            return
        incoming.upload = begun
        if incoming.withdrawn:
            await begun.cancel()
            return
        incoming.expected = begun.received
        if begun.received == offer.size:
            await self._store(incoming)
        else:
            self.connection.send(link.ContinueFile(upload=offer.upload, offset=begun.received))

    async def _receive(self, incoming: LinkUpload) -> None:
        upload, number = incoming.upload, incoming.offer.upload
        assert upload is not None
        incoming.writing = True
        while incoming.parts and not incoming.withdrawn:
            data = b"".join(incoming.parts)
            incoming.parts.clear()
            try:
                await upload.write(data)
            finally:
                self._held -= len(data)
            if not incoming.withdrawn:
                self.connection.send(link.FileReceived(upload=number, received=upload.received))
        incoming.writing = False
        if not incoming.withdrawn and upload.received == incoming.offer.size:
            await self._store(incoming)

    async def _store(self, incoming: LinkUpload) -> None:
        assert incoming.upload is not None
        await incoming.upload.store()
        self._confirm(incoming)

    def _confirm(self, incoming: LinkUpload) -> None:
        number = incoming.offer.upload
        if self._incoming.get(number) is incoming:
            del self._incoming[number]
            self.connection.send(link.FileStored(upload=number, sha256=incoming.offer.sha256))

    def _run(self, number: int, work: Coroutine[Deferred[Any], Any, None]) -> None:
        incoming = self._incoming.get(number)
        done = Deferred.fromCoroutine(work)
        done.addErrback(lambda failure: self._failed(incoming, failure))

    def _failed(self, incoming: LinkUpload | None, failure: Any) -> None:
        error = failure.value
        if not isinstance(error, UploadRefused):
            self.log.failure("an upload failed", failure)
            error = UploadRefused("unavailable", "the relay failed; see its log")
        if incoming is None or self._incoming.get(incoming.offer.upload) is not incoming:
            return
        del self._incoming[incoming.offer.upload]
        self._drop_parts(incoming)
        refusal = link.FileRefused(
            upload=incoming.offer.upload,
            code=error.code,
            reason=str(error),
            retry_after=error.retry_after,
        )
        self.connection.send(refusal)

    def _drop_parts(self, incoming: LinkUpload) -> None:
        self._held -= sum(map(len, incoming.parts))
        incoming.parts.clear()
