"""Messages that a client publishes to the robot: checked by rights and, if they move it, by control and age."""

from __future__ import annotations

from typing import NamedTuple

from relay_protocol import link, nonfinite, rosbridge
from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from relay_protocol.limits import KIB
from relay_protocol.release_rule import RELEASE_NS, CommandStreams
from relay_protocol.rights import Operation, Rules
from relay_server.channels.names import normal_type, resolve
from relay_server.channels.publications import QUEUED_SECONDS, RobotPublication
from relay_server.control.types import ControlSnapshot
from relay_server.sessions.context import ClientContext
from relay_server.sessions.motion_requests import too_old
from relay_server.sessions.zero_command import is_zero_command

QUEUED_NS = round(QUEUED_SECONDS * 1e9)
"""Nanoseconds that a message other than a command may wait to be sent."""

TOPICS = 64
"""Most topics of one client of which refused commands are remembered; the least recent is forgotten first."""

DECISIONS = 256
"""Most decisions cached for one client."""

MOTION_NS = 250_000_000
"""Nanoseconds after a moving command during which no command is parsed for motion, as parsing takes time."""

LATEST_BYTES = 4 * KIB
"""Longest command, in bytes, that is kept as a decision's latest."""
LONG = b"long"
"""Kept in place of a longer command, which counts as one that moves."""

WAITING_TOPICS = 16
WAITING_BYTES = 64 * KIB
"""Limits of the commands of one client that wait for control: the newest of each topic, none larger than this."""


class PublishDecision:
    """The cached decision that this client may publish to a topic, with the objects it was derived from.

    :param type: as the client wrote it in ``publish``
    :param motion: whether the robot counts the topic as motion; its commands then have a maximum age
    :param control: snapshot of who controls the robot
    :param passes: whether commands of this client pass
    """

    __slots__ = (
        "advertisers",
        "control",
        "description",
        "latest",
        "max_age_ns",
        "passes",
        "publication",
        "rules",
        "type",
    )

    def __init__(
        self,
        type: str,
        rules: Rules,
        description: link.Describe,
        publication: RobotPublication,
        motion: bool,
        control: ControlSnapshot,
        passes: bool,
    ) -> None:
        self.type = type
        self.rules = rules
        self.description = description
        self.publication = publication
        self.advertisers = publication.advertisers
        self.control = control
        self.passes = passes
        self.max_age_ns = description.motion.deadline_ms * 1_000_000 if motion else None
        """Greatest age of a command, nanoseconds; ``None``: messages of this topic do not move the robot."""
        self.latest: bytes | None = None
        """JSON of the latest command that passed; :data:`LONG` for a long one."""


class _WaitingCommand(NamedTuple):
    """A command that waits for control of the robot.

    :param earliest_sent: see :class:`relay_server.sessions.message_age.MessageAge`
    """

    operation: rosbridge.Publish
    earliest_sent: int


