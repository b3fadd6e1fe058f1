"""One client of a robot: what the handlers of its session, the channel, control and the relay's node need of it."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Mapping
from typing import Any, Protocol

from twisted.logger import Logger

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import Refused
from relay_protocol.rights import Operation
from relay_server.access import Permit
from relay_server.channels.channel import Channel
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.goals import GoalStatusCode, OwnGoal
from relay_server.channels.publications import RobotPublication
from relay_server.channels.samples import Sample
from relay_server.common.clock import Clock
from relay_server.common.cpu_quota import UserQuota
from relay_server.common.token_bucket import TokenBucket
from relay_server.control.controller import RobotController
from relay_server.robots.link_quality import LinkQuality
from relay_server.robots.registry import RobotState
from relay_server.sessions.message_age import MessageAge
from relay_server.sessions.ports import ActivityListener, ClientPort, ignore_activity
from relay_server.sessions.session_quota import SessionQuota
from relay_server.sessions.zero_command import is_zero_command

LINES_A_SECOND = 1.0
LINES_AT_ONCE = 20.0
"""Limits of the log lines that refusals of one client cause."""


class CommandTopic(Protocol):
    """A topic on which a client has commanded the robot.

    :ivar latest: JSON of the latest command that passed; ``None`` before the first
    """

    publication: RobotPublication
    latest: bytes | None


class MotionActivity:
    """When a client last commanded the robot. Times are ``earliest_sent`` of :class:`MessageAge`.

    :ivar last_command: time of its latest command
    :ivar last_motion: time of its latest command that passed and was not zero
    :ivar goals: number of its goals that are moving the robot
    :ivar topics: topics on which it commands the robot
    :ivar stale_commands: commands dropped because they may have been too old
    """

    __slots__ = ("goals", "last_command", "last_motion", "stale_commands", "topics")

    def __init__(self) -> None:
        self.last_command = 0
        self.last_motion = 0
        self.goals = 0
        self.topics: Mapping[str, CommandTopic] = {}
        self.stale_commands = 0

    @property
    def still_commanding(self) -> bool:
        """Whether on any topic the latest command that passed was not zero."""
        return any(
            each.latest is not None and not is_zero_command(each.publication.type, each.latest)
            for each in self.topics.values()
        )


class ClientContext:
    """One client: its permit, robot, channel and controller, the port of its answers, and its CPU quota.

    :param number: number of the client, unique in this relay
    :param address: network address, for display
    :param since: Unix seconds at which it connected
    :param age: how old its messages can be
    :param user_quota: the CPU quota of its user, over all connections
    :ivar opened: seconds of the relay's clock at which it connected
    :ivar close: closes the session with a code of :mod:`relay_server.common.close_codes` and a reason
    :ivar recheck_rights: called when the robot's topics or cameras have changed
    :ivar control_changed: called when another client has got control, or the client has lost it
    :ivar plain_instead: messages sent as plain JSON because a costlier encoding exceeded the quota
    :ivar queued_bytes: bytes that wait in the throttles of all its subscriptions, which update the number
    """

    log = Logger()

    __slots__ = (
        "_clock",
        "activity",
        "address",
        "age",
        "channel",
        "close",
        "control_changed",
        "controller",
        "deliver",
        "log_lines",
        "motion",
        "number",
        "opened",
        "permit",
        "plain_instead",
        "port",
        "queued_bytes",
        "quota",
        "recheck_rights",
        "refusals",
        "robot",
        "since",
    )

    def __init__(
        self,
        *,
        clock: Clock,
        number: int,
        address: str,
        since: float,
        permit: Permit,
        robot: RobotState,
        channel: Channel,
        controller: RobotController,
        port: ClientPort,
        age: MessageAge,
        user_quota: UserQuota,
    ) -> None:
        self._clock = clock
        self.number = number
        self.address = address
        self.since = since
        self.opened = clock.seconds()
        self.permit = permit
        self.robot = robot
        self.channel = channel
        self.controller = controller
        self.port = port
        self.age = age
        self.quota = SessionQuota(user_quota, channel.fair_queue, port.disconnect)
        self.motion = MotionActivity()
        self.activity: ActivityListener = ignore_activity
        self.close: Callable[[int, str], None] = port.disconnect
        self.recheck_rights: Callable[[], None] = _nothing
        self.control_changed: Callable[[], None] = _nothing
        # Called for every sample, so not through a method of this class.
        self.deliver: Callable[[ClientSubscription, Sample], None] = port.deliver
        self.refusals = 0
        self.plain_instead = 0
        self.queued_bytes = 0
        self.log_lines = TokenBucket(LINES_A_SECOND, LINES_AT_ONCE, clock.seconds)

    @property
    def user(self) -> int:
        """The user's number."""
        return self.permit.principal.user_id

    @property
    def name(self) -> str:
        """The user's name at this robot."""
        return self.robot.name_of(self.permit.principal.name, self.permit.principal.realm)

    @property
    def earliest_sent(self) -> int:
        """Of what the client sends now; see :class:`relay_server.sessions.message_age.MessageAge`."""
        return self.age.earliest_sent

    @property
    def stale_commands(self) -> int:
        """Commands dropped because they may have been too old."""
        return self.motion.stale_commands

    @property
    def rtt(self) -> float | None:
        """Round trip to the client by websocket ping, seconds."""
        return None if self.age.rtt is None else self.age.rtt / 1e9

    @property
    def drops(self) -> int:
        """Samples dropped because the client did not read in time."""
        return self.port.dropped_samples

    def link_quality(self) -> LinkQuality:
        """The quality of the link to the client."""
        return self.age.link_quality()

    # --- what the client is sent --------------------------------------------------------------------------

    def dropped(self, subscription: ClientSubscription) -> None:
        """Count a sample that was evicted before the client could get it."""
        self.port.dropped(subscription)

    def notify(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """Send a status, if the client has requested that level.

        :param id: of the operation that it concerns
        """
        self.port.status(level, text, id)

    def warn_of_drops(self, text: str, id: rosbridge.Id = None) -> None:
        """Warn of samples or messages that are dropped; a port that shows the counts itself ignores it."""
        self.port.warn_of_drops(text, id)

    def count_refusal(self) -> None:
        """Count something that is not carried out, also against the user's CPU quota."""
        self.refusals += 1
        self.quota.count_refusal()

    def refuse(self, operation: rosbridge.ClientOp, error: Exception) -> None:
        """Notify the client that an operation was not carried out; an operation that needs an answer gets one."""
        self.refusals += 1
        if self.log_lines.take():
            # Bounded, so that one client cannot fill the disk; all are counted in /relay/status.
            self.log.info(
                "client {number}: {what} refused: {reason}",
                number=self.number,
                what=type(operation).__name__,
                reason=str(error),
            )
        self.notify("error", str(error), operation.id)
        self.answer_failed(operation, error)

    def answer_failed(self, operation: rosbridge.ClientOp, error: Exception) -> None:
        """Answer an operation with the reason why it was not carried out, if it needs an answer."""
        if isinstance(operation, rosbridge.CallService):
            self.port.service_response(operation, False, jsontext.encode(str(error)))
        elif isinstance(operation, rosbridge.SendActionGoal):
            never_began = GoalStatusCode.NEVER_BEGAN
            self.port.action_result(operation, never_began, False, jsontext.encode(str(error)))

    # --- rights and control -------------------------------------------------------------------------------

    def require(self, operation: Operation, resource: str) -> None:
        """:raises Refused: the client may not do this to that resource of the robot, with the reason"""
        decision = self.permit.decide(operation, resource)
        if not decision.allowed:
            raise Refused(decision.reason)

    def last_motion_at(self) -> float:
        """Seconds of the clock at its latest moving command; now, while a goal of the client moves the robot."""
        return self._seconds_at(self.motion.last_motion)

    def last_command_at(self) -> float:
        """As :meth:`last_motion_at`, for its latest command, also if that was zero or did not pass."""
        return self._seconds_at(self.motion.last_command)

    def last_alive_while_driving(self) -> float:
        """Seconds of the clock at its latest sign of life; infinite if all its latest commands were zero."""
        if not self.motion.still_commanding:
            return float("inf")
        if not self.port.proves_liveness:
            return self.last_motion_at()
        return self._clock.seconds() - self.age.silence() / 1e9

    def _seconds_at(self, earliest_sent: int) -> float:
        """Seconds of the clock at a time of :class:`MessageAge`; now, while a goal moves the robot."""
        ago = 0 if self.motion.goals else self.age.now() - earliest_sent
        return self._clock.seconds() - ago / 1e9


StartOwnGoal = Callable[["ClientContext", bytes, OwnGoal], Coroutine[Any, Any, None]]
"""Begins a goal of one of the relay's own actions, and sets its executor.

Its arguments are the client, the arguments of the goal as JSON, and the goal. It raises a
:class:`relay_protocol.errors.SwitchboardError` if the goal can't begin."""


class LocalNode(Protocol):
    """The relay's own services, actions and topics in every robot's graph (``/relay/…``, ``/rosapi/…``)."""

    def service(self, name: str) -> Callable[[ClientContext, Any], Coroutine[Any, Any, Any]] | None:
        """The handler of one of the relay's own services."""

    def action(self, name: str) -> StartOwnGoal | None:
        """The function that begins goals of one of the relay's own actions."""

    def topic(self, name: str) -> Callable[[ClientContext], dict[str, Any]] | None:
        """The function that makes the messages of one of the relay's own topics."""

    def pushed(self, name: str) -> bool:
        """Whether one of the relay's own topics is published on change, and not once a second."""


def _nothing(*_: Any) -> None:
    pass
