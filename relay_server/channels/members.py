"""The members of a channel, as its parts see them, and the calls and goals that they send to the robot."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from relay_protocol import rosbridge


class ChannelMember(Protocol):
    """Uses topics of a channel: a client (:class:`ClientMember`), a recording, or a part of the channel itself."""

    @property
    def user(self) -> int:
        """The number of its user, whose limits count over all connections."""

    def notify(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """Send a status, if the client has requested that level."""


class ClientMember(ChannelMember, Protocol):
    """The session of a client, which also publishes, calls services and sends goals.

    It is a :class:`~relay_server.sessions.context.ClientContext`.

    :ivar number: of its connection, by which the robot knows which client moves it
    """

    number: int

    def warn_of_drops(self, text: str, id: rosbridge.Id = None) -> None:
        """Warn of messages that are dropped; a port that shows the counts itself ignores it."""


class AttachedMember(ChannelMember, Protocol):
    """A member that keeps the channel open: a client or a recording."""

    def recheck_rights(self) -> None:
        """Check its subscriptions again, as the robot's topics or cameras have changed."""


class MotionConditions(Protocol):
    """The conditions of a call or a goal that moves the robot; see :mod:`relay_server.sessions.motion_requests`."""

    async def wait_for_control(self) -> None:
        """Wait until its client controls the robot.

        :raises Refused: another client does, or the request may be too old by now
        :raises Unavailable: the robot does not agree
        """

    def check_age(self) -> None:
        """:raises Refused: the request may be too old by now"""


class RequestContext(NamedTuple):
    """The origin of a call or goal that is sent to the robot.

    :param source: number of the connection it comes from
    :param earliest_sent: see :attr:`relay_server.sessions.message_age.MessageAge.earliest_sent`; ``None``: unknown
    :param motion_request: set if it moves the robot
    """

    source: int
    earliest_sent: int | None = None
    motion_request: MotionConditions | None = None

    async def wait_for_control(self) -> None:
        """Wait for control if it moves the robot; see :meth:`MotionConditions.wait_for_control`."""
        if self.motion_request is not None:
            await self.motion_request.wait_for_control()

    def check_age(self) -> None:
        """Check the age if it moves the robot; see :meth:`MotionConditions.check_age`."""
        if self.motion_request is not None:
            self.motion_request.check_age()
