"""In what form a client wants its messages: plain JSON, PNG or CBOR, whole or in fragments (SPEC section 1.6)."""

from __future__ import annotations

from typing import NamedTuple

from relay_server import wsframe


class Form(NamedTuple):
    """What a client asked for.

    :param compression: ``none``, ``png``, ``cbor`` or ``cbor-raw``
    :param fragment_size: bytes of a fragment's ``data``; 0 for whole messages
    """

    compression: str = "none"
    fragment_size: int = 0


PLAIN = Form()


def frames(message: bytes, form: Form) -> bytes:
    """The websocket frames of one message.

    :param message: JSON
    """
    return wsframe.text(message)
