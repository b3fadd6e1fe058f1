"""The open link of a channel to its robot, and the numbers and names in use on it."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Protocol

from twisted.internet.defer import Deferred

from relay_protocol import link
from relay_protocol.errors import Invalid
from relay_server.channels.robot_requests import RobotRequestQueue
from relay_server.common.clock import Clock
from relay_server.robots.registry import RobotState


class ChannelLinkPort(Protocol):
    """The link of one channel to the robot: a :class:`relay_server.robots.connection.RobotConnection`."""

    def send(self, message: link.Message) -> None:
        """Queue a message that must not be lost.

        :raises Unavailable: too much waits for a slow robot; only calls, goals and answers are refused
        """

    def message_sender(
        self, number: int, convert: Callable[[bytes], bytes] = bytes, *, commands: bool
    ) -> Callable[[int, int, bytes], None]:
        """The function that queues messages of one publication; the oldest are dropped.

        :param convert: converts a body to the robot's encoding; ``bytes``: bodies are in that encoding
        :returns: a function of ``earliest_sent``, the number of the client's connection (sent with commands only,
            SPEC 2.5), and the body
        """

    def send_newest(self, key: str, message: link.Message) -> None:
        """Queue a message; it replaces a queued one with the same key."""

    def close(self, reason: str) -> None:
        """Send ``bye`` and end the connection."""

    def round_trip(self) -> Deferred[float]:
        """Ping the robot; fires with seconds, or fails when the link ends first."""


NAMES = 4096
"""Most topics, services and actions in use on one robot: subscribed, advertised or offered."""

USER_TOPICS = 256
"""Most topics of one robot that one user has subscribed, over all connections; advertised ones are counted apart."""


class RobotLinkState:
    """The open link to the robot, if there is one, and the numbers in use on it.

    :ivar link: ``None`` while the channel is not open
    :ivar names_in_use: topics, services and actions; see :data:`NAMES`
    """

    def __init__(self, clock: Clock, robot: RobotState) -> None:
        self.clock = clock
        self.robot = robot
        self.link: ChannelLinkPort | None = None
        self.robot_requests = RobotRequestQueue(clock, self.send)
        self.names_in_use = 0
        self._numbers = itertools.count(1)

    @property
    def cdr(self) -> bool:
        """Whether the robot speaks CDR; else it speaks JSON."""
        return "cdr" in self.robot.encodings

    def new_number(self) -> int:
        """A number that was never used, for a subscription or publication.

        :raises Invalid: too many names are in use on this robot
        """
        self.reserve_name()
        return next(self._numbers)

    def reserve_name(self) -> None:
        """Count one more name in use.

        :raises Invalid: too many are
        """
        if self.names_in_use >= NAMES:
            raise Invalid(f"more than {NAMES} names are in use on this robot")
        self.names_in_use += 1

    def send(self, message: link.Message) -> None:
        """Send a message if there is a link; subscriptions and advertisements are sent again when one opens.

        :raises Unavailable: see :meth:`ChannelLinkPort.send`
        """
        if self.link is not None:
            self.link.send(message)
