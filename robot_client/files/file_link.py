"""The robot's end of a file link: offers, parts and confirmations as coroutines. It knows no disk."""

from __future__ import annotations

from collections.abc import Callable

from twisted.internet.defer import Deferred

from relay_protocol import frames, limits, link
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_protocol.pacing import SendWindow
from robot_client.link.links import Event, FileLink, JoinedChannel, LinkEnded, MessageReceived
from robot_client.link.transport import LinkLost, LinkProtocol

TARGET_SECONDS = 0.05
"""Seconds that parts of files may wait in the network: less than samples may, so that files give way to them."""

FIRST_WINDOW = 8 * limits.KIB
"""Bytes of files that may be on their way before the link has been measured."""


class FileRefused(SwitchboardError):
    """The relay does not store this file.

    :ivar retry_after: seconds after which another attempt may succeed
    """

    def __init__(self, message: link.FileRefused) -> None:
        super().__init__(message.reason)
        self.code = message.code
        self.retry_after = message.retry_after


class _Upload:
    def __init__(self) -> None:
        self.answers: list[link.Message] = []
        self.waiting: Deferred[None] | None = None
        self.confirmed = 0
        self.sent = 0
        self.refusal: SwitchboardError | None = None

    def wake(self) -> None:
        waiting, self.waiting = self.waiting, None
        if waiting is not None:
            waiting.callback(None)


class FileConnection:
    """One file link. It serves several uploads at a time.

    :param on_lost: called once, when the link has ended
    """

    def __init__(
        self,
        protocol: LinkProtocol,
        on_joined: Callable[[FileConnection], None],
        on_lost: Callable[[FileConnection, str], None],
    ) -> None:
        self.protocol = protocol
        self._on_joined = on_joined
        self._on_lost = on_lost
        self._uploads: dict[int, _Upload] = {}
        self._last = 0
        self._paused = False
        self._room: list[Deferred[None]] = []
        self._lost: LinkLost | None = None

    # --- for the owner ------------------------------------------------------------------------------------

    async def upload(
        self, offer: Callable[[int], link.OfferFile], read: Callable[[int, int], Deferred[bytes]]
    ) -> str:
        """Upload one file.

        :param offer: makes the offer with the number of the upload
        :param read: some bytes of the file: its offset, and how many
        :returns: the hash that the relay has confirmed
        :raises FileRefused: the relay does not store it
        :raises SwitchboardError: the link is lost, or the file has become shorter
        """
        self._last += 1
        number, upload = self._last, _Upload()
        message = offer(number)
        self._uploads[number] = upload
        finished = False
        try:
            self.send(message)
            answer = await self._answer(upload)
            if isinstance(answer, link.ContinueFile):
                upload.sent = upload.confirmed = answer.offset
                await self._send_parts(number, upload, message.size, read)
                answer = await self._answer(upload)
            finished = True
            if not isinstance(answer, link.FileStored):
                raise Unavailable("the relay answered an upload out of turn")
            return answer.sha256
        except FileRefused:
            finished = True
            raise
        finally:
            self._uploads.pop(number, None)
            if not finished and self._lost is None:
                self.send(link.WithdrawFile(upload=number))

    def send(self, message: link.Message) -> None:
        """Send a message."""
        self.protocol.link.send(message)
        self.protocol.flush()

    def close(self, reason: str) -> None:
        """End the link."""
        if self._lost is None:
            self.send(link.Bye(reason=reason))
            self.protocol.end(LinkLost(reason), gently=True)

    async def _send_parts(
        self, number: int, upload: _Upload, size: int, read: Callable[[int, int], Deferred[bytes]]
    ) -> None:
        while upload.sent < size:
            room = await self._room_for_part(upload)
            data = await read(upload.sent, min(room, size - upload.sent))
            self._check(upload)
            if not data:
                raise Unavailable("the file has become shorter")
            await self._room_for_part(upload)
            self.protocol.write([frames.encode_file_part(number, upload.sent, data)])
            upload.sent += len(data)

    async def _room_for_part(self, upload: _Upload) -> int:
        """Wait until a part may be sent; its largest size."""
        while True:
            self._check(upload)
            unconfirmed = sum(each.sent - each.confirmed for each in self._uploads.values())
            room = min(self.protocol.room, limits.FILE_UNCONFIRMED // 2 - unconfirmed)
            if room > 0 and not self._paused:
                return min(room, limits.FILE_PART)
            waiting: Deferred[None] = Deferred()
            self._room.append(waiting)
            await waiting

    async def _answer(self, upload: _Upload) -> link.Message:
        while not upload.answers:
            self._check(upload)
            upload.waiting = Deferred()
            await upload.waiting
        return upload.answers.pop(0)

    def _check(self, upload: _Upload) -> None:
        if self._lost is not None:
            raise self._lost
        if upload.refusal is not None:
            raise upload.refusal

    # --- link owner ---------------------------------------------------------------------------------------

    def on_event(self, event: Event) -> None:
        """See :class:`~robot_client.link.transport.LinkOwner`."""
        if isinstance(event, JoinedChannel):
            self._on_joined(self)
        elif isinstance(event, MessageReceived):
            self._message(event.message)
        elif isinstance(event, LinkEnded):
            self.protocol.end(LinkLost(event.reason))

    def _message(self, message: link.Message) -> None:
        upload = self._uploads.get(getattr(message, "upload", 0))
        if upload is None:
            return
        if isinstance(message, link.FileReceived):
            upload.confirmed = max(upload.confirmed, min(message.received, upload.sent))
            self._wake_senders()
        elif isinstance(message, link.FileRefused):
            upload.refusal = FileRefused(message)
            upload.wake()
            self._wake_senders()
        else:
            upload.answers.append(message)
            upload.wake()

    def on_lost(self, reason: SwitchboardError) -> None:
        """See :class:`~robot_client.link.transport.LinkOwner`."""
        self._lost = LinkLost(str(reason))
        for upload in list(self._uploads.values()):
            upload.wake()
        self._wake_senders()
        self._on_lost(self, str(reason))

    def on_pause(self) -> None:
        """See :class:`~robot_client.link.transport.LinkOwner`."""
        self._paused = True

    def on_resume(self) -> None:
        """See :class:`~robot_client.link.transport.LinkOwner`."""
        self._paused = False
        self._wake_senders()

    def _wake_senders(self) -> None:
        waiting, self._room = self._room, []
        for each in waiting:
            each.callback(None)


def build_file_link(ticket: str, clock: Callable[[], int], heartbeat: float) -> FileLink:
    """A link whose parts wait little in the network."""
    made = FileLink(ticket, clock, heartbeat)
    made.window = SendWindow(TARGET_SECONDS)
    made.window.size = FIRST_WINDOW
    return made
