"""All channels of a relay, and the tickets with which robots join them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from relay_protocol.errors import Refused
from relay_server.channels.channel import Channel
from relay_server.common.clock import Clock
from relay_server.common.connection_ids import name_of
from relay_server.robots.registry import RobotState
from relay_server.robots.tickets import Tickets


class Channels:
    """Opens channels on demand and tells robots' joining links to which one they belong.

    :param new_ticket: makes an unguessable text, for tickets and for what clients are asked
    :param wall_ns: Unix time in nanoseconds
    """

    def __init__(
        self,
        clock: Clock,
        *,
        linger: float,
        new_ticket: Callable[[], str],
        wall_ns: Callable[[], int],
    ) -> None:
        self._clock = clock
        self._linger = linger
        self._new_ticket = new_ticket
        self._wall_ns = wall_ns
        self._channels: dict[int, Channel] = {}
        self._tickets: Tickets[Channel] = Tickets(clock, new_ticket)

    def __iter__(self) -> Iterator[Channel]:
        return iter(list(self._channels.values()))

    def of(self, robot: RobotState) -> Channel:
        """The robot's channel, a new one when there is none."""
        channel = self._channels.get(robot.robot_id)
        if channel is None:
            channel = self._channels[robot.robot_id] = Channel(
                self._clock,
                robot,
                name_of(f"{robot.name}#", (each.name for each in self)),
                linger=self._linger,
                issue_ticket=self._tickets.issue,
                closed=self._forget,
                new_id=self._new_ticket,
                wall_ns=self._wall_ns,
            )
        return channel

    def find(self, robot: RobotState) -> Channel | None:
        """The robot's channel, if it has one."""
        return self._channels.get(robot.robot_id)

    def redeem(self, ticket: str) -> Channel:
        """The channel a ticket is for; the ticket is spent.

        :raises Refused: unknown, used or too old
        """
        channel = self._tickets.redeem(ticket)
        if channel is None:
            raise Refused("the channel ticket is unknown, used or too old")
        return channel

    def _forget(self, channel: Channel) -> None:
        if self._channels.get(channel.robot.robot_id) is channel:
            del self._channels[channel.robot.robot_id]
        self._tickets.withdraw(channel)
