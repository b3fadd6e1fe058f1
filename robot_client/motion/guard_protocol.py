"""The messages between the daemon and its guard: one JSON array per line on two pipes."""

from __future__ import annotations

import msgspec

from robot_client.motion.typed_topic import TypedTopic

CANCEL = "/_action/cancel_goal"
CANCEL_TYPE = "action_msgs/srv/CancelGoal"

GOALS_WITHIN_MS = 2000
"""How long the daemon may be silent about goals that move the robot, milliseconds. Longer than for commands: a short
stall must not cancel a goal that may take an hour."""


def cancelling(action: str) -> TypedTopic:
    """The name under which the guard knows an action; publishing its zero means requesting to cancel all goals."""
    return TypedTopic(action + CANCEL, CANCEL_TYPE)


class _OfTopic(msgspec.Struct, array_like=True, frozen=True):
    topic: str
    type: str

    @property
    def typed_topic(self) -> TypedTopic:
        """Name and type together."""
        return TypedTopic(self.topic, self.type)


class GuardedTopic(_OfTopic, array_like=True, tag_field="line", tag="topic", frozen=True):
    """Commands may come on this topic, or goals of this action (:func:`cancelling`): create a publisher or client.

    :ivar within_ms: time to stop of this topic alone, milliseconds; 0: that of the guard
    """

    within_ms: int = 0


class ZeroTemplate(_OfTopic, array_like=True, tag_field="line", tag="zero_template", frozen=True):
    """Zero template of the next commands on this topic, without a stamp; see ``Platform.zero_template``."""

    zero_template: bytes


class Forget(_OfTopic, array_like=True, tag_field="line", tag="forget", frozen=True):
    """No more commands will come on this topic; remove the publisher once the topic is stopped."""


class GuardedCommand(_OfTopic, array_like=True, tag_field="line", tag="command", frozen=True):
    """A command is about to move a topic, or zero was published.

    :ivar moving: whether it was other than zero
    :ivar at: clock of :mod:`relay_protocol.clocks`, nanoseconds
    """

    moving: bool
    at: int


class Probe(msgspec.Struct, array_like=True, tag_field="line", tag="probe", frozen=True):
    """Requests :class:`GuardAlive`."""


class ShutDown(msgspec.Struct, array_like=True, tag_field="line", tag="shut_down", frozen=True):
    """The daemon shuts down; stop the topics that still move, then exit."""


class GuardAlive(msgspec.Struct, array_like=True, tag_field="line", tag="alive", frozen=True):
    """The guard's answer to a probe, and its first line."""


class TopicReady(_OfTopic, array_like=True, tag_field="line", tag="ready", frozen=True):
    """The guard's publisher has matched a subscriber: from now on the guard can stop this topic."""


Line = GuardedTopic | ZeroTemplate | Forget | GuardedCommand | Probe | ShutDown
Answer = GuardAlive | TopicReady

decoder: msgspec.json.Decoder[Line] = msgspec.json.Decoder(Line)
answer_decoder: msgspec.json.Decoder[Answer] = msgspec.json.Decoder(Answer)
_encoder = msgspec.json.Encoder()


def encode(line: Line | Answer) -> bytes:
    """Encode a line, with its newline."""
    return _encoder.encode(line) + b"\n"
