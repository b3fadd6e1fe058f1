"""What a client publishes to the robot: judged by right and, where it moves the robot, by age."""

from __future__ import annotations

from typing import TYPE_CHECKING

from relay_protocol import rosbridge
from relay_protocol.errors import Unavailable
from relay_protocol.rights import Operation
from relay_server.channel import resolve
from relay_server.channel.publications import HELD_SECONDS
from relay_server.freshness import Freshness
from relay_server.session.names import normal_type

if TYPE_CHECKING:
    from relay_server.session.core import Session


class Publishing:
    """The messages of one session on their way to the robot."""

    def __init__(self, session: Session, freshness: Freshness) -> None:
        self._session = session
        self._freshness = freshness
        self.stale_commands = 0

    def advertise(self, ask: rosbridge.Advertise) -> None:
        """The client is going to publish."""
        session = self._session
        session.judge(Operation.PUBLISH, resolve(ask.topic))
        session.channel.publications.advertise(session, ask, normal_type(ask.type))

    def unadvertise(self, ask: rosbridge.Unadvertise) -> None:
        """The client takes an advertisement back."""
        session = self._session
        session.channel.publications.unadvertise(session, resolve(ask.topic), ask.id)

    def publish(self, ask: rosbridge.Publish) -> None:
        """One message to the robot."""
        session = self._session
        topic = resolve(ask.topic)
        session.judge(Operation.PUBLISH, topic)
        robot = session.robot
        if robot.control is None:
            raise Unavailable(f"robot {robot.name} is offline; the message was dropped")
        publication = session.channel.publications.get(session, topic, normal_type(ask.type))
        good_for = HELD_SECONDS
        if robot.is_motion(topic, publication.type):
            age_ms = self._freshness.age() / 1e6
            deadline_ms = robot.description.motion.deadline_ms
            if age_ms > deadline_ms:
                self.stale_commands += 1
                session.tell(
                    "warning",
                    f"a command to {topic} was dropped: it may be {age_ms:.0f} ms old, by the last ping "
                    f"answered; the robot takes none older than {deadline_ms} ms",
                    ask.id,
                )
                return
            good_for = (deadline_ms - age_ms) / 1000

        def failed(reason: str) -> None:
            session.tell("error", reason, ask.id)

        stamp = self._freshness.not_before
        session.channel.publications.publish(session, publication, bytes(ask.msg), stamp, failed, good_for)
