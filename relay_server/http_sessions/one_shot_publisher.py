"""One message to a topic, by a client inside the relay: sent when the robot can publish and somebody there listens."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import msgspec
from twisted.internet.defer import CancelledError

from relay_protocol import rosbridge
from relay_protocol.errors import Invalid, NotFound, Refused, Unavailable
from relay_server.common.clock import Clock, sleep
from relay_server.http_sessions.loopback_client import LoopbackClient, MaybeDone
from relay_server.sessions.session import Session
from relay_server.sessions.type_names import normal_type

LOOK_SECONDS = 0.02
"""How often it is looked whether the robot is ready for a message."""

SUBSCRIBER_SECONDS = 2.0
"""So long somebody who subscribes is waited for."""

MATCHING_SECONDS = 0.5
"""What ROS 2 has to bring a new publisher and its subscribers together, and to send what was published."""


def type_of(session: Session, topic: str, said: str) -> str:
    """The type of a topic, as its client says or it is known.

    :param said: as the client wrote it; empty where he leaves it open
    :raises NotFound: nobody knows it
    :raises Invalid: it has another
    :raises Unavailable: the robot is offline
    """
    if session.robot.control is None:
        raise Unavailable(f"robot {session.robot.name} is offline")
    named, known = normal_type(said), session.channel.publications.known_type(topic)
    if named and known and named != known:
        raise Invalid(f"topic {topic} has the type {known}, not {named}")
    if not named and not known:
        raise NotFound(f"there is no topic {topic} on {session.robot.name}; say its type")
    return named or known


def may_move(session: Session, topic: str, type_name: str) -> bool:
    """Whether a message of this type there may move the robot, by any of the types the topic has."""
    known = session.robot.graph.topics.get(topic)
    types = {type_name, *(known.types if known is not None else ())}
    return any(session.robot.is_motion(topic, each) for each in types)


class OneShotPublisher:
    """A topic that a client inside the relay publishes to.

    :param topic: resolved
    """

    def __init__(self, clock: Clock, client: LoopbackClient, session: Session, topic: str) -> None:
        self._clock = clock
        self._client = client
        self._session = session
        self._topic = topic
        self._id = f"advertise {topic}"

    async def say(self, body: msgspec.Raw, type_name: str, since: int | None = None) -> None:
        """Publish a message once somebody can hear it, as far as anybody listens.

        :param body: JSON
        :param since: as for :meth:`LoopbackClient.do`
        :raises MaybeDone: it was published, and may have arrived or not
        :raises SwitchboardError: it can't be published, with the reason
        """
        new = self.advertise(type_name)
        if new or not self._active():
            await self._until(self._active)
            await self._until(self._subscribed, SUBSCRIBER_SECONDS)
            await self._matching()
        id = self.say_now(body, since)
        with self._on_its_way():
            if new:
                await self._matching()
            self._client.check(self._id, id)

    def advertise(self, type_name: str) -> bool:
        """Begin to publish; whether that is new."""
        if self._session in self._session.channel.publications.holders(self._topic):
            return False
        self._client.do(rosbridge.Advertise(id=self._id, topic=self._topic, type=type_name))
        return True

    async def command(self, body: msgspec.Raw, type_name: str, since: int, seconds: float) -> None:
        """Publish what moves the robot at once, whoever hears it, and wait until it is on its way.

        :param seconds: it is worth as long
        :raises MaybeDone: it was published, and may have arrived or not
        :raises SwitchboardError: somebody else has control, or whatever else keeps it from the robot
        """
        self.advertise(type_name)
        id = self.say_now(body, since)
        session = self._session
        if session.desk.lease.coming_to(session):
            await session.desk.claimed(session)
        with self._on_its_way():
            await self._until(self._active, seconds)
            self._client.check(self._id, id)
            if not self._active():
                raise Unavailable(f"robot {session.robot.name} does not publish {self._topic} in time")

    def say_now(self, body: msgspec.Raw, since: int | None = None) -> str:
        """Publish a message, whoever hears it; the id by which it may be told later that it failed."""
        id = self._client.new_id()
        self._client.do(rosbridge.Publish(id=id, topic=self._topic, msg=body), since)
        return id

    @contextmanager
    def _on_its_way(self) -> Iterator[None]:
        """What goes wrong after a message was published does not keep it from the robot, unless it is refused.

        :raises MaybeDone: it is not known whether it has arrived
        """
        try:
            yield
        except Unavailable as error:
            raise MaybeDone(error) from None
        except CancelledError:
            raise MaybeDone(Unavailable("this took too long")) from None
        except Refused as error:
            raise MaybeDone(error) if error is self._client.closed else error from None

    def _active(self) -> bool:
        return any(each == self._topic for each, _ in self._session.channel.publications.active())

    def _subscribed(self) -> bool:
        known = self._session.robot.graph.topics.get(self._topic)
        return known is not None and bool(known.subscribers)

    async def _matching(self) -> None:
        """Wait for what ROS 2 does before and after a message of a new publisher."""
        if "cdr" in self._session.robot.encodings:
            await sleep(self._clock, MATCHING_SECONDS)
        self._client.check(self._id)

    async def _until(self, true: Callable[[], bool], seconds: float | None = None) -> None:
        """Wait until something holds, or for so long."""
        clock, robot = self._clock, self._session.robot
        until = None if seconds is None else clock.seconds() + seconds
        while not true() and (until is None or clock.seconds() < until):
            await sleep(clock, LOOK_SECONDS)
            self._client.check(self._id)
            if robot.control is None:
                raise Unavailable(f"robot {robot.name} went offline")
