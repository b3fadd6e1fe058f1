"""What a client publishes to the robot: judged by right and, where it moves the robot, by age."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from relay_protocol import link, rosbridge
from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from relay_protocol.limits import KIB
from relay_protocol.rights import Operation, Rules
from relay_server.channels.publications import HELD_SECONDS
from relay_server.channels.robot_link import resolve
from relay_server.channels.topics import ClientPublication
from relay_server.control.types import LET_GO_SECONDS, ControlSnapshot
from relay_server.sessions.message_age import MessageAge
from relay_server.sessions.rearm import ReleaseTracker, is_zero_command
from relay_server.sessions.type_names import normal_type

if TYPE_CHECKING:
    from relay_server.sessions.session import Session

NO_DEADLINE = round(HELD_SECONDS * 1e9)
"""Nanoseconds a message that is no command may wait to be sent."""

ROUTES = 256
"""Topics of which one client's routes are kept."""

DROVE_NS = 250_000_000
"""Nanoseconds after a command that moves in which no other is looked at for whether it does: that takes time."""

LATEST_BYTES = 4 * KIB
LONG = b"long"
"""A command with more bytes than that is not kept, and counts as one that moves."""

WAITING_TOPICS = 16
WAITING_BYTES = 64 * KIB
"""Commands of one client that wait for control: the newest to each of so many topics, none larger than this."""


class Route:
    """What was found out about a topic this client may publish to, and on what that was founded.

    :param type: as the client wrote it in ``publish``
    :param motion: whether the robot's own safety counts the topic as motion; then commands have a deadline
    :param standing: who commands the robot
    :param passes: whether this client does, there
    """

    __slots__ = (
        "deadline",
        "description",
        "holders",
        "latest",
        "passes",
        "publication",
        "rules",
        "standing",
        "type",
    )

    def __init__(
        self,
        type: str,
        rules: Rules,
        description: link.Describe,
        publication: ClientPublication,
        motion: bool,
        standing: ControlSnapshot,
        passes: bool,
    ) -> None:
        self.type = type
        self.rules = rules
        self.description = description
        self.publication = publication
        self.holders = publication.holders
        self.standing = standing
        self.passes = passes
        self.deadline = description.motion.deadline_ms * 1_000_000 if motion else None
        """Nanoseconds; the greatest age a command may have."""
        self.latest: bytes | None = None
        """The latest command that passed, :data:`LONG` for a long one."""


class _WaitingCommand(NamedTuple):
    """A command that waits for control of the robot.

    :param stamp: the relay's monotonic nanoseconds before which it can't have been sent
    """

    ask: rosbridge.Publish
    stamp: int


