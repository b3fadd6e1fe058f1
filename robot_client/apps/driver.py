"""Drives a robot over one connection: control, speed limits, zero velocity, stop. All driving applications use it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple
from uuid import uuid4

from robot_client.apps.connection import Lost, RosbridgeConnection

TWIST = "geometry_msgs/msg/Twist"
PING_SECONDS = 0.25
"""Interval of pings to the robot."""

UNRESPONSIVE_SECONDS = 1.0
"""Time without an answer of the robot after which driving ends."""

LOST_SECONDS = 6.0
"""Time without an answer after which the connection counts as lost."""


class VelocityCommand(NamedTuple):
    """Forward speed in m/s and turn rate in rad/s, counter-clockwise."""

    speed: float
    turn: float


ZERO_VELOCITY = VelocityCommand(0.0, 0.0)


class MaximumSpeeds(NamedTuple):
    """Speed limits: m/s and rad/s."""

    speed: float
    turn: float

    def within(self, other: MaximumSpeeds) -> MaximumSpeeds:
        """The lower of each."""
        return MaximumSpeeds(min(self.speed, other.speed), min(self.turn, other.turn))


UNLIMITED = MaximumSpeeds(math.inf, math.inf)


def twist(command: VelocityCommand) -> dict[str, Any]:
    """A command as ``geometry_msgs/Twist``."""
    return {"linear": {"x": command.speed}, "angular": {"z": command.turn}}


class StopRequest:
    """A stop request to the relay, until it is answered. It outlives the connection on which it was sent.

    :ivar pending: whether it waits for its answer
    :ivar done: whether the robot has stopped, with all that belongs to it
    :ivar text: result of the last request; empty before the first
    """

    def __init__(self) -> None:
        self.pending = False
        self.done = False
        self.text = ""

    def request(self) -> None:
        """A stop was requested."""
        self.pending, self.done = True, False
        self.text = "stop requested, not confirmed yet"

    def handle_answer(self, answer: dict[str, Any]) -> None:
        """Take the relay's answer.

        :param answer: ``service_response`` of ``/relay/stop``
        """
        values = answer["values"]
        self.pending = self.done = False
        if not answer["result"]:
            self.text = f"stop refused: {values}"
        elif not values["success"] and values.get("stopped"):
            # A part of the stop failed. It stays shown, as ``done`` is false.
            self.text = f"stop: {values['message']}"
        elif not values["success"]:
            self.text = f"stop not done: {values['message']}"
        elif not values.get("done"):
            self.text = "stop pending: the robot stops as soon as it is online"
        else:
            self.done = True
            self.text = "stop: the robot is stopped until it is resumed"


class Driver:
    """Drives a robot over one connection. A stop request that the last connection left unanswered is sent first.

    :param connection: to the robot
    :param topic: of the commands
    :param name: of the program; the relay logs it as the reason of its requests
    :param clock: seconds, including suspends
    :param stop: stop request, shared by successive connections
    :param on_topic: called with topic and message of the program's own subscriptions
    :ivar in_control: whether this program holds control
    :ivar blocked_by: why the robot cannot be driven; empty when it can
    :ivar suppressed: whether the topic is suppressed by another connection
    :ivar requested_by: user that requests control; empty without a request
    :ivar round_trip: last round trip to the robot, seconds; ``None`` before the first
    :ivar refusal: what the relay refused last, in its words, until the next request
    """

    def __init__(
        self,
        connection: RosbridgeConnection,
        topic: str,
        name: str,
        clock: Callable[[], float],
        stop: StopRequest,
        on_topic: Callable[[str, dict[str, Any]], None] = lambda topic, message: None,
    ) -> None:
        self.in_control = False
        self.suppressed = False
        self.blocked_by = ""
        self.requested_by = ""
        self.round_trip: float | None = None
        self.refusal = ""
        self._connection = connection
        self._topic = topic
        self._name = name
        self._clock = clock
        self._stop = stop
        self._on_topic = on_topic
        self._level = ""
        self._limits: dict[str, Any] = {}
        self._waiting: dict[str, Callable[[dict[str, Any]], None]] = {}
        self._requesting = False
        self._moving = False
        self._pinged_at = -math.inf
        self._unanswered: float | None = None
        if stop.pending:
            self._send_stop()
        connection.send(op="set_level", level="error")
        connection.send(op="advertise", topic=topic, type=TWIST)
        connection.send(op="subscribe", topic="/relay/control")
        connection.send(op="subscribe", topic="/relay/status")

    @property
    def limits(self) -> MaximumSpeeds:
        """The robot's speed limits for this user, as far as known."""
        limits = self._limits.get(self._level) or {}
        return MaximumSpeeds(speed=_limit(limits.get("linear")), turn=_limit(limits.get("angular")))

    @property
    def unresponsive(self) -> bool:
        """Whether the robot has not answered for so long that driving must end."""
        return self._unanswered_seconds > UNRESPONSIVE_SECONDS

    @property
    def _unanswered_seconds(self) -> float:
        return 0.0 if self._unanswered is None else self._clock() - self._unanswered

    def poll(self, seconds: float) -> None:
        """Handle at most one message that arrives within ``seconds``, and ping the robot.

        :raises Lost: the relay has not answered for :data:`LOST_SECONDS`
        """
        message = self._connection.receive(seconds)
        if message is not None:
            self._take(message)
        if self._unanswered_seconds > LOST_SECONDS:
            raise Lost(f"the relay has not answered for {LOST_SECONDS:g} s")
        now = self._clock()
        if self._unanswered is None and now - self._pinged_at >= PING_SECONDS:
            self._pinged_at = self._unanswered = now
            self._ask("/relay/ping", self._ping_answered, robot=True)

    def request_control(self) -> None:
        """Request control. ``in_control`` or ``refusal`` show the answer later."""
        if not self.in_control and not self._requesting:
            self._requesting = True
            self.refusal = ""
            self._ask("/relay/take_control", self._control_answered, why=self._name)

    def release_control(self) -> None:
        """Stop the robot and release control."""
        self.halt()
        if self.in_control or self._requesting:
            self.in_control = self._requesting = False
            self._ask("/relay/release_control", _ignore, why=self._name)

    def withdraw_request(self) -> None:
        """Withdraw a request for control."""
        self._requesting = False
        self._ask("/relay/release_control", _ignore, why=self._name)

    def stop(self) -> None:
        """Stop the robot until it is resumed. This needs no control."""
        # Recorded before it is sent: if the connection breaks while sending, the next one sends it.
        self._stop.request()
        self.refusal = ""
        self.halt()
        self._send_stop()

    def drive(self, command: VelocityCommand) -> None:
        """Send a command within the robot's limits, if this program holds control."""
        if not self.in_control:
            return
        top = self.limits
        speed = max(-top.speed, min(top.speed, command.speed))
        turn = max(-top.turn, min(top.turn, command.turn))
        self._moving = bool(speed or turn)
        self._connection.send(op="publish", topic=self._topic, msg=twist(VelocityCommand(speed, turn)))

    def halt(self) -> None:
        """Send zero velocity, unless the last command was zero."""
        if self._moving:
            self.drive(ZERO_VELOCITY)

    def _send_stop(self) -> None:
        self._ask("/relay/stop", self._stop_answered, why=self._name, stop_id=uuid4().hex)

    def _ask(self, service: str, answered: Callable[[dict[str, Any]], None], **args: Any) -> None:
        self._waiting[self._connection.call(service, **args)] = answered

    def _take(self, message: dict[str, Any]) -> None:
        if message["op"] == "service_response":
            self._waiting.pop(str(message["id"]), _ignore)(message)
        elif message["op"] == "status":
            self.refusal = str(message["msg"])
        elif message["op"] == "publish" and message["topic"] == "/relay/control":
            self._control(message["msg"])
        elif message["op"] == "publish" and message["topic"] == "/relay/status":
            self._level = str(message["msg"]["level"] or "")
        elif message["op"] == "publish":
            self._on_topic(str(message["topic"]), message["msg"])

    def _control(self, control: dict[str, Any]) -> None:
        holder, request, stopped = control["holder"], control["request"], control["stopped"]
        self.requested_by = str(request["user"]) if request and not request["you"] else ""
        self._limits = control["limits"] or {}
        self.in_control = bool(holder and holder["you"])
        elsewhere = (str(each["resource"]) for each in control.get("suppressed") or [])
        self.suppressed = self._topic.lstrip("/") in (each.lstrip("/") for each in elsewhere)
        self._moving = self._moving and self.in_control
        if stopped:
            self.blocked_by = f"the robot is stopped by {stopped['by']}"
        elif holder and not holder["you"]:
            self.blocked_by = f"{holder['user']} has control"
        elif not control["you"]["may_control"]:
            self.blocked_by = "you may not control this robot"
        else:
            self.blocked_by = ""

    def _control_answered(self, answer: dict[str, Any]) -> None:
        wanted, self._requesting = self._requesting, False
        self._answered(answer)
        if wanted and answer["result"] and answer["values"]["success"]:
            self.in_control = True

    def _answered(self, answer: dict[str, Any]) -> None:
        if not answer["result"]:
            self.refusal = str(answer["values"])
        elif not answer["values"]["success"]:
            self.refusal = str(answer["values"]["message"])

    def _stop_answered(self, answer: dict[str, Any]) -> None:
        # With several requests, the answer to the last one counts.
        if self._stop_answered not in self._waiting.values():
            self._stop.handle_answer(answer)

    def _ping_answered(self, answer: dict[str, Any]) -> None:
        asked, self._unanswered = self._unanswered, None
        if asked is not None and answer["result"]:
            self.round_trip = self._clock() - asked


def _ignore(answer: dict[str, Any]) -> None:
    """Handler of answers that change nothing."""


def _limit(value: Any) -> float:
    return math.inf if value is None else float(value)
