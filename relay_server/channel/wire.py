"""What a channel's parts share: the link to the robot, when there is one, and numbers for what goes over it."""

from __future__ import annotations

import itertools
import re
from typing import Protocol

from twisted.internet.defer import Deferred

from relay_protocol import limits, link, rosbridge
from relay_protocol.errors import Invalid
from relay_server.registry import Presence

NAMES = 4096
"""Topics subscribed or advertised on one robot at a time."""

_NAME = re.compile(r"/[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*\Z")


class ChannelLink(Protocol):
    """The robot's end of a channel."""

    def send(self, message: link.Message) -> None:
        """Queue a message that must not be lost."""

    def sample(self, number: int, stamp: int, body: bytes) -> None:
        """Queue a sample; the newest survive."""

    def close(self, reason: str) -> None:
        """Say ``bye`` and end the connection."""

    def round_trip(self) -> Deferred[float]:
        """Ping the robot; seconds, or a failure when the link ends first."""


class Member(Protocol):
    """A session, as a channel uses it."""

    def tell(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """Report something in words, to clients that want to hear it."""


class Wire:
    """The open link to the robot, or none, and what names and numbers are in use on it."""

    def __init__(self, robot: Presence) -> None:
        self.robot = robot
        self.link: ChannelLink | None = None
        self.names = 0
        self._numbers = itertools.count(1)

    @property
    def cdr(self) -> bool:
        """Whether bodies go as CDR; else as JSON."""
        return "cdr" in self.robot.encodings

    def number(self) -> int:
        """A fresh number for a subscription or publication.

        :raises Invalid: too many topics are in use on this robot
        """
        if self.names >= NAMES:
            raise Invalid(f"more than {NAMES} topics are in use on this robot")
        self.names += 1
        return next(self._numbers)

    def send(self, message: link.Message) -> None:
        """Send if there is a link; what matters is sent again when one opens."""
        if self.link is not None:
            self.link.send(message)


def resolve(name: str) -> str:
    """The full name of a topic or service as a client wrote it, with or without its leading slash.

    :raises Invalid: no name ROS 2 could have (design.ros2.org, topic and service names)
    """
    full = name if name.startswith("/") else "/" + name
    if len(full) > limits.NAME or not _NAME.match(full):
        raise Invalid(
            f"'{name[:80]}' is no ROS name: letters, digits and '_' between slashes, "
            f"no part beginning with a digit, at most {limits.NAME} characters"
        )
    return full
