"""Splits a client's bytes into frames (RFC 6455 section 5.2): frequent kinds are read here, others by Autobahn.

Text messages in one frame and pongs are read here once complete, all those of a chunk at once. Every other valid frame
is passed to Autobahn as it arrives, and no byte beyond it. From the first invalid frame on, Autobahn receives every
byte, so that it fails the connection. Text that is not UTF-8 is invalid (section 8.1). A fragmented message fails at
its first bad byte, a message in one frame when the frame is complete.

Each client has a time share of a reactor turn. When it is used up, its remaining bytes wait for the next turn, and
nothing more is read from the connection until then.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from autobahn.twisted.websocket import WebSocketServerProtocol
from twisted.logger import Logger

from relay_server.common.websocket_frames import apply_mask

SHARE_SECONDS = 0.002
"""Seconds for one client's messages in one reactor turn; 64 KiB of small commands take less."""

_OPEN = WebSocketServerProtocol.STATE_OPEN
_ESTABLISHED = frozenset({_OPEN, WebSocketServerProtocol.STATE_CLOSING})
"""States after the handshake in which frames are read."""

_TEXT = 0x81
_CLOSE = 0x88
_PONG = 0x8A
_FAST_FRAMES = frozenset({_TEXT, _PONG})
_MASKED = 0x80
_MESSAGE_STARTS = frozenset({0x01, 0x02, 0x81, 0x82})
"""First byte of a frame that begins a text or binary message."""
_CONTINUATIONS = frozenset({0x00, 0x80})
_CONTROLS = frozenset({0x88, 0x89, 0x8A})
"""Close, ping, pong: never in fragments, at most 125 bytes (section 5.5)."""

_HEADER = struct.Struct("!BBH4s").unpack_from
"""First and second byte, and the length and the mask of a frame of 126 bytes or more."""
_U16 = struct.Struct("!H").unpack_from
_U64 = struct.Struct("!Q").unpack_from
_LONGEST_HEADER = 14
_LENGTH_LIMIT = 1 << 63
_COPY_LIMIT = 4096
"""Longest payload, in bytes, for which a copy is cheaper than a memory view."""

_BROKEN = 0


