"""Encodings of messages to clients: plain JSON, PNG or CBOR, whole or in fragments (SPEC 1.6).

Bodies of services and actions, converted between the robot's encoding (CDR or JSON) and the JSON of clients.
"""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Callable, Iterator
from json.encoder import encode_basestring_ascii
from typing import Any, NamedTuple, Protocol

import cbor2
import msgspec
import orjson
import pybase64
from twisted.internet.defer import Deferred

from relay_protocol import json_cost, jsontext, limits, link, nonfinite, rosbridge
from relay_protocol.errors import Invalid
from relay_protocol.limits import KIB
from relay_server.channels.definitions import Definitions
from relay_server.channels.link_state import RobotLinkState
from relay_server.common import websocket_frames

MAX_CBOR = 256 * KIB
"""Most bytes of JSON that are converted to CBOR. A megabyte blocks the reactor for 65 to 200 ms."""

_PUBLISH = b"\xa3" + b"".join(map(cbor2.dumps, ("op", "publish", "topic")))
"""The head of a map of three pairs, its first pair, and the key of the second."""
_MSG = cbor2.dumps("msg")


def publish(topic: str, body: bytes) -> bytes:
    """A ``publish`` to a client, around a body that is CBOR already."""
    return b"".join((_PUBLISH, cbor2.dumps(topic), _MSG, body))


def raw(ros_time_ns: int, body: bytes) -> bytes:
    """The ``msg`` of ``cbor-raw``: a sample as the robot sent it (rosbridge v2 protocol, section 3.1.4).

    :param ros_time_ns: the robot's time when it received the sample, nanoseconds since 1970 or since the
        simulation began
    :param body: CDR with its header
    """
    seconds, nanoseconds = divmod(ros_time_ns, 10**9)
    return cbor2.dumps({"secs": seconds, "nsecs": nanoseconds, "bytes": body})


def from_json(text: bytes) -> bytes:
    """JSON of the relay converted to CBOR, with the same values: no typed arrays, ``null`` for NaN."""
    return cbor2.dumps(orjson.loads(text))


MIN_FRAGMENT = 64
"""Least bytes of ``data`` in a fragment that a client can request."""

MAX_FRAGMENTS = 10_000
"""Most fragments of one message; those of a longer message are larger than requested."""

_numbers = itertools.count(1)


