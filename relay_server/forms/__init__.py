"""In what form a client wants its messages: plain JSON, PNG or CBOR, whole or in fragments (SPEC section 1.6)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

from relay_protocol import rosbridge
from relay_server import wsframe
from relay_server.forms import cbor, fragments, png

COMPRESSIONS = ("none", "png", "cbor", "cbor-raw")


class Form(NamedTuple):
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


PLAIN = Form()

TOO_COSTLY = (
    "PNG, fragments and CBOR made of JSON take much of the relay's processor, and your share is used up; "
    "plain JSON is sent until there is some left"
)
"""What a client is told that gets plain JSON for a while."""


class Asking(Protocol):
    """``subscribe``, ``call_service`` and ``send_action_goal``: operations that say in what form they want answers."""

    @property
    def id(self) -> rosbridge.Id: ...

    @property
    def compression(self) -> str: ...

    @property
    def fragment_size(self) -> int | None: ...


Tell = Callable[[str, str, rosbridge.Id], None]
"""Takes the level, the words and the id of a ``status``; see :meth:`relay_server.session.Session.tell`."""


def asked(ask: Asking, tell: Tell, *, topic: bool = False) -> Form:
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
    if 0 < size < fragments.LEAST:
        tell("warning", f"fragments of {size} bytes are too small; they have {fragments.LEAST}", ask.id)
        size = fragments.LEAST
    return Form(compression, size)


def frames(message: bytes, form: Form = PLAIN) -> bytes:
    """The websocket frames of one message.

    :param message: JSON. In PNG it goes only if it is no longer than :data:`relay_server.forms.png.MOST`, in CBOR only
        up to :data:`relay_server.forms.cbor.MOST`.
    """
    if form == PLAIN:
        return wsframe.text(message)
    if form.compression in ("cbor", "cbor-raw") and len(message) <= cbor.MOST:
        return wsframe.binary(cbor.from_json(message))
    if form.compression == "png" and len(message) <= png.MOST:
        message = png.encode(message)
    return divided(message, form.fragment_size)


def divided(message: bytes, size: int) -> bytes:
    """The websocket frames of a text message, in fragments if it is longer than their size.

    :param size: bytes of ``data``; 0 for no fragments
    """
    if not size:
        return wsframe.text(message)
    return b"".join(map(wsframe.text, fragments.divide(message, size)))
