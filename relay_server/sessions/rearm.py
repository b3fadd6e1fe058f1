"""Hands on the stick: who commanded in vain and goes on does not move the robot the moment he has control."""

from __future__ import annotations

from typing import Any

from relay_protocol import jsontext
from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import KIB
from relay_server.control.types import LET_GO_SECONDS

LET_GO_NS = round(LET_GO_SECONDS * 1e9)

TOPICS = 64
"""Topics of one client that are remembered; the longest quiet are forgotten first."""

STILL_BYTES = 64 * KIB
"""A longer command is not looked at, and counts as one that moves."""

_TRAJECTORIES = frozenset(
    {"trajectory_msgs/msg/JointTrajectory", "trajectory_msgs/msg/MultiDOFJointTrajectory"}
)
_BESIDE = {"control_msgs/msg/JointJog": ("header", "joint_names", "duration")}
"""By type, the fields that move nothing."""


class ReleaseTracker:
    """The topics one client commanded in vain, and when it did so last. Times are monotonic nanoseconds."""

    __slots__ = ("_latest",)

    def __init__(self) -> None:
        self._latest: dict[str, int] = {}

    def in_vain(self, topic: str, now: int) -> None:
        """A command that moves was refused."""
        self._latest.pop(topic, None)
        self._latest[topic] = now
        while len(self._latest) > TOPICS:
            del self._latest[next(iter(self._latest))]

    def let_go(self, topic: str) -> None:
        """It said zero."""
        self._latest.pop(topic, None)

    def holds(self, topic: str, now: int) -> bool:
        """Whether it has not let go of a topic since: by a zero, or by silence."""
        since = self._latest.get(topic)
        return since is not None and now - since < LET_GO_NS


def is_zero_command(type_name: str, body: bytes) -> bool:
    """Whether a command is zero (docs/safety.md, "Zero, by type"). What can't be told counts as one that moves.

    :param type_name: full name
    :param body: JSON
    """
    if len(body) > STILL_BYTES:
        return False
    try:
        message = jsontext.decode_any(body)
    except SwitchboardError:
        return False
    if not isinstance(message, dict):
        return False
    if type_name in _TRAJECTORIES:  # to all zeros is a way as well
        return not message.get("points")
    beside = _BESIDE.get(type_name, ("header",))
    return all(_nothing(value) for field, value in message.items() if field not in beside)


def _nothing(value: Any) -> bool:
    """Whether all numbers in a value are 0. Text may be bytes in base64, and ``null`` is no number."""
    if isinstance(value, dict):
        return all(_nothing(each) for field, each in value.items() if field != "header")
    if isinstance(value, list):
        return all(map(_nothing, value))
    return value is not None and not value
