"""What a client publishes to the robot: judged by right and, where it moves the robot, by age."""

from __future__ import annotations

from typing import TYPE_CHECKING

from relay_protocol import link, rosbridge
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_protocol.rights import Operation, Rules
from relay_server.channel import resolve
from relay_server.channel.publications import HELD_SECONDS
from relay_server.channel.topics import Publication
from relay_server.freshness import Freshness
from relay_server.session.names import normal_type

if TYPE_CHECKING:
    from relay_server.session.core import Session

NO_DEADLINE = round(HELD_SECONDS * 1e9)
"""Nanoseconds a message that is no command may wait to be sent."""

ROUTES = 256
"""Topics of which one client's routes are kept."""


class Route:
    """What was found out about a topic this client may publish to, and on what that was founded.

    :param type: as the client wrote it in ``publish``
    :param motion: whether the robot's own safety counts the topic as motion; then commands have a deadline
    """

    __slots__ = ("deadline", "description", "holders", "publication", "rules", "type")

    def __init__(
        self, type: str, rules: Rules, description: link.Describe, publication: Publication, motion: bool
    ) -> None:
        self.type = type
        self.rules = rules
        self.description = description
        self.publication = publication
        self.holders = publication.holders
        self.deadline = description.motion.deadline_ms * 1_000_000 if motion else None
        """Nanoseconds; the greatest age a command may have."""


class Publishing:
    """The messages of one session on their way to the robot."""

    __slots__ = ("_freshness", "_permit", "_robot", "_routes", "_session", "stale_commands")

    def __init__(self, session: Session, freshness: Freshness) -> None:
        self._session = session
        self._permit = session.permit
        self._robot = session.robot
        self._freshness = freshness
        self._routes: dict[str, Route] = {}
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
        """One message to the robot.

        The route found before holds while all it was founded on is the same: rights are compiled anew when they
        change, and a robot's words about itself are replaced as a whole. So nothing has to be told of a change.

        :raises Refused: the client may not publish there
        :raises Unavailable: the robot is offline
        :raises Invalid: no such topic, or of another type
        """
        session, robot = self._session, self._robot
        route = self._routes.get(ask.topic)
        if (
            route is None
            or route.rules is not self._permit.rules
            or route.description is not robot.description
            or session not in route.holders
            or ask.type != route.type
            or robot.control is None
        ):
            route = self._find(ask)
        freshness, deadline, left = self._freshness, route.deadline, NO_DEADLINE
        if deadline is not None:
            # Each message by a reading of the clock of its own: an earlier one, of the chunk it came in, would make it
            # too young.
            left = deadline - freshness.age()
            if left < 0:
                self._stale(route, deadline - left, ask.id)
                return
        publication = route.publication
        send, body, stamp = publication.send, bytes(ask.msg), freshness.not_before
        if send is None:
            session.channel.publications.publish(session, publication, body, stamp, ask.id, left / 1e9)
            return
        try:
            send(body, stamp)
        except SwitchboardError as error:
            session.tell("error", f"publish {publication.topic}: {error}", ask.id)

    def _find(self, ask: rosbridge.Publish) -> Route:
        self._routes.pop(ask.topic, None)
        session = self._session
        robot, rules = session.robot, session.permit.rules
        topic = resolve(ask.topic)
        session.judge(Operation.PUBLISH, topic)
        if robot.control is None:
            raise Unavailable(f"robot {robot.name} is offline; the message was dropped")
        publication = session.channel.publications.get(session, ask, topic, normal_type(ask.type))
        motion = robot.is_motion(topic, publication.type)
        if len(self._routes) >= ROUTES:
            self._routes.clear()
        route = self._routes[ask.topic] = Route(ask.type, rules, robot.description, publication, motion)
        return route

    def _stale(self, route: Route, age: int, id: rosbridge.Id) -> None:
        self.stale_commands += 1
        deadline_ms = route.description.motion.deadline_ms
        self._session.tell(
            "warning",
            f"a command to {route.publication.topic} was dropped: it may be {age / 1e6:.0f} ms old, by the last ping "
            f"answered; the robot takes none older than {deadline_ms} ms",
            id,
        )
