"""Base of all JSON messages, of robots and of clients."""

from __future__ import annotations

import msgspec

Body = msgspec.Raw | msgspec.UnsetType
"""A JSON value that is decoded later, when its type is known; the field may be absent."""


def lower_tag(name: str) -> str:
    """The ``op`` of a message class: ``open_channel`` for ``OpenChannel``."""
    return "".join("_" + letter.lower() if letter.isupper() else letter for letter in name).lstrip("_")


class Message(msgspec.Struct, tag_field="op", tag=lower_tag, omit_defaults=True, frozen=True):
    """Base of messages with an ``op``."""
