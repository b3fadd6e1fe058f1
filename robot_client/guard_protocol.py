"""What the daemon and its guard tell each other: one JSON array per line on two pipes."""

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


class Alive(msgspec.Struct, array_like=True, tag_field="line", tag="alive", frozen=True):
    """The guard's answer to a probe, and its first word."""


class Ready(msgspec.Struct, array_like=True, tag_field="line", tag="ready", frozen=True):
    """The guard's publisher has found who listens to this topic: from now on it could stop it."""

    topic: str


Line = Topic | Command | Probe | Leave
Answer = Alive | Ready

decoder: msgspec.json.Decoder[Line] = msgspec.json.Decoder(Line)
answer_decoder: msgspec.json.Decoder[Answer] = msgspec.json.Decoder(Answer)
_encoder = msgspec.json.Encoder()


def encode(line: Line | Answer) -> bytes:
    """A line with its end."""
    return _encoder.encode(line) + b"\n"
