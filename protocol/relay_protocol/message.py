"""What every JSON message is made of, on the robot link and from clients alike."""

from __future__ import annotations

import msgspec

Body = msgspec.Raw | msgspec.UnsetType
"""A JSON value that stays undecoded until its type is known, in a field that may be absent."""


def lower_tag(name: str) -> str:
    """``OpenChannel`` is written ``open_channel``."""
    return "".join("_" + letter.lower() if letter.isupper() else letter for letter in name).lstrip("_")


class Message(msgspec.Struct, tag_field="op", tag=lower_tag, omit_defaults=True, frozen=True):
    """Base of everything with an ``op``."""
