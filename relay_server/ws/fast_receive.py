"""A client's bytes, cut into frames (RFC 6455 section 5.2): the usual ones are read here, the others by Autobahn.

A text message in one frame and a pong are read here when they are whole, all those of a chunk at once. Every other
frame that is in order is passed on to Autobahn as it comes, and no byte beyond it. From the first frame that is not in
order, Autobahn gets every byte as it comes: it fails the connection. Text that is not UTF-8 is not in order (section
8.1). A fragmented message fails at its first bad byte, a message in one frame when the frame is complete.

No client has more than its share of a turn of the reactor: when its time is up, the rest of its bytes waits until the
others have had their turn, and nothing more is read from it until then.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from autobahn.twisted.websocket import WebSocketServerProtocol
from twisted.logger import Logger

try:
    from websockets.speedups import apply_mask
except ImportError:  # no wheel for this platform: right, but slow
    from websockets.utils import apply_mask

SHARE_SECONDS = 0.002
"""Time for one client's messages in one turn; 64 KiB of small commands take less."""

_OPEN = WebSocketServerProtocol.STATE_OPEN
_SPEAKING = frozenset({_OPEN, WebSocketServerProtocol.STATE_CLOSING})
"""The handshake is done, the connection not yet given up."""

_TEXT = 0x81
_CLOSE = 0x88
_PONG = 0x8A
_READ_HERE = frozenset({_TEXT, _PONG})
_MASKED = 0x80
_BEGINNINGS = frozenset({0x01, 0x02, 0x81, 0x82})
"""First byte of a frame that begins a text or binary message."""
_CONTINUATIONS = frozenset({0x00, 0x80})
_CONTROLS = frozenset({0x88, 0x89, 0x8A})
"""Close, ping, pong: never in fragments, at most 125 bytes (section 5.5)."""

_U16 = struct.Struct("!H").unpack_from
_U64 = struct.Struct("!Q").unpack_from
_LONGEST_HEAD = 14
_HUGE = 1 << 63
_COPIED = 4096
"""Up to this length a copy of the payload is cheaper than a view of it."""

_BROKEN = 0


