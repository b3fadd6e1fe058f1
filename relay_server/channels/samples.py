"""One message of a robot for many clients: rendered once for each format that clients request."""

from __future__ import annotations

import enum
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import cbor2

from relay_protocol import jsontext, limits, rosbridge
from relay_protocol.errors import Invalid, SwitchboardError
from relay_protocol.limits import KIB
from relay_protocol.ros.compiled import Reader
from relay_protocol.ros_types import TypeRegistry
from relay_server.channels import encodings
from relay_server.channels.encodings import PLAIN, TOO_COSTLY, MessageEncoding, text_frames
from relay_server.common import websocket_frames
from relay_server.common.cpu_quota import UserQuota

_SPARE_BYTES = 64 * KIB
"""Bytes that one sample may cache beyond four times its size; what is evicted is rendered again."""

_HEAD_BYTES = 32
"""Bytes of a ``publish`` around its ``msg``, at least."""


class OutputFormat(NamedTuple):
    """The format in which a client gets each sample.

    :param names: spellings of the topic by the client, which gets one message for each
    :param head: text before the body if there is one message in plain JSON; else empty
    """

    names: tuple[str, ...]
    encoding: MessageEncoding
    head: bytes


@lru_cache(maxsize=1024)
def output_format_for(names: tuple[str, ...], encoding: MessageEncoding) -> OutputFormat:
    """The format for these names. Nearly all equal formats are one object, so they can be compared by identity."""
    plain = encoding == PLAIN and len(names) == 1
    return OutputFormat(names, encoding, rosbridge.publish_head(names[0]) if plain else b"")


class RenderError(enum.Enum):
    """Why a client does not get a sample in the format that it requested."""

    BROKEN = "broken"
    NOT_CDR = "not cdr"
    TOO_LARGE = "too large"
    TOO_COSTLY = "too costly"
    NOT_SENT = "not sent"


class Rendered(NamedTuple):
    """A sample in one format.

    :param frames: websocket frames; ``None``: the sample can't be converted
    :param error: of which the client must be notified
    :param words: text of the error
    """

    frames: bytes | None
    error: RenderError | None = None
    words: str = ""


class Converter:
    """Converts the samples of one topic to JSON and CBOR; it is valid until the type's definition is replaced.

    :param encoding: of the samples, ``cdr`` or ``json``
    :param on_failure: called with the reason for each sample that can't be converted
    """

    def __init__(
        self, types: TypeRegistry, type_name: str, encoding: str, on_failure: Callable[[str], None]
    ) -> None:
        self.types = types
        self.type = type_name
        self.cdr = encoding == "cdr"
        self.on_failure = on_failure
        self.ready = False
        """The latest result of :meth:`check_ready`; once true, it stays true."""
        self._readers: dict[str, Reader] = {}

    def check_ready(self) -> bool:
        """Whether the type's definition is known, so that samples can be converted."""
        if not self.ready:
            self.ready = not self.cdr or self.types.knows(self.type)
        return self.ready

    def convert(self, language: str, body: bytes) -> bytes:
        """The body of a sample, converted.

        :param language: ``json`` or ``cbor``
        :raises SwitchboardError: it is no message of this type, or the type is not known
        """
        reader = self._readers.get(language)
        if reader is None:
            found = self.types.reader(self.type, language) if self.cdr else _REENCODERS[language]
            reader = self._readers[language] = found
        return reader(body)


