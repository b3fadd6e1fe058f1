"""In what form a client wants its messages: plain JSON, PNG or CBOR, whole or in fragments (SPEC section 1.6)."""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Callable, Iterator
from json.encoder import encode_basestring_ascii
from typing import NamedTuple, Protocol

import cbor2
import orjson
import pybase64

from relay_protocol import jsontext, rosbridge
from relay_protocol.limits import KIB
from relay_server.common import websocket_frames

MOST_CBOR = 256 * KIB
"""Largest JSON that is made CBOR, bytes. It takes 65 to 200 ms a megabyte, in which the relay does nothing else."""

_PUBLISH = b"\xa3" + b"".join(map(cbor2.dumps, ("op", "publish", "topic")))
"""The head of a map of three, its first pair, and the key of the second."""
_MSG = cbor2.dumps("msg")


def publish(topic: str, body: bytes) -> bytes:
    """A ``publish`` towards a client, around a body that is CBOR already."""
    return b"".join((_PUBLISH, cbor2.dumps(topic), _MSG, body))


def raw(stamp: int, body: bytes) -> bytes:
    """The ``msg`` of ``cbor-raw``: a sample as the robot sent it (rosbridge v2 protocol, section 3.1.4).

    :param stamp: the robot's time when it came, nanoseconds: since 1970, or since the simulation began
    :param body: CDR with its header
    """
    seconds, nanoseconds = divmod(stamp, 10**9)
    return cbor2.dumps({"secs": seconds, "nsecs": nanoseconds, "bytes": body})


def from_json(text: bytes) -> bytes:
    """JSON of our own in CBOR. It says what the JSON says: no typed arrays, ``null`` for NaN."""
    return cbor2.dumps(orjson.loads(text))


LEAST = 64
"""Smallest fragments a client can ask for, bytes of ``data``."""

MOST_FRAGMENTS = 10_000
"""Fragments of one message; of a longer one they are larger than was asked for."""

_numbers = itertools.count(1)


