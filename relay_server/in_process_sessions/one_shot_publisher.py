"""One message to a topic, by a client in this process: sent when the robot can publish it and has a subscriber."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import msgspec
from twisted.internet.defer import CancelledError

from relay_protocol import rosbridge
from relay_protocol.errors import Invalid, NotFound, Refused, Unavailable
from relay_server.channels.names import normal_type
from relay_server.common.clock import Clock, sleep
from relay_server.in_process_sessions.in_process_port import InProcessPort, MaybeDone
from relay_server.sessions.context import ClientContext

LOOK_SECONDS = 0.02
"""Seconds between checks whether the robot is ready for a message."""

SUBSCRIBER_SECONDS = 2.0
"""Most seconds to wait for a subscriber."""

MATCHING_SECONDS = 0.5
"""Time for ROS 2 to match a new publisher with its subscribers, and to send what was published."""


def type_of(client: ClientContext, topic: str, given: str) -> str:
    """The type of a topic, as the client gives it or the robot has it.

    :param given: as the client wrote it; may be empty
    :raises NotFound: neither has a type
    :raises Invalid: the robot has another type
    :raises Unavailable: the robot is offline
    """
    if client.robot.control_link is None:
        raise Unavailable(f"robot {client.robot.name} is offline")
    named, known = normal_type(given), client.channel.publications.known_type(topic)
    if named and known and named != known:
        raise Invalid(f"topic {topic} has the type {known}, not {named}")
    if not named and not known:
        raise NotFound(f"there is no topic {topic} on {client.robot.name}; give its type")
    return named or known


def may_move(client: ClientContext, topic: str, type_name: str) -> bool:
    """Whether a message to this topic may move the robot, by this type or any that the topic has."""
    known = client.robot.graph.topics.get(topic)
    types = {type_name, *(known.types if known is not None else ())}
    return any(client.robot.is_motion(topic, each) for each in types)


class OneShotPublisher:
    """Publishes to a topic for a client in this process.

    :param topic: resolved
    """

    def __init__(self, clock: Clock, port: InProcessPort, topic: str) -> None:
        self._clock = clock
        self._port = port
        self._client = port.client
        self._topic = topic
        self._id = f"advertise {topic}"

    async def publish(self, body: msgspec.Raw, type_name: str, earliest_sent: int | None = None) -> None:
        """Publish a message when a subscriber can get it; without subscribers, after :data:`SUBSCRIBER_SECONDS`.

        :param body: JSON
        :param earliest_sent: as for :meth:`InProcessPort.perform`
        :raises MaybeDone: it was published, and may or may not have arrived
        :raises SwitchboardError: it can't be published, with the reason
        """
        new = self.advertise(type_name)
        if new or not self._is_advertised():
            await self._wait_until(self._is_advertised)
            await self._wait_until(self._has_subscriber, SUBSCRIBER_SECONDS)
            await self._wait_for_matching()
        id = self.publish_now(body, earliest_sent)
        with self._may_have_arrived():
            if new:
                await self._wait_for_matching()
            self._port.check(self._id, id)

    def advertise(self, type_name: str) -> bool:
        """Advertise the topic; whether it was not advertised before."""
        if self._client in self._client.channel.publications.advertisers(self._topic):
            return False
        self._port.perform(rosbridge.Advertise(id=self._id, topic=self._topic, type=type_name))
        return True

    async def publish_command(
        self, body: msgspec.Raw, type_name: str, earliest_sent: int, seconds: float
    ) -> None:
        """Publish a message that moves the robot at once, and wait until it is sent.

        :param seconds: how long it may wait to be sent
        :raises MaybeDone: it was published, and may or may not have arrived
        :raises SwitchboardError: another client has control, or it can't be sent for another reason
        """
        self.advertise(type_name)
        id = self.publish_now(body, earliest_sent)
        client = self._client
        if client.controller.lease.pending_for(client):
            await client.controller.wait_for_control(client)
        with self._may_have_arrived():
            await self._wait_until(self._is_advertised, seconds)
            self._port.check(self._id, id)
            if not self._is_advertised():
                raise Unavailable(f"robot {client.robot.name} does not publish {self._topic} in time")

    def take_warning(self) -> str:
        """The warning that earlier messages to the topic were dropped, once; empty: none was."""
        return self._port.take_warning(self._id)

    def publish_now(self, body: msgspec.Raw, earliest_sent: int | None = None) -> str:
        """Publish a message at once; returns the id to :meth:`InProcessPort.check` later whether it failed."""
        id = self._port.new_id()
        self._port.perform(rosbridge.Publish(id=id, topic=self._topic, msg=body), earliest_sent)
        return id

    @contextmanager
    def _may_have_arrived(self) -> Iterator[None]:
        """Errors after a message was published: unless it was refused, it may have reached the robot.

        :raises MaybeDone: it is not known whether it has arrived
        """
        try:
            yield
        except Unavailable as error:
            raise MaybeDone(error) from None
        except CancelledError:
            raise MaybeDone(Unavailable("this took too long")) from None
        except Refused as error:
            raise MaybeDone(error) if error is self._port.closed else error from None

    def _is_advertised(self) -> bool:
        return any(each == self._topic for each, _ in self._client.channel.publications.active())

    def _has_subscriber(self) -> bool:
        known = self._client.robot.graph.topics.get(self._topic)
        return known is not None and bool(known.subscribers)

    async def _wait_for_matching(self) -> None:
        """Wait until ROS 2 has matched a new publisher, or has sent its message."""
        if "cdr" in self._client.robot.encodings:
            await sleep(self._clock, MATCHING_SECONDS)
        self._port.check(self._id)

    async def _wait_until(self, true: Callable[[], bool], seconds: float | None = None) -> None:
        """Wait until a condition holds, or for so long."""
        clock, robot = self._clock, self._client.robot
        until = None if seconds is None else clock.seconds() + seconds
        while not true() and (until is None or clock.seconds() < until):
            await sleep(clock, LOOK_SECONDS)
            self._port.check(self._id)
            if robot.control_link is None:
                raise Unavailable(f"robot {robot.name} went offline")