class PublishHandler:
    """The messages of one session on their way to the robot."""

    __slots__ = (
        "_begun",
        "_desk",
        "_freshness",
        "_grips",
        "_held",
        "_number",
        "_permit",
        "_robot",
        "_routes",
        "_session",
        "_waiting",
        "commanded",
        "drove",
        "stale_commands",
    )

    def __init__(self, session: Session, freshness: MessageAge) -> None:
        self._session = session
        self._permit = session.permit
        self._robot = session.robot
        self._desk = session.desk
        self._number = session.number
        self._freshness = freshness
        self._routes: dict[str, Route] = {}
        self._begun: set[str] = set()
        """Topics of which the first message was noted."""
        self._waiting: dict[str, _WaitingCommand] = {}
        """The newest command to each topic, while the robot is being told that it comes from here."""
        self._grips = ReleaseTracker()
        self._held: object = None
        """The latest tenure of control in which this client has moved the robot."""
        self.stale_commands = 0
        self.commanded = 0
        """The relay's monotonic nanoseconds before which the latest command can't have been sent."""
        self.drove = 0
        """The same for the latest one that passed and was no zero, give or take :data:`DROVE_NS`."""

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
        change, a robot's words about itself and who commands it are replaced as a whole. So nothing has to be told of a
        change.

        :raises Refused: the client may not publish there, or somebody else commands the robot
        :raises Unavailable: the robot is offline
        :raises Invalid: no such topic, or of another type
        """
        session, robot = self._session, self._robot
        route = self._routes.get(ask.topic)
        if (
            route is None
            or route.rules is not self._permit.rules
            or route.description is not robot.description
            or route.standing is not self._desk.standing
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
                if not route.passes:
                    # Of a zero that is so old nobody knows what the hand has done since.
                    self._in_vain(route, still=False)
                self._stale(route, deadline - left, ask.id)
                return
            self.commanded = freshness.not_before
            if not route.passes and not self._let_by(route, ask):
                return
            if freshness.not_before - self.drove > DROVE_NS:
                self._drives(route, ask)
        publication = route.publication
        send, body, stamp = publication.send, bytes(ask.msg), freshness.not_before
        if deadline is not None:
            route.latest = body if len(body) <= LATEST_BYTES else LONG
        if send is None:
            session.channel.publications.publish(session, publication, body, stamp, ask.id, left / 1e9)
            return
        try:
            send(body, stamp, self._number)
        except SwitchboardError as error:
            session.tell("error", f"publish {publication.topic}: {error}", ask.id)

    def _find(self, ask: rosbridge.Publish) -> Route:
        self._routes.pop(ask.topic, None)
        session = self._session
        robot, rules = session.robot, session.permit.rules
        topic = resolve(ask.topic)
        session.judge(Operation.PUBLISH, topic)
        if robot.control is None:
            self._desk.unheard(session)
            self._grips.in_vain(topic, self._now())
            raise Unavailable(f"robot {robot.name} is offline; the message was dropped")
        publication = session.channel.publications.get(session, ask, topic, normal_type(ask.type))
        motion = robot.is_motion(topic, publication.type)
        if len(self._routes) >= ROUTES:
            self._routes.clear()
        desk = self._desk
        route = self._routes[ask.topic] = Route(
            ask.type,
            rules,
            robot.description,
            publication,
            motion,
            desk.standing,
            not motion or (desk.passes(session, topic) and not self._must_let_go(topic)),
        )
        if not motion and topic not in self._begun and len(self._begun) < ROUTES:
            # Commands are noted when they move the robot.
            self._begun.add(topic)
            session.notice("publication.begun", topic=topic)
        return route

    def _must_let_go(self, topic: str) -> bool:
        """Whether the client went on commanding in vain until it got control (SPEC section 1.7)."""
        desk, session = self._desk, self._session
        if session.number in desk.standing.suppressed.get(topic, ()):
            return False
        # By when it can have been sent at the earliest: a link that stalls is no silence of the client.
        return desk.lease.held_by(session) and self._grips.holds(topic, self._freshness.not_before)

    def _let_by(self, route: Route, ask: rosbridge.Publish) -> bool:
        """Whether a command goes to the robot though its route does not pass; else it waits.

        :raises Refused: as :meth:`_claim`, or the client must let go first
        """
        topic = route.publication.topic
        if not self._desk.passes(self._session, topic):
            still = _is_still(route, ask)
            if still and self._is_mere_zero(route):
                # The robot judges it, as it does all commands.
                self._grips.let_go(topic)
                self._desk.zero(self._session)
                return True
            self._claim(route, ask, still)
            return False
        if self._must_let_go(topic):
            self._in_vain(route, _is_still(route, ask))
        if self._must_let_go(topic):
            raise Refused(
                f"let go first: you went on commanding {topic} without control of robot {self._robot.name}; "
                f"say zero, or nothing for {LET_GO_SECONDS:g} s"
            )
        route.passes = True
        return True

    def _is_mere_zero(self, route: Route) -> bool:
        """Whether a zero has nothing to stop: it takes no control.

        One that comes while control is being taken does: by it the one that waits is taken back. Where the robot counts
        a topic as motion by its name, all zeros may be a goal.
        """
        commands = route.publication.type in self._robot.description.motion.types
        return commands and not self._desk.lease.coming_to(self._session)

    def _drives(self, route: Route, ask: rosbridge.Publish) -> None:
        """A command has passed: one that moves keeps control from idling, while the robot is not stopped."""
        if route.standing.stopped is None and not _is_still(route, ask):
            self.drove = self._freshness.not_before
            holder = self._desk.lease.holder
            if holder is not self._held and self._desk.lease.held_by(self._session):
                self._held = holder
                self._session.notice("motion.begun", topic=route.publication.topic)

    def _in_vain(self, route: Route, still: bool) -> None:
        """A command was refused, held back or too old.

        :param still: whether it said zero
        """
        topic, now = route.publication.topic, self._now()
        if still:
            self._grips.let_go(topic)
        elif self._desk.in_vain(self._session) or self._grips.holds(topic, self._freshness.not_before):
            self._grips.in_vain(topic, now)

    def _now(self) -> int:
        """The relay's monotonic nanoseconds."""
        return self._freshness.not_before + self._freshness.age()

    def _claim(self, route: Route, ask: rosbridge.Publish, still: bool) -> None:
        """A command of who does not command the robot: it waits if the robot is being told that it now does.

        :param still: whether it says zero
        :raises Refused: somebody else commands the robot, or control must be taken first
        """
        topic = route.publication.topic
        if len(bytes(ask.msg)) > WAITING_BYTES or (
            topic not in self._waiting and len(self._waiting) >= WAITING_TOPICS
        ):
            self._ask_for_control(route, still)
            raise Refused(f"control is just being taken; a command to {topic} can't wait for it")
        # Before it is asked for, since the answer may be there at once.
        self._waiting[topic] = _WaitingCommand(ask, self._freshness.not_before)
        try:
            self._ask_for_control(route, still)
        except SwitchboardError:
            self._waiting.pop(topic, None)
            raise

    def _ask_for_control(self, route: Route, still: bool) -> None:
        grips = self._grips
        if not self._desk.lease.coming_to(self._session):
            # A command that takes a free robot moves it: programs that know nothing of control begin so.
            self._grips = ReleaseTracker()
        try:
            self._desk.claim(self._session)
        except SwitchboardError:
            self._grips = grips
            self._in_vain(route, still)
            raise

    def commands(self) -> None:
        """The client moves the robot by something else than a message."""
        self.commanded = self.drove = self._freshness.not_before

    def judge_age(self, what: str, stamp: int) -> None:
        """See that something else than a message that moves the robot is not too old by now; what is, is counted.

        :param stamp: the relay's monotonic nanoseconds before which it can't have been sent
        :raises Refused: it may be too old
        """
        with self._freshness.as_of(stamp):
            age = self._freshness.age()
        deadline_ms = self._robot.description.motion.deadline_ms
        if age > deadline_ms * 1_000_000:
            self.stale_commands += 1
            raise Refused(_too_old(f"{what} was refused", age, deadline_ms))

    def control_changed(self) -> None:
        """Who commands the robot is another: what waited for that goes, or is dropped."""
        lease, session = self._desk.lease, self._session
        if not self._waiting or lease.coming_to(session):
            return
        waiting, self._waiting = self._waiting, {}
        if not lease.held_by(session):
            # Why not, the desk has told.
            return
        for each in waiting.values():
            with self._freshness.as_of(each.stamp):
                self._again(each)

    def _again(self, waiting: _WaitingCommand) -> None:
        """A command that waited is judged once more, as old as it is."""
        try:
            self.publish(waiting.ask)
        except SwitchboardError as error:
            self._session.refuse(waiting.ask, error)

    @property
    def silent_ns(self) -> int:
        """Nanoseconds since the latest command."""
        return self._now() - self.commanded

    @property
    def idle_ns(self) -> int:
        """Nanoseconds since the latest command that moves."""
        return self._now() - self.drove

    @property
    def holds_on(self) -> bool:
        """Whether the latest command on any topic that passed was no zero."""
        routes = self._routes.values()
        return any(
            each.latest is not None and not is_zero_command(each.publication.type, each.latest)
            for each in routes
        )

    def _stale(self, route: Route, age: int, id: rosbridge.Id) -> None:
        self.stale_commands += 1
        deadline_ms = route.description.motion.deadline_ms
        words = _too_old(f"a command to {route.publication.topic} was dropped", age, deadline_ms)
        self._session.tell("warning", words, id)


def _is_still(route: Route, ask: rosbridge.Publish) -> bool:
    return is_zero_command(route.publication.type, bytes(ask.msg))


def _too_old(what: str, age: int, deadline_ms: int) -> str:
    return (
        f"{what}: it may be {age / 1e6:.0f} ms old, by the last ping answered; "
        f"the robot takes none older than {deadline_ms} ms"
    )