def divide(message: bytes, size: int) -> list[bytes]:
    """The fragments of a message, or the message alone when it is short enough.

    :param message: JSON
    :param size: most bytes of ``data`` in UTF-8, before it is escaped; 0 for no fragments
    """
    if not size or len(message) <= size:
        return [message]
    parts = list(_parts(message, max(size, -(-len(message) // MOST_FRAGMENTS) + 3)))
    head = b'{"op":"fragment","id":"%d","data":' % next(_numbers)
    total = len(parts)
    return [
        b'%s%s,"num":%d,"total":%d}' % (head, jsontext.encode(part.decode()), number, total)
        for number, part in enumerate(parts)
    ]


def _parts(message: bytes, size: int) -> Iterator[bytes]:
    start, end = 0, size
    while start < len(message):
        # Not in the midst of a character (RFC 3629: its further bytes begin with the bits 10).
        while end < len(message) and message[end] & 0xC0 == 0x80:
            end -= 1
        yield message[start:end]
        start, end = end, end + size


MOST_PNG = 512 * KIB
"""Largest JSON that is made a PNG, bytes. It takes 20 to 40 ms a megabyte, in which the relay does nothing else."""

LEVEL = 1
"""Of deflate. Level 6 takes up to twice the time of level 1 and saves less than a tenth of the bytes."""


def encode(message: bytes) -> bytes:
    """The ``png`` operation that carries a message.

    :param message: JSON, not empty
    """
    return b'{"op":"png","data":"' + pybase64.b64encode(picture(message)) + b'"}'


def picture(message: bytes) -> bytes:
    """A PNG, 8-bit RGB, about as wide as high; what is over is line feeds."""
    # Only who asks for PNG pays for the library.
    from PIL import Image

    text = message if message.isascii() else _escaped(message)
    width = max(1, math.isqrt(len(text) // 3))
    height = math.ceil(len(text) / (3 * width))
    image = Image.frombytes("RGB", (width, height), text.ljust(3 * width * height, b"\n"))
    out = io.BytesIO()
    image.save(out, "PNG", compress_level=LEVEL)
    return out.getvalue()


def _escaped(message: bytes) -> bytes:
    """The same JSON in ASCII: in browsers roslib 1.x takes each byte for a character."""
    # In one go, a hundred times as fast as character by character. This also escapes quotes, backslashes and the
    # white space between values, which is taken back. Each backslash came out as two, so no pair is parted here.
    parts = encode_basestring_ascii(message.decode())[1:-1].split("\\\\")
    for escaped, plain in (('\\"', '"'), ("\\n", "\n"), ("\\r", "\r"), ("\\t", "\t")):
        parts = [part.replace(escaped, plain) for part in parts]
    return "\\".join(parts).encode()


COMPRESSIONS = ("none", "png", "cbor", "cbor-raw")


class MessageEncoding(NamedTuple):
    """What a client asked for.

    :param compression: ``none``, ``png``, ``cbor`` or ``cbor-raw``
    :param fragment_size: bytes of a fragment's ``data``; 0 for whole messages
    """

    compression: str = "none"
    fragment_size: int = 0

    def costly(self, size: int) -> bool:
        """Whether it takes much of the processor to put JSON in this form.

        :param size: of the JSON, bytes
        """
        return self.compression == "png" or 0 < self.fragment_size < size


PLAIN = MessageEncoding()

TOO_COSTLY = (
    "PNG, fragments and CBOR made of JSON take much of the relay's processor, and your share is used up; "
    "plain JSON is sent until there is some left"
)
"""What a client is told that gets plain JSON for a while."""


class EncodingRequest(Protocol):
    """``subscribe``, ``call_service`` and ``send_action_goal``: operations that say in what form they want answers."""

    @property
    def id(self) -> rosbridge.Id: ...

    @property
    def compression(self) -> str: ...

    @property
    def fragment_size(self) -> int | None: ...


Tell = Callable[[str, str, rosbridge.Id], None]
"""Takes the level, the words and the id of a ``status``; see :meth:`relay_server.sessions.session.Session.tell`."""


def asked(ask: EncodingRequest, tell: Tell, *, topic: bool = False) -> MessageEncoding:
    """The form a client asks for. What can't be had is told, and the nearest that can be had is taken.

    :param tell: called with what differs from what was asked for
    :param topic: whether samples of a topic are asked for: only they can come as ``cbor-raw``
    """
    compression = ask.compression or "none"
    if compression not in COMPRESSIONS:
        tell(
            "error",
            f"compression '{compression[:20]}' is none of {', '.join(COMPRESSIONS)}; plain JSON is sent",
            ask.id,
        )
        compression = "none"
    if compression == "cbor-raw" and not topic:
        compression = "cbor"
    size = max(0, ask.fragment_size or 0)
    if 0 < size < LEAST:
        tell("warning", f"fragments of {size} bytes are too small; they have {LEAST}", ask.id)
        size = LEAST
    return MessageEncoding(compression, size)


def frames(message: bytes, form: MessageEncoding = PLAIN) -> bytes:
    """The websocket frames of one message.

    :param message: JSON. In PNG it goes only if it is no longer than
        :data:`relay_server.channels.encodings.MOST_PNG`, in CBOR only
        up to :data:`relay_server.channels.encodings.MOST_CBOR`.
    """
    if form == PLAIN:
        return websocket_frames.text(message)
    if form.compression in ("cbor", "cbor-raw") and len(message) <= MOST_CBOR:
        return websocket_frames.binary(from_json(message))
    if form.compression == "png" and len(message) <= MOST_PNG:
        message = encode(message)
    return divided(message, form.fragment_size)


def divided(message: bytes, size: int) -> bytes:
    """The websocket frames of a text message, in fragments if it is longer than their size.

    :param size: bytes of ``data``; 0 for no fragments
    """
    if not size:
        return websocket_frames.text(message)
    return b"".join(map(websocket_frames.text, divide(message, size)))
