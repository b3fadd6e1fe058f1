"""Fields of link messages: texts of bounded length, words for people, bytes."""

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
Label = Annotated[str, Meta(max_length=limits.LABEL)]
Ends = Annotated[list[Name], Meta(max_length=limits.GRAPH_ENDS)]
Source = Annotated[int, Meta(ge=0, le=2**32 - 1)]
"""A connection of a client, as the relay numbers them; 0 is nobody."""

Stamp = Annotated[int, Meta(ge=0, le=2**63 - 1)]
"""A moment of the relay's monotonic clock, nanoseconds, before which something can't have been sent."""

Few = Annotated[list[Name], Meta(max_length=limits.FACTS)]


def cut(message: msgspec.Struct, *fields: str) -> None:
    """Words for people are cut, on either end: they are no reason to lose a link."""
    for field in fields:
        text = getattr(message, field)
        if len(text) > limits.WORDS:
            force_setattr(message, field, text[: limits.WORDS - 1] + "…")


class Reasoned(Message, frozen=True, kw_only=True):
    """Base of messages that end with a ``reason``."""

    def __post_init__(self) -> None:
        cut(self, "reason")


def to_base64(data: bytes) -> str:
    """Bytes for a JSON field (RFC 4648 section 4)."""
    return base64.b64encode(data).decode("ascii")


def from_base64(text: str, what: str) -> bytes:
    """The bytes of a JSON field; ``what`` names it in the error.

    :raises Invalid: not base64
    """
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise Invalid(f"{what} is not base64") from None