def fragments_of(message: bytes, size: int) -> list[bytes]:
    """The fragments of a message, or the message alone if it is short enough.

    :param message: JSON
    :param size: most bytes of ``data`` in UTF-8, before it is escaped; 0 for no fragments
    """
    if not size or len(message) <= size:
        return [message]
    parts = list(_parts(message, max(size, -(-len(message) // MAX_FRAGMENTS) + 3)))
    head = b'{"op":"fragment","id":"%d","data":' % next(_numbers)
    total = len(parts)
    return [
        b'%s%s,"num":%d,"total":%d}' % (head, jsontext.encode(part.decode()), number, total)
        for number, part in enumerate(parts)
    ]


def _parts(message: bytes, size: int) -> Iterator[bytes]:
    start, end = 0, size
    while start < len(message):
        # Never split a character (RFC 3629: its further bytes begin with the bits 10).
        while end < len(message) and message[end] & 0xC0 == 0x80:
            end -= 1
        yield message[start:end]
        start, end = end, end + size


MAX_PNG = 512 * KIB
"""Most bytes of JSON that are converted to PNG. A megabyte blocks the reactor for 20 to 40 ms."""

DEFLATE_LEVEL = 1
"""Level of deflate. Level 6 may take twice the time of level 1, and saves less than a tenth of the bytes."""


def png(message: bytes) -> bytes:
    """The ``png`` operation that carries a message.

    :param message: JSON, not empty
    """
    return b'{"op":"png","data":"' + pybase64.b64encode(png_image(message)) + b'"}'


def png_image(message: bytes) -> bytes:
    """A PNG of a message, 8-bit RGB, about as wide as high, padded with line feeds."""
    # The library is loaded only when PNG is used.
    from PIL import Image

    text = message if message.isascii() else _escaped(message)
    width = max(1, math.isqrt(len(text) // 3))
    height = math.ceil(len(text) / (3 * width))
    image = Image.frombytes("RGB", (width, height), text.ljust(3 * width * height, b"\n"))
    out = io.BytesIO()
    image.save(out, "PNG", compress_level=DEFLATE_LEVEL)
    return out.getvalue()


def _escaped(message: bytes) -> bytes:
    """The same JSON in ASCII, since in browsers roslib 1.x decodes each byte as a character."""
    # Escaping the whole text is a hundred times as fast as escaping characters. It also escapes quotes, backslashes
    # and the white space between values, which is undone here. Each backslash has become two, so no pair is split.
    parts = encode_basestring_ascii(message.decode())[1:-1].split("\\\\")
    for escaped, plain in (('\\"', '"'), ("\\n", "\n"), ("\\r", "\r"), ("\\t", "\t")):
        parts = [part.replace(escaped, plain) for part in parts]
    return "\\".join(parts).encode()


COMPRESSIONS = ("none", "png", "cbor", "cbor-raw")


class MessageEncoding(NamedTuple):
    """The encoding that a client has requested.

    :param compression: ``none``, ``png``, ``cbor`` or ``cbor-raw``
    :param fragment_size: bytes of a fragment's ``data``; 0 for whole messages
    """

    compression: str = "none"
    fragment_size: int = 0

    def costly(self, size: int) -> bool:
        """Whether encoding JSON of this size takes much processor time.

        :param size: of the JSON, bytes
        """
        return self.compression == "png" or 0 < self.fragment_size < size


PLAIN = MessageEncoding()

TOO_COSTLY = (
    "PNG, fragments and CBOR made of JSON take much of the relay's processor, and your share is used up; "
    "plain JSON is sent until there is some left"
)
"""The warning to a client that gets plain JSON because its CPU quota is used up."""


class EncodingRequest(Protocol):
    """An operation that requests an encoding: ``subscribe``, ``call_service`` or ``send_action_goal``."""

    @property
    def id(self) -> rosbridge.Id: ...

    @property
    def compression(self) -> str: ...

    @property
    def fragment_size(self) -> int | None: ...


Notify = Callable[[str, str, rosbridge.Id], None]
"""Sends a status: level, text and id. See :meth:`relay_server.sessions.context.ClientContext.notify`."""


def requested_encoding(operation: EncodingRequest, notify: Notify, *, topic: bool = False) -> MessageEncoding:
    """The encoding that an operation requests. If it is not available, the client is notified, and the nearest is used.

    :param notify: called with a status about an encoding that is not available
    :param topic: whether it is for samples of a topic, which alone can be ``cbor-raw``
    """
    compression = operation.compression or "none"
    if compression not in COMPRESSIONS:
        notify(
            "error",
            f"compression '{compression[:20]}' is none of {', '.join(COMPRESSIONS)}; plain JSON is sent",
            operation.id,
        )
        compression = "none"
    if compression == "cbor-raw" and not topic:
        compression = "cbor"
    size = max(0, operation.fragment_size or 0)
    if 0 < size < MIN_FRAGMENT:
        notify("warning", f"fragments of {size} bytes are too small; they have {MIN_FRAGMENT}", operation.id)
        size = MIN_FRAGMENT
    return MessageEncoding(compression, size)


def frames(message: bytes, encoding: MessageEncoding = PLAIN) -> bytes:
    """The websocket frames of one message.

    :param message: JSON. It is plain if it is longer than :data:`MAX_PNG` or :data:`MAX_CBOR`
    """
    if encoding == PLAIN:
        return websocket_frames.text(message)
    if encoding.compression in ("cbor", "cbor-raw") and len(message) <= MAX_CBOR:
        return websocket_frames.binary(from_json(message))
    if encoding.compression == "png" and len(message) <= MAX_PNG:
        message = png(message)
    return text_frames(message, encoding.fragment_size)


def text_frames(message: bytes, size: int) -> bytes:
    """The websocket frames of a text message, in fragments if it is longer than their size.

    :param size: bytes of ``data``; 0 for no fragments
    """
    if not size:
        return websocket_frames.text(message)
    return b"".join(map(websocket_frames.text, fragments_of(message, size)))


LARGEST = limits.RELAY_JSON_FRAME // 4 * 3 - 4096
"""Most bytes of a body: in base64, with the names beside it, it still fits a frame to a robot."""

Text = msgspec.Raw | msgspec.UnsetType


class PayloadCodec:
    """Converts bodies. A part of a type has a name such as ``std_srvs/srv/Trigger_Request``.

    :param now_ns: the robot's time, nanoseconds, for header stamps that a client omits
    """

    def __init__(
        self, link_state: RobotLinkState, definitions: Definitions, now_ns: Callable[[], int]
    ) -> None:
        self._link_state = link_state
        self._definitions = definitions
        self._now_ns = now_ns

    def ready(self, type_name: str) -> Deferred[None]:
        """Fires when bodies of this type can be converted; fails with the reason if they never can."""
        return self._definitions.ready(type_name)

    def from_client(self, part: str, text: bytes) -> bytes:
        """The body of a client's JSON; omitted fields get their defaults.

        :param text: an object, or a list of the fields in order; empty text and ``null`` are an empty object
        :raises Invalid: it does not fit the type, or is too large for a robot
        :raises NotFound: the type's definition is not known
        """
        types = self._link_state.robot.types
        json_cost.check(text)
        if not text.startswith(b"{"):
            # A list of the fields has limits of its own.
            json_cost.check_odd(text)
        if self._link_state.cdr or types.knows(part):
            body = types.args_from_json(part, text, self._now_ns())
        if not self._link_state.cdr:
            body = self._as_json(part, text, jsontext.decode_any(text) if text else {})
        if len(body) > LARGEST:
            raise Invalid(f"{part} has {len(body)} bytes here; a robot takes at most {LARGEST}")
        return body

    def _as_json(self, part: str, text: bytes, value: Any) -> bytes:
        """The body for a robot that speaks JSON: the client's own text, so that numbers keep all their digits."""
        if value is None or not text:
            return b"{}"
        if not isinstance(value, dict | list):
            raise Invalid(f"{part} must be an object, or a list of its fields in order")
        if isinstance(value, list) and self._link_state.robot.types.knows(part):
            fields = self._link_state.robot.types.definitions(part)[part].fields
            values = msgspec.json.decode(text, type=list[msgspec.Raw])
            text = jsontext.encode({field.name: each for field, each in zip(fields, values, strict=False)})
        return nonfinite.marks_to_null(text)

    def to_client(self, part: str, body: bytes) -> bytes:
        """A body as JSON.

        :raises Invalid: it is no body of this type
        :raises NotFound: the type's definition is not known
        """
        if self._link_state.cdr:
            return self._link_state.robot.types.to_json(part, body)
        return body if jsontext.decode_any(body) is not None else b"{}"

    def from_robot(self, part: str, cdr: str | None, text: Text) -> bytes:
        """The body in a message of the robot.

        :param cdr: field ``cdr`` of the message, base64
        :param text: field ``args`` or ``values`` of the message, JSON
        :raises Invalid: it is no body of this type
        """
        if cdr is None and self._link_state.cdr:
            return self.from_client(part, bytes(text or b""))
        if cdr is None:
            return self.to_client(part, bytes(text or b"{}"))
        if not self._link_state.cdr:
            raise Invalid("the robot announced JSON and sent CDR")
        return link.from_base64(cdr, "cdr")

    def args(self, body: bytes) -> dict[str, Any]:
        """The fields of a call or goal to the robot that carry a body."""
        return self._fields("args", body)

    def values(self, body: bytes) -> dict[str, Any]:
        """The fields of an answer to the robot that carry a body."""
        return self._fields("values", body)

    def _fields(self, name: str, body: bytes) -> dict[str, Any]:
        return {"cdr": link.to_base64(body)} if self._link_state.cdr else {name: msgspec.Raw(body)}
