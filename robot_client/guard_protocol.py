"""What the daemon tells its guard: one JSON array per line on a pipe."""

from __future__ import annotations

import msgspec


class Topic(msgspec.Struct, array_like=True, tag_field="line", tag="topic", frozen=True):
    """Commands may come on this topic; have a publisher ready."""

    topic: str
    type: str


class Command(msgspec.Struct, array_like=True, tag_field="line", tag="command", frozen=True):
    """A command went out. ``at`` is the monotonic clock of the machine, nanoseconds."""

    topic: str
    moving: bool
    at: int


class Probe(msgspec.Struct, array_like=True, tag_field="line", tag="probe", frozen=True):
    """Answer with a line."""


class Leave(msgspec.Struct, array_like=True, tag_field="line", tag="leave", frozen=True):
    """The daemon ends in order, the robot stands; go."""


Line = Topic | Command | Probe | Leave

ALIVE = b"alive\n"

decoder: msgspec.json.Decoder[Line] = msgspec.json.Decoder(Line)
_encoder = msgspec.json.Encoder()


def encode(line: Line) -> bytes:
    """A line with its end."""
    return _encoder.encode(line) + b"\n"
