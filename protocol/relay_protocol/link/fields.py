"""Field types of link messages: texts and lists of bounded length, connection numbers, base64."""

from __future__ import annotations

import base64
import binascii
from typing import Annotated

import msgspec
from msgspec import Meta
from msgspec.structs import force_setattr

from relay_protocol import limits
from relay_protocol.errors import Invalid
from relay_protocol.message import Message

Name = Annotated[str, Meta(max_length=limits.NAME)]
Label = Annotated[str, Meta(max_length=limits.LABEL_LENGTH)]
NodeList = Annotated[list[Name], Meta(max_length=limits.GRAPH_NODES)]
Source = Annotated[int, Meta(ge=0, le=2**32 - 1)]
"""Number of a client connection, given by the relay; 0 for none."""

Stamp = Annotated[int, Meta(ge=0, le=2**63 - 1)]
"""Time of the relay's monotonic clock, nanoseconds, after which a message was sent."""

NameList = Annotated[list[Name], Meta(max_length=limits.LIST_ITEMS)]


def cut(message: msgspec.Struct, *fields: str) -> None:
    """Shorten texts for display to ``limits.TEXT_LENGTH``, so that a long one does not end a link."""
    for field in fields:
        text = getattr(message, field)
        if len(text) > limits.TEXT_LENGTH:
            force_setattr(message, field, text[: limits.TEXT_LENGTH - 1] + "…")


class Reasoned(Message, frozen=True, kw_only=True):
    """Base of messages that end with a ``reason``."""

    def __post_init__(self) -> None:
        cut(self, "reason")


def to_base64(data: bytes) -> str:
    """Bytes for a JSON field (RFC 4648 section 4)."""
    return base64.b64encode(data).decode("ascii")


def from_base64(text: str, what: str) -> bytes:
    """Bytes from a JSON field.

    :param what: name of the field, for the error
    :raises Invalid: not base64
    """
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise Invalid(f"{what} is not base64 (RFC 4648 section 4)") from None