class Sample:
    """One message of the robot. It is converted when it is sent to the first client, once for each format.

    :param body: in the robot's encoding
    :param ros_time_ns: the robot's time when it received the message, nanoseconds since 1970 or since the
        simulation began
    """

    __slots__ = (
        "_cached",
        "_cached_bytes",
        "_json",
        "_other_bodies",
        "_pngs",
        "body",
        "converter",
        "plain",
        "plain_format",
        "ros_time_ns",
        "size",
    )

    def __init__(self, body: bytes, ros_time_ns: int, converter: Converter) -> None:
        self.body = body
        self.ros_time_ns = ros_time_ns
        self.converter = converter
        self.size = len(body)
        # Most samples are rendered in one plain format only; the tables for others are made when needed.
        self._json: bytes | SwitchboardError | None = None
        self.plain_format: OutputFormat | None = None
        self.plain = b""
        self._other_bodies: dict[str, bytes | SwitchboardError] | None = None
        self._pngs: dict[str, bytes] | None = None
        self._cached: dict[OutputFormat, Rendered] | None = None
        self._cached_bytes = 0

    def render(self, format: OutputFormat, quota: UserQuota) -> bytes | Rendered:
        """The websocket frames in a format.

        A costly encoding counts towards the quota; if that is used up, the frames are plain JSON instead. Other clients
        get a format that was rendered already without cost.

        :returns: the frames; or a :class:`Rendered` if the client must be notified of something
        """
        if format is self.plain_format:
            return self.plain
        if format.head and self.plain_format is None:
            frames = self._render_first_plain(format)
            if frames is not None:
                return frames
        rendered = self._cached_render(format) or self._render_within(format, quota)
        if rendered.error is None and rendered.frames is not None:
            return rendered.frames
        return rendered

    def json(self) -> bytes | SwitchboardError:
        """The message as JSON, or the error why it can't be converted."""
        return self._body_in("json")

    def _render_first_plain(self, format: OutputFormat) -> bytes | None:
        """Frames in the first plain format, as :meth:`_render` makes them; ``None``: the sample can't be converted."""
        body = self._json
        if body is None:
            body = self._json = self._convert("json")
        if isinstance(body, SwitchboardError):
            return None
        self.plain_format = format
        self.plain = websocket_frames.text_of(format.head, body, b"}")
        self._cached_bytes += len(self.plain)
        return self.plain

    def _cached_render(self, format: OutputFormat) -> Rendered | None:
        if format == self.plain_format:
            return Rendered(self.plain)
        return None if self._cached is None else self._cached.get(format)

    def _render_within(self, format: OutputFormat, quota: UserQuota) -> Rendered:
        if not self._costly(format.encoding):
            return self._cache(format, self._render(format))
        if quota.may_encode:
            with quota.encoding():
                return self._cache(format, self._render(format))
        format = output_format_for(format.names, PLAIN)
        plain = self._cached_render(format) or self._cache(format, self._render(format))
        if plain.error is not None:
            return plain
        return Rendered(plain.frames, RenderError.TOO_COSTLY, TOO_COSTLY)

    def _costly(self, encoding: MessageEncoding) -> bool:
        if encoding.compression in ("cbor", "cbor-raw"):
            return encoding.compression == "cbor" and not self.converter.cdr
        if encoding == PLAIN:
            return False
        body = self._body_in("json")
        return not isinstance(body, SwitchboardError) and encoding.costly(len(body) + _HEAD_BYTES)

    def _render(self, format: OutputFormat) -> Rendered:
        compression = format.encoding.compression
        language = "cbor" if compression == "cbor" else "json"
        error, words = None, ""
        if compression == "cbor-raw":
            if self.converter.cdr:
                language = compression
            else:
                error = RenderError.NOT_CDR
                words = "its messages are JSON, not CDR, so cbor-raw is plain JSON here"
        if language == "cbor" and not self.converter.cdr and self.size > encodings.MAX_CBOR:
            language, error = "json", RenderError.TOO_LARGE
            words = f"JSON messages longer than {encodings.MAX_CBOR} bytes are sent as JSON, not as CBOR"
        body = self._body_in(language)
        if isinstance(body, SwitchboardError):
            return Rendered(None, RenderError.BROKEN, f"a message can't be converted: {body}")
        if language != "json":
            messages = [websocket_frames.binary(encodings.publish(name, body)) for name in format.names]
            return Rendered(b"".join(messages))
        texts = [rosbridge.publish(name, body) for name in format.names]
        if compression == "png":
            if len(body) <= encodings.MAX_PNG:
                texts = [self._png(name, text) for name, text in zip(format.names, texts, strict=True)]
            else:
                error = RenderError.TOO_LARGE
                words = f"messages longer than {encodings.MAX_PNG} bytes are sent as plain JSON, not as PNG"
        frames = [text_frames(each, format.encoding.fragment_size) for each in texts]
        return Rendered(frames[0] if len(frames) == 1 else b"".join(frames), error, words)

    def _body_in(self, language: str) -> bytes | SwitchboardError:
        if language == "json":
            if self._json is None:
                self._json = self._convert(language)
            return self._json
        if self._other_bodies is None:
            self._other_bodies = {}
        found = self._other_bodies.get(language)
        if found is None:
            found = self._other_bodies[language] = self._convert(language)
        return found

    def _convert(self, language: str) -> bytes | SwitchboardError:
        if language == "cbor-raw":
            return encodings.raw(self.ros_time_ns, self.body)
        try:
            return self.converter.convert(language, self.body)
        except SwitchboardError as error:
            self.converter.on_failure(str(error))
            return error

    def _png(self, name: str, text: bytes) -> bytes:
        if self._pngs is None:
            self._pngs = {}
        found = self._pngs.get(name)
        if found is None:
            found = self._pngs[name] = encodings.png(text)
        return found

    def _cache(self, format: OutputFormat, rendered: Rendered) -> Rendered:
        """Cache a rendered sample, within bounds: latched samples stay long, and clients choose the formats."""
        if self._cached is None:
            self._cached = {}
        self._cached[format] = rendered
        self._cached_bytes += len(rendered.frames or b"")
        while self._cached_bytes > 4 * self.size + _SPARE_BYTES and len(self._cached) > 1:
            gone = self._cached.pop(next(iter(self._cached)))
            self._cached_bytes -= len(gone.frames or b"")
        return rendered


def _json_from_json(body: bytes) -> bytes:
    if len(body) > limits.JSON_BODY:
        raise _too_large(body)
    return jsontext.recode(body)


def _cbor_from_json(body: bytes) -> bytes:
    if len(body) > limits.JSON_BODY:
        raise _too_large(body)
    return cbor2.dumps(jsontext.decode_any(body))


def _too_large(body: bytes) -> Invalid:
    return Invalid(f"JSON of {len(body)} bytes; a sample in JSON may have {limits.JSON_BODY}")


_REENCODERS: dict[str, Reader] = {"json": _json_from_json, "cbor": _cbor_from_json}
"""JSON of a robot is decoded and encoded again, so that clients get well-formed JSON only."""
