"""One message from a robot, on its way to many clients: converted once for each form anybody wants."""

from __future__ import annotations

import enum
from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import cbor2

from relay_protocol import jsontext, limits, rosbridge
from relay_protocol.errors import Invalid, SwitchboardError
from relay_protocol.limits import KIB
from relay_protocol.ros.compiled import Reader
from relay_protocol.ros_types import TypeRegistry
from relay_server.channels import encodings
from relay_server.channels.encodings import PLAIN, MessageEncoding, divided
from relay_server.common import websocket_frames

if TYPE_CHECKING:
    from relay_server.channels.client_subscription import ClientSubscription

_SPARE = 64 * KIB
"""What is made ready of one sample may take four times its size, and so much more; it can be made again."""

_HEAD = 32
"""Bytes of a ``publish`` around its ``msg``, at least."""


class OutputFormat(NamedTuple):
    """What a client wants to get of each sample.

    :param names: the topic as the client writes it; one message goes under each
    :param head: what comes before the body, where the wish is for one message in plain JSON; else empty
    """

    names: tuple[str, ...]
    form: MessageEncoding
    head: bytes


@lru_cache(maxsize=1024)
def output_format_for(names: tuple[str, ...], form: MessageEncoding) -> OutputFormat:
    """What a client wants. Nearly all who want the same share one object, so that it is known at a glance."""
    plain = form == PLAIN and len(names) == 1
    return OutputFormat(names, form, rosbridge.publish_head(names[0]) if plain else b"")


class RenderError(enum.Enum):
    """Why a client does not get a sample as it wants it."""

    BROKEN = "broken"
    NOT_CDR = "not cdr"
    TOO_LARGE = "too large"
    NOT_SENT = "not sent"


class Rendered(NamedTuple):
    """What is made of a sample for one wish.

    :param frames: websocket frames; ``None`` when it can't be converted
    :param flaw: what the client is to be told, once, and ``words`` for it
    """

    frames: bytes | None
    flaw: RenderError | None = None
    words: str = ""


class Converter:
    """What turns the samples of one topic into JSON and CBOR.

    It stays right until the type's definition is replaced.

    :param encoding: of the samples, ``cdr`` or ``json``
    :param failed: called with the words for each sample that can't be converted
    """

    def __init__(
        self, types: TypeRegistry, type_name: str, encoding: str, failed: Callable[[str], None]
    ) -> None:
        self.types = types
        self.type = type_name
        self.cdr = encoding == "cdr"
        self.failed = failed
        self.known = False
        """What was known when it was last asked for; what is known stays known."""
        self._readers: dict[str, Reader] = {}

    @property
    def knows(self) -> bool:
        """Whether all that this takes is known."""
        if not self.known:
            self.known = not self.cdr or self.types.knows(self.type)
        return self.known

    def convert(self, language: str, body: bytes) -> bytes:
        """A sample's body in ``json`` or ``cbor``.

        :raises SwitchboardError: it is no message of this type, or the type is not known
        """
        reader = self._readers.get(language)
        if reader is None:
            found = self.types.reader(self.type, language) if self.cdr else _ANEW[language]
            reader = self._readers[language] = found
        return reader(body)