class FastProtocol(WebSocketServerProtocol):
    """Autobahn's server protocol with a fast path for frequent frames.

    The factory's ``reactor`` is the clock. No extension may be negotiated: frames with reserved bits are refused.
    """

    relay_log = Logger()
    on_text: Callable[[bytes], object] | None = None
    """Receives the text messages read here; where it is not set, ``onMessage`` does."""

    def __init__(self) -> None:
        super().__init__()
        self._unread: bytearray | None = None
        """Bytes from the start of a frame, while the frame is incomplete or the client's share is used up."""
        self._holding_frame = False
        """Whether :attr:`_unread` is an incomplete frame for which :meth:`hold` was called."""
        self._bytes_needed = 0
        """Length of :attr:`_unread` from which reading can continue."""
        self._passing_left = 0
        """Bytes still to arrive of the frame that Autobahn is reading."""
        self._pass_everything = False
        """Whether a frame was invalid, so that Autobahn receives all bytes."""
        self._reading_paused = False
        """Whether the client's share of this reactor turn is used up."""
        self._reading_held = False
        """Whether the receiver of its messages takes none, see :meth:`pause_reading`."""

    def dataReceived(self, data: bytes) -> None:
        """Read a chunk of the client's bytes; it may begin and end anywhere in a frame."""
        if self._pass_everything or self.state not in _ESTABLISHED:
            super().dataReceived(data)
            return
        waiting = self._unread
        if waiting is not None:
            waiting += data
            if self._reading_paused or len(waiting) < self._bytes_needed:
                return
            data = bytes(waiting)
            self._unread = None
            if self._holding_frame:
                self._holding_frame = False
                self.release()
        self._read(data)

    def _read(self, data: bytes) -> None:
        at, size = 0, len(data)
        seconds = self.factory.reactor.seconds
        until = seconds() + SHARE_SECONDS
        # Looked up once: only a frame read by Autobahn, or a message that begins the session, changes these.
        at_frame_start, limit = not self._passing_left and not self.inside_message, self.maxFramePayloadSize
        on_text = self.on_text
        while at < size:
            start = 0
            # A frame shorter than the longest header can be left to Autobahn too.
            if at_frame_start and size - at >= _LONGEST_HEADER and self.state == _OPEN:
                first, length, extended, mask = _HEADER(data, at)
                length -= _MASKED
                if first not in _FAST_FRAMES or length < 0:
                    pass
                elif length < 126:
                    start = at + 6
                    mask = data[at + 2 : start]
                elif first == _TEXT and length == 126:
                    length = extended
                    start = at + 8 if length > 125 else 0
                elif first == _TEXT and length == 127:
                    length = _U64(data, at + 2)[0]
                    start = at + 14 if length > 65535 else 0
                    mask = data[at + 10 : start]
            if start and length <= limit:
                end = start + length
                if end > size:
                    self._begin_frame(data, at, end - at)
                    return
                payload = data[start:end] if length <= _COPY_LIMIT else memoryview(data)[start:end]
                payload = apply_mask(payload, mask)
                if first != _PONG and not payload.isascii() and not _is_utf8(payload):
                    self._all_to_autobahn(data, at)
                    return
                at = end
                if first == _PONG:
                    self.onPong(payload)
                elif on_text is not None:
                    on_text(payload)
                else:
                    self.onMessage(payload, False)
                    limit, on_text = self.maxFramePayloadSize, self.on_text
            else:
                at = self._pass_on(data, at)
                if self._unread is not None or self.state not in _ESTABLISHED:
                    return
                at_frame_start, limit = (
                    not self._passing_left and not self.inside_message,
                    self.maxFramePayloadSize,
                )
                on_text = self.on_text
            if at < size and seconds() > until:
                self._pause(data, at)
                return

    def hold(self, size: int) -> bool:
        """Whether an incomplete frame may be held. If not, the connection has failed."""
        return True

    def release(self) -> None:
        """What was held is complete."""

    def _begin_frame(self, data: bytes, at: int, size: int) -> None:
        """Hold the incomplete frame at ``at``."""
        if self.hold(size):
            self._holding_frame = True
            self._buffer(data, at, size)
        else:
            self._all_to_autobahn(data, at)

    def _buffer(self, data: bytes, at: int, needed: int) -> None:
        self._unread = bytearray(memoryview(data)[at:])
        self._bytes_needed = needed

    # --- sharing the reactor ------------------------------------------------------------------------------

    def _pause(self, data: bytes, at: int) -> None:
        """Pause reading until the next reactor turn, as the client's share is used up."""
        self._buffer(data, at, 0)
        self._reading_paused = True
        self.transport.pauseProducing()
        self.factory.reactor.callLater(0, self._continue)

    def pause_reading(self) -> None:
        """Read nothing more from the connection until :meth:`resume_reading`."""
        self._reading_held = True
        self.transport.pauseProducing()

    def resume_reading(self) -> None:
        """The receiver of the messages takes more."""
        self._reading_held = False
        if not self._reading_paused:
            self.transport.resumeProducing()

    def _continue(self) -> None:
        waiting, self._unread = self._unread, None
        self._reading_paused = False
        if waiting is None or self.state not in _ESTABLISHED:
            return
        try:
            self._read(bytes(waiting))
        except Exception:
            self.handling_failed()
            if self.state == _OPEN:
                return
        if not (self._reading_paused or self._reading_held) and self.state in _ESTABLISHED:
            self.transport.resumeProducing()

    def handling_failed(self) -> None:
        """Abort the connection after an unexpected error, which is being handled.

        Twisted also closes a connection whose protocol raises in dataReceived.
        """
        self.relay_log.failure("bytes of a client could not be handled; its connection is aborted")
        self.transport.abortConnection()

    # --- frames for Autobahn ------------------------------------------------------------------------------

    def _pass_on(self, data: bytes, at: int) -> int:
        """Pass the frame at ``at`` to Autobahn, as far as it has arrived; return where to continue."""
        if not self._passing_left:
            size = _frame_size(data, at, inside=self.inside_message)
            if size == _BROKEN:
                self._all_to_autobahn(data, at)
                return len(data)
            if size < 0:
                self._buffer(data, at, -size)
                return at
            self._passing_left = size
        piece = data[at : at + self._passing_left]
        self._passing_left -= len(piece)
        super().dataReceived(piece)
        return at + len(piece)

    def _all_to_autobahn(self, data: bytes, at: int) -> None:
        """Pass all bytes from ``at`` on to Autobahn, which fails the connection and reads the client's close frame."""
        self._pass_everything = True
        super().dataReceived(data[at:])


def _is_utf8(payload: bytes) -> bool:
    try:
        payload.decode()
    except UnicodeDecodeError:
        return False
    return True


def _frame_size(data: bytes, at: int, *, inside: bool) -> int:
    """Bytes of the frame at ``at``, header and payload.

    :param inside: whether a fragmented message has begun
    :return: negative: as many bytes are needed to know the size; :data:`_BROKEN`: the frame is invalid
    """
    have = len(data) - at
    if have < 2:
        return -2
    first, length = data[at], data[at + 1] - _MASKED
    if length < 0 or not _allowed(first, length, inside):
        return _BROKEN
    header = 6 if length < 126 else 8 if length == 126 else _LONGEST_HEADER
    if have < header:
        return -header
    if header == 6:
        return 6 + length
    length, minimum = (_U16(data, at + 2)[0], 126) if header == 8 else (_U64(data, at + 2)[0], 65536)
    return header + length if minimum <= length < _LENGTH_LIMIT else _BROKEN


def _allowed(first: int, length: int, inside: bool) -> bool:
    """Whether a frame may begin with this byte (RFC 6455 sections 5.4 and 5.5).

    :param length: by the seven bits of the second byte
    """
    if first in _CONTROLS:
        return length < 126 and not (first == _CLOSE and length == 1)
    return first in (_CONTINUATIONS if inside else _MESSAGE_STARTS)
