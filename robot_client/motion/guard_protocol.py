"""What the daemon and its guard tell each other: one JSON array per line on two pipes."""

from __future__ import annotations

import msgspec

from robot_client.motion.typed_topic import TypedTopic

CANCEL = "/_action/cancel_goal"
CANCEL_TYPE = "action_msgs/srv/CancelGoal"

GOALS_WITHIN_MS = 2000
"""How long a daemon may say nothing of goals that move the robot: a stall that a driver hardly notices must not end
what was to go on for an hour."""


def cancelling(action: str) -> TypedTopic:
    """What the guard knows an action by: its zero is the request to cancel all goals."""
    return TypedTopic(action + CANCEL, CANCEL_TYPE)


class _OfTopic(msgspec.Struct, array_like=True, frozen=True):
    topic: str
    type: str

    @property
    def on(self) -> TypedTopic:
        """What it is about."""
        return TypedTopic(self.topic, self.type)


class GuardedTopic(_OfTopic, array_like=True, tag_field="line", tag="topic", frozen=True):
    """Commands may come on this topic; have a publisher ready. Or goals of this action, see :func:`cancelling`.

    :ivar within_ms: time to stop of this topic alone, milliseconds; 0: that of the guard
    """

    within_ms: int = 0


class ZeroShape(_OfTopic, array_like=True, tag_field="line", tag="shape", frozen=True):
    """What the next commands on this topic look like when they are zero, without a stamp; see ``Platform.resting``."""

    rest: bytes


class Forget(_OfTopic, array_like=True, tag_field="line", tag="forget", frozen=True):
    """No more commands will come on this topic; take the publisher away once the robot stands."""


class GuardedCommand(_OfTopic, array_like=True, tag_field="line", tag="command", frozen=True):
    """A command went out. ``at`` is the clock of :mod:`relay_protocol.clocks`, nanoseconds."""

    moving: bool
    at: int


class Probe(msgspec.Struct, array_like=True, tag_field="line", tag="probe", frozen=True):
    """Answer with a line."""


class Leave(msgspec.Struct, array_like=True, tag_field="line", tag="leave", frozen=True):
    """The daemon ends in order; stop what it could not, and go."""


class GuardAlive(msgspec.Struct, array_like=True, tag_field="line", tag="alive", frozen=True):
    """The guard's answer to a probe, and its first word."""


class TopicReady(_OfTopic, array_like=True, tag_field="line", tag="ready", frozen=True):
    """The guard's publisher has found who listens to this topic: from now on it could stop it."""


Line = GuardedTopic | ZeroShape | Forget | GuardedCommand | Probe | Leave
Answer = GuardAlive | TopicReady

decoder: msgspec.json.Decoder[Line] = msgspec.json.Decoder(Line)
answer_decoder: msgspec.json.Decoder[Answer] = msgspec.json.Decoder(Answer)
_encoder = msgspec.json.Encoder()


def encode(line: Line | Answer) -> bytes:
    """A line with its end."""
    return _encoder.encode(line) + b"\n"