class PublishHandler:
    """Publishes the messages of one session."""

    __slots__ = (
        "_age",
        "_client",
        "_controller",
        "_decisions",
        "_motion",
        "_noted",
        "_noted_holder",
        "_number",
        "_permit",
        "_robot",
        "_streams",
        "_waiting",
    )

    def __init__(self, client: ClientContext) -> None:
        self._client = client
        self._permit = client.permit
        self._robot = client.robot
        self._controller = client.controller
        self._number = client.number
        self._age = client.age
        self._motion = client.motion
        self._decisions: dict[str, PublishDecision] = {}
        client.motion.topics = self._decisions
        self._noted: dict[str, None] = {}
        """Topics of which ``publication.begun`` was published as an activity."""
        self._waiting: dict[str, _WaitingCommand] = {}
        """The newest command of each topic, while the robot is being notified that this client controls it."""
        self._streams: CommandStreams[str] = CommandStreams(TOPICS)
        self._noted_holder: object = None
        """The latest holder of control for which ``motion.begun`` was published as an activity."""

    def advertise(self, operation: rosbridge.Advertise) -> None:
        """Advertise a topic."""
        client = self._client
        client.require(Operation.PUBLISH, resolve(operation.topic))
        client.channel.publications.advertise(client, operation, normal_type(operation.type))

    def unadvertise(self, operation: rosbridge.Unadvertise) -> None:
        """Withdraw an advertisement."""
        client = self._client
        client.channel.publications.unadvertise(client, resolve(operation.topic), operation.id)

    def publish(self, operation: rosbridge.Publish) -> None:
        """Publish one message to the robot.

        A port checks the quota of processor time only for long messages. Short ones are bounded by the share of a
        reactor turn that a connection has (:data:`relay_server.ws.fast_receive.SHARE_SECONDS`) and by the send queue.

        A decision is valid while it was derived from the current objects: rules, description and control snapshot are
        replaced as a whole when they change. So decisions need no notification of changes.

        :raises Refused: the client has no right to publish to the topic, or another client controls the robot
        :raises Unavailable: the robot is offline
        :raises Invalid: there is no such topic, or it has another type
        """
        client, decision = self._client, self._decision(operation)
        age, max_age_ns, left = self._age, decision.max_age_ns, QUEUED_NS
        if max_age_ns is not None:
            # The clock is read for each message: the arrival time of its chunk would make it too young.
            left = max_age_ns - age.now() + age.earliest_sent
            if left < 0:
                if not decision.passes:
                    # Even a zero releases nothing then: the client may have sent other commands after it.
                    self._record_refused(decision, zero=False)
                self._drop_stale(decision, max_age_ns - left, operation.id)
                return
            self._motion.last_command = age.earliest_sent
            if not decision.passes and not self._pass_or_acquire_control(decision, operation):
                return
            if age.earliest_sent - self._motion.last_motion > MOTION_NS:
                self._note_motion(decision, operation)
        publication = decision.publication
        send, body, earliest_sent = publication.send, bytes(operation.msg), age.earliest_sent
        if max_age_ns is not None:
            decision.latest = body if len(body) <= LATEST_BYTES else LONG
        if send is None:
            client.channel.publications.publish(
                client, publication, body, earliest_sent, operation.id, left / 1e9
            )
            return
        try:
            send(earliest_sent, self._number, body)
        except SwitchboardError as error:
            client.notify("error", f"publish {publication.topic}: {error}", operation.id)

    def publish_encoded(self, operation: rosbridge.Publish, cdr: bytes) -> bool:
        """Publish a message that is CDR of the topic's type already; it is not decoded, and never waits.

        :param operation: of which ``msg`` is not used
        :returns: whether it was sent; false: the robot has no publisher yet, or speaks JSON
        :raises Refused: as for :meth:`publish`; or messages of this topic move the robot, so they must be judged
        :raises SwitchboardError: as for :meth:`publish`
        """
        decision = self._decision(operation)
        publication = decision.publication
        # The relay's description of the robot says that it moves it, or the robot's answer to ``advertise`` did.
        if decision.max_age_ns is not None or publication.motion:
            raise Refused(f"messages to {publication.topic} move the robot; send them as JSON")
        send = publication.send_encoded or self._client.channel.publications.encoded_sender(publication)
        if send is None:
            return False
        send(self._age.earliest_sent, self._number, cdr)
        return True

    def _decision(self, operation: rosbridge.Publish) -> PublishDecision:
        """The decision for a topic, the cached one if it is valid; errors as for :meth:`publish`."""
        decision = self._decisions.get(operation.topic)
        if (
            decision is None
            or decision.rules is not self._permit.rules
            or decision.description is not self._robot.description
            or decision.control is not self._controller.snapshot
            or self._client not in decision.advertisers
            or operation.type != decision.type
            or self._robot.control_link is None
        ):
            decision = self._decide(operation)
        return decision

    def _decide(self, operation: rosbridge.Publish) -> PublishDecision:
        self._decisions.pop(operation.topic, None)
        client = self._client
        robot, rules = client.robot, client.permit.rules
        topic = resolve(operation.topic)
        client.require(Operation.PUBLISH, topic)
        if robot.control_link is None:
            self._controller.published_while_offline(client)
            self._streams.refused(topic, self._now())
            raise Unavailable(f"robot {robot.name} is offline; the message was dropped")
        publication = client.channel.publications.find_or_advertise(
            client, operation, topic, normal_type(operation.type)
        )
        motion = robot.is_motion(topic, publication.type)
        if len(self._decisions) >= DECISIONS:
            self._decisions.clear()
        controller = self._controller
        decision = self._decisions[operation.topic] = PublishDecision(
            operation.type,
            rules,
            robot.description,
            publication,
            motion,
            controller.snapshot,
            not motion or (controller.may_command(client, topic) and not self._must_release(topic)),
        )
        if not motion and topic not in self._noted and len(self._noted) < DECISIONS:
            # Commands are an activity when they move the robot, see :meth:`_note_motion`.
            self._noted[topic] = None
            client.activity("publication.begun", topic=topic)
        return decision

    def _must_release(self, topic: str) -> bool:
        """Whether the client commanded without control, and has not released since (SPEC 1.7)."""
        controller, client = self._controller, self._client
        if client.number in controller.snapshot.suppressing.get(topic, ()):
            return False
        # Judged by the earliest time at which it can have been sent: a stalled link is not a release.
        return controller.lease.held_by(client) and self._streams.must_release(topic, self._age.earliest_sent)

    def _pass_or_acquire_control(self, decision: PublishDecision, operation: rosbridge.Publish) -> bool:
        """Check a command that the decision does not let pass. Control is acquired for it if the robot is free.

        :returns: whether it passes now; otherwise it waits until this client has control

        :raises Refused: as :meth:`_queue_and_request_control`, or the client must release the controls first
        :raises SwitchboardError: as :meth:`_check_finite`
        """
        topic = decision.publication.topic
        if not self._controller.may_command(self._client, topic):
            is_zero = _is_zero(decision, operation)
            if is_zero and self._only_stops(decision):
                # The robot checks it, as it does all commands.
                self._streams.zero(topic)
                self._controller.check_zero_command(self._client)
                return True
            self._check_finite(decision, operation)
            self._queue_and_request_control(decision, operation, is_zero)
            return False
        if self._must_release(topic):
            self._record_refused(decision, _is_zero(decision, operation))
        # If it is zero, recording it has released the controls.
        if self._must_release(topic):
            raise Refused(
                f"release the controls first: you went on commanding {topic} without control of robot "
                f"{self._robot.name}; send zero, or nothing for {RELEASE_NS / 1e9:g} s"
            )
        decision.passes = True
        return True

    def _check_finite(self, decision: PublishDecision, operation: rosbridge.Publish) -> None:
        """Check a command before it acquires control. Those of the holder are checked when they are converted.

        :raises SwitchboardError: a number in it is not finite, or it takes too long to find out
        """
        try:
            nonfinite.require_finite(bytes(operation.msg))
        except SwitchboardError as error:
            self._record_refused(decision, zero=False)
            raise type(error)(f"publish {decision.publication.topic}: {error}") from None

    def _only_stops(self, decision: PublishDecision) -> bool:
        """Whether a zero passes without acquiring control, because it only stops the robot.

        A zero that arrives while control is being acquired replaces the command that waits. On a topic that counts as
        motion by its name, a zero may be a goal, such as a pose on ``goal_pose``, so it acquires control.
        """
        commands = decision.publication.type in self._robot.description.motion.types
        return commands and not self._controller.lease.pending_for(self._client)

    def _note_motion(self, decision: PublishDecision, operation: rosbridge.Publish) -> None:
        """Record a command that has passed; if it moves the robot, control is not idle."""
        if decision.control.stopped is None and not _is_zero(decision, operation):
            self._motion.last_motion = self._age.earliest_sent
            holder = self._controller.lease.holder
            if holder is not self._noted_holder and self._controller.lease.held_by(self._client):
                self._noted_holder = holder
                self._client.activity("motion.begun", topic=decision.publication.topic)

    def _record_refused(self, decision: PublishDecision, zero: bool) -> None:
        """Record a command that was refused, queued or too old; the client may have to release the controls later.

        :param zero: whether it was zero
        """
        topic, now = decision.publication.topic, self._now()
        if zero:
            self._streams.zero(topic)
        elif self._controller.commands_without_control(self._client) or self._streams.must_release(
            topic, self._age.earliest_sent
        ):
            self._streams.refused(topic, now)

    def _now(self) -> int:
        """The relay's monotonic nanoseconds."""
        return self._age.now()

    def _queue_and_request_control(
        self, decision: PublishDecision, operation: rosbridge.Publish, zero: bool
    ) -> None:
        """Queue a command until this client has control, and request control for it.

        :param zero: whether it is zero
        :raises Refused: another client controls the robot, or control must be taken first
        """
        topic = decision.publication.topic
        if len(bytes(operation.msg)) > WAITING_BYTES or (
            topic not in self._waiting and len(self._waiting) >= WAITING_TOPICS
        ):
            self._request_control(decision, zero)
            raise Refused(
                f"control is being acquired; a command to {topic} can't wait for it and was dropped"
            )
        # Before the request, since the answer may come at once.
        self._waiting[topic] = _WaitingCommand(operation, self._age.earliest_sent)
        try:
            self._request_control(decision, zero)
        except SwitchboardError:
            self._waiting.pop(topic, None)
            raise

    def _request_control(self, decision: PublishDecision, zero: bool) -> None:
        streams = self._streams
        if not self._controller.lease.pending_for(self._client):
            # The first command to a free robot acquires control, for programs that do not use control explicitly.
            self._streams = CommandStreams(TOPICS)
        try:
            self._controller.acquire_by_command(self._client)
        except SwitchboardError:
            self._streams = streams
            self._record_refused(decision, zero)
            raise

    def control_changed(self) -> None:
        """Send or drop the commands that waited, as the holder of control has changed."""
        lease, client = self._controller.lease, self._client
        if not self._waiting or lease.pending_for(client):
            return
        waiting, self._waiting = self._waiting, {}
        if not lease.held_by(client):
            # The controller has sent the reason.
            return
        for each in waiting.values():
            with self._age.as_of(each.earliest_sent):
                self._publish_again(each)

    def _publish_again(self, waiting: _WaitingCommand) -> None:
        """Publish a command that waited; it is checked again, at its age.

        If the client has unadvertised the topic meanwhile, it is advertised for this command only.
        """
        client, topic = self._client, resolve(waiting.operation.topic)
        publications = client.channel.publications
        unadvertised = client not in publications.advertisers(topic)
        try:
            self.publish(waiting.operation)
        except SwitchboardError as error:
            client.refuse(waiting.operation, error)
        if unadvertised and client in publications.advertisers(topic):
            publications.unadvertise(client, topic, None)

    def _drop_stale(self, decision: PublishDecision, age: int, id: rosbridge.Id) -> None:
        self._motion.stale_commands += 1
        deadline_ms = decision.description.motion.deadline_ms
        text = too_old(f"a command to {decision.publication.topic} was dropped", age, deadline_ms)
        self._client.notify("warning", text, id)


def _is_zero(decision: PublishDecision, operation: rosbridge.Publish) -> bool:
    return is_zero_command(decision.publication.type, bytes(operation.msg))