class Sample:
    """One message from the robot. It is converted only if somebody takes it, and then once for all who want it so.

    :param body: as the robot sent it
    :param stamp: the robot's time when it came, nanoseconds: since 1970, or since the simulation began
    """

    __slots__ = (
        "_json",
        "_others",
        "_pictures",
        "_plain",
        "_plain_wish",
        "_ready",
        "_ready_bytes",
        "body",
        "converter",
        "size",
        "stamp",
    )

    def __init__(self, body: bytes, stamp: int, converter: Converter) -> None:
        self.body = body
        self.stamp = stamp
        self.converter = converter
        self.size = len(body)
        # The first plain form, which is most often the only one, needs no table. The others are made when it is not.
        self._json: bytes | SwitchboardError | None = None
        self._plain_wish: OutputFormat | None = None
        self._plain = b""
        self._others: dict[str, bytes | SwitchboardError] | None = None
        self._pictures: dict[str, bytes] | None = None
        self._ready: dict[OutputFormat, Rendered] | None = None
        self._ready_bytes = 0

    def open(self, listener: ClientSubscription) -> bytes | None:
        """The websocket frames for a client that listens so; ``None`` when it can't be converted."""
        wish = listener.wish
        if wish is self._plain_wish:
            return self._plain
        if wish.head and self._plain_wish is None:
            frames = self._first_plain(wish)
            if frames is not None:
                return frames
        ready = self._found(wish) or self._ready_for(listener)
        if ready.flaw is not None:
            listener.complain(ready.flaw, ready.words)
        return ready.frames

    def _first_plain(self, wish: OutputFormat) -> bytes | None:
        """What :meth:`_make` would make for the first who wants one message in plain JSON, unless it is broken."""
        body = self._in("json")
        if isinstance(body, SwitchboardError):
            return None
        self._plain_wish = wish
        self._plain = websocket_frames.text_of(wish.head, body, b"}")
        self._ready_bytes += len(self._plain)
        return self._plain

    def _found(self, wish: OutputFormat) -> Rendered | None:
        if wish == self._plain_wish:
            return Rendered(self._plain)
        return None if self._ready is None else self._ready.get(wish)

    def _ready_for(self, listener: ClientSubscription) -> Rendered:
        """Make it ready: at the cost of the client's user where that is much, else as plain JSON.

        Others who want the same form get it without cost.
        """
        wish, allowance = listener.wish, listener.allowance
        if not self._costly(wish.form):
            return self._keep(wish, self._make(wish))
        if allowance.may_form:
            with allowance.forming():
                return self._keep(wish, self._make(wish))
        listener.plainly()
        wish = output_format_for(wish.names, PLAIN)
        return self._found(wish) or self._keep(wish, self._make(wish))

    def _costly(self, form: MessageEncoding) -> bool:
        if form.compression in ("cbor", "cbor-raw"):
            return form.compression == "cbor" and not self.converter.cdr
        if form == PLAIN:
            return False
        body = self._in("json")
        return not isinstance(body, SwitchboardError) and form.costly(len(body) + _HEAD)

    def _make(self, wish: OutputFormat) -> Rendered:
        compression = wish.form.compression
        language = "cbor" if compression == "cbor" else "json"
        flaw, words = None, ""
        if compression == "cbor-raw":
            if self.converter.cdr:
                language = compression
            else:
                flaw, words = (
                    RenderError.NOT_CDR,
                    "its messages are JSON, not CDR, so cbor-raw is plain JSON here",
                )
        if language == "cbor" and not self.converter.cdr and self.size > encodings.MOST_CBOR:
            language, flaw = "json", RenderError.TOO_LARGE
            words = f"JSON messages longer than {encodings.MOST_CBOR} bytes are sent as JSON, not as CBOR"
        body = self._in(language)
        if isinstance(body, SwitchboardError):
            return Rendered(None, RenderError.BROKEN, f"a message can't be converted: {body}")
        if language != "json":
            return Rendered(
                b"".join(websocket_frames.binary(encodings.publish(name, body)) for name in wish.names)
            )
        texts = [rosbridge.publish(name, body) for name in wish.names]
        if compression == "png":
            if len(body) <= encodings.MOST_PNG:
                texts = [self._picture(name, text) for name, text in zip(wish.names, texts, strict=True)]
            else:
                flaw = RenderError.TOO_LARGE
                words = (
                    f"messages longer than {encodings.MOST_PNG} bytes are not sent as PNG but as plain JSON"
                )
        if len(texts) == 1:
            return Rendered(divided(texts[0], wish.form.fragment_size), flaw, words)
        return Rendered(b"".join(divided(each, wish.form.fragment_size) for each in texts), flaw, words)

    def _in(self, language: str) -> bytes | SwitchboardError:
        if language == "json":
            if self._json is None:
                self._json = self._converted(language)
            return self._json
        if self._others is None:
            self._others = {}
        found = self._others.get(language)
        if found is None:
            found = self._others[language] = self._converted(language)
        return found

    def _converted(self, language: str) -> bytes | SwitchboardError:
        if language == "cbor-raw":
            return encodings.raw(self.stamp, self.body)
        try:
            return self.converter.convert(language, self.body)
        except SwitchboardError as error:
            self.converter.failed(str(error))
            return error

    def _picture(self, name: str, text: bytes) -> bytes:
        if self._pictures is None:
            self._pictures = {}
        found = self._pictures.get(name)
        if found is None:
            found = self._pictures[name] = encodings.encode(text)
        return found

    def _keep(self, wish: OutputFormat, ready: Rendered) -> Rendered:
        """Latched samples stay for long: what was made ready of them must not grow with what clients think of."""
        if self._ready is None:
            self._ready = {}
        self._ready[wish] = ready
        self._ready_bytes += len(ready.frames or b"")
        while self._ready_bytes > 4 * self.size + _SPARE and len(self._ready) > 1:
            gone = self._ready.pop(next(iter(self._ready)))
            self._ready_bytes -= len(gone.frames or b"")
        return ready


def _decoded(body: bytes) -> object:
    if len(body) > limits.JSON_BODY:
        raise Invalid(f"JSON of {len(body)} bytes; a sample in JSON may have {limits.JSON_BODY}")
    return jsontext.decode_any(body)


_ANEW: dict[str, Reader] = {
    "json": lambda body: jsontext.encode(_decoded(body)),
    "cbor": lambda body: cbor2.dumps(_decoded(body)),
}
"""A robot's own JSON, decoded and written anew: what goes out is well-formed whatever came in."""