class FastProtocol(WebSocketServerProtocol):
    """Autobahn's server protocol with a shorter way for what is frequent.

    The factory's ``reactor`` is the clock. No extension may be negotiated: frames with reserved bits are refused.
    """

    relay_log = Logger()
    takes_text: Callable[[bytes], object] | None = None
    """Gets the text messages read here, if it is set; else ``onMessage`` does."""

    def __init__(self) -> None:
        super().__init__()
        self._waiting: bytearray | None = None
        """Bytes from the beginning of a frame on, while they are not enough or the client's time is up."""
        self._enough = 0
        """Of so many bytes something can be made."""
        self._passing = 0
        """Bytes of the frame Autobahn is reading that have not come yet."""
        self._verbatim = False
        """Something was not in order: all bytes are Autobahn's."""
        self._resting = False

    def dataReceived(self, data: bytes) -> None:
        """Bytes from the client, cut anywhere."""
        if self._verbatim or self.state not in _SPEAKING:
            super().dataReceived(data)
            return
        waiting = self._waiting
        if waiting is not None:
            waiting += data
            if self._resting or len(waiting) < self._enough:
                return
            data = bytes(waiting)
            self._waiting = None
        self._read(data)

    def _read(self, data: bytes) -> None:
        at, have = 0, len(data)
        seconds = self.factory.reactor.seconds
        until = seconds() + SHARE_SECONDS
        # What can change only by a frame of Autobahn's, or by a message that begins the session, is looked up once.
        whole, limit = not self._passing and not self.inside_message, self.maxFramePayloadSize
        takes_text = self.takes_text
        while at < have:
            first, start = data[at], 0
            # What is shorter than the longest head can be left to Autobahn too.
            if whole and first in _READ_HERE and have - at >= _LONGEST_HEAD and self.state == _OPEN:
                length = data[at + 1] - _MASKED
                if 0 <= length < 126:
                    start = at + 6
                elif first == _TEXT and length == 126:
                    length = data[at + 2] << 8 | data[at + 3]
                    start = at + 8 if length > 125 else 0
                elif first == _TEXT and length == 127:
                    length = _U64(data, at + 2)[0]
                    start = at + 14 if length > 65535 else 0
            if start and length <= limit:
                end = start + length
                if end > have:
                    self._wait(data, at, end - at)
                    return
                payload = data[start:end] if length <= _COPIED else memoryview(data)[start:end]
                payload = apply_mask(payload, data[start - 4 : start])
                if first != _PONG and not payload.isascii() and not _is_utf8(payload):
                    self._all_to_autobahn(data, at)
                    return
                at = end
                if first == _PONG:
                    self.onPong(payload)
                elif takes_text is not None:
                    takes_text(payload)
                else:
                    self.onMessage(payload, False)
                    limit, takes_text = self.maxFramePayloadSize, self.takes_text
            else:
                at = self._pass_on(data, at)
                if self._waiting is not None or self.state not in _SPEAKING:
                    return
                whole, limit = not self._passing and not self.inside_message, self.maxFramePayloadSize
                takes_text = self.takes_text
            if seconds() > until and at < have:
                self._rest(data, at)
                return

    def _wait(self, data: bytes, at: int, enough: int) -> None:
        self._waiting = bytearray(memoryview(data)[at:])
        self._enough = enough

    # --- sharing the reactor ------------------------------------------------------------------------------

    def _rest(self, data: bytes, at: int) -> None:
        """The client's time is up; it goes on in the next turn."""
        self._wait(data, at, 0)
        self._resting = True
        self.transport.pauseProducing()
        self.factory.reactor.callLater(0, self._go_on)

    def _go_on(self) -> None:
        waiting, self._waiting = self._waiting, None
        self._resting = False
        if waiting is None or self.state not in _SPEAKING:
            return
        try:
            self._read(bytes(waiting))
        except Exception:
            # Twisted, too, cuts a connection whose protocol fails on what it is given.
            self.relay_log.failure("what a client sent could not be handled; it is cut")
            self.transport.abortConnection()
            return
        if not self._resting and self.state in _SPEAKING:
            self.transport.resumeProducing()

    # --- what is Autobahn's -------------------------------------------------------------------------------

    def _pass_on(self, data: bytes, at: int) -> int:
        """Give Autobahn the frame at ``at``, as far as it has come. Returns where to go on."""
        if not self._passing:
            size = _frame(data, at, inside=self.inside_message)
            if size == _BROKEN:
                self._all_to_autobahn(data, at)
                return len(data)
            if size < 0:
                self._wait(data, at, -size)
                return at
            self._passing = size
        piece = data[at : at + self._passing]
        self._passing -= len(piece)
        super().dataReceived(piece)
        return at + len(piece)

    def _all_to_autobahn(self, data: bytes, at: int) -> None:
        """Autobahn fails the connection for the frame at ``at``, and reads the client's close."""
        self._verbatim = True
        super().dataReceived(data[at:])


def _is_utf8(payload: bytes) -> bool:
    try:
        str(payload, "utf-8")
    except UnicodeDecodeError:
        return False
    return True


def _frame(data: bytes, at: int, *, inside: bool) -> int:
    """Bytes of the frame at ``at``, head and payload. Negative: so many are needed to tell. Or :data:`_BROKEN`.

    :param inside: whether a fragmented message has begun
    """
    have = len(data) - at
    if have < 2:
        return -2
    first, length = data[at], data[at + 1] - _MASKED
    if length < 0 or not _allowed(first, length, inside):
        return _BROKEN
    head = 6 if length < 126 else 8 if length == 126 else _LONGEST_HEAD
    if have < head:
        return -head
    if head == 6:
        return 6 + length
    length, shortest = (_U16(data, at + 2)[0], 126) if head == 8 else (_U64(data, at + 2)[0], 65536)
    return head + length if shortest <= length < _HUGE else _BROKEN


def _allowed(first: int, length: int, inside: bool) -> bool:
    """Whether a frame may begin so (sections 5.4 and 5.5).

    :param length: as the seven bits say
    """
    if first in _CONTROLS:
        return length < 126 and not (first == _CLOSE and length == 1)
    return first in (_CONTINUATIONS if inside else _BEGINNINGS)
