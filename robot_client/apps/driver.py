"""Driving by one line: control taken and given back, the robot's limits, zero, stop. What joystick and voice share."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from robot_client.apps.connection import Lost, RosbridgeConnection

TWIST = "geometry_msgs/msg/Twist"
BEAT = 0.25
"""Seconds from one look at how the robot is reached to the next."""

LATE = 1.0
"""Seconds without an answer of the robot after which nobody should go on driving what he can't reach."""

SILENT = 6.0
"""Seconds without an answer after which there is no connection, whatever the system says."""


class VelocityCommand(NamedTuple):
    """Metres per second ahead and radians per second counter-clockwise."""

    speed: float
    turn: float


STILL = VelocityCommand(0.0, 0.0)


class MaximumSpeeds(NamedTuple):
    """The fastest: metres per second and radians per second."""

    speed: float
    turn: float

    def within(self, other: MaximumSpeeds) -> MaximumSpeeds:
        """The stricter of each."""
        return MaximumSpeeds(min(self.speed, other.speed), min(self.turn, other.turn))


UNLIMITED = MaximumSpeeds(math.inf, math.inf)


def twist(command: VelocityCommand) -> dict[str, Any]:
    """A command as ``geometry_msgs/Twist``."""
    return {"linear": {"x": command.speed}, "angular": {"z": command.turn}}


class StopNotice:
    """The relay's stop, from when it is asked for until it is answered: it outlives the line it was asked by.

    :ivar asked: whether it waits for its answer
    :ivar done: whether the robot has done the last one
    :ivar words: how the last one stands; empty before the first
    """

    def __init__(self) -> None:
        self.asked = False
        self.done = False
        self.words = ""

    def ask(self) -> None:
        """It is wanted."""
        self.asked, self.done = True, False
        self.words = "stop asked for, not answered yet"

    def answer(self, answer: dict[str, Any]) -> None:
        """The relay's answer has come.

        :param answer: ``service_response`` of ``/relay/stop``
        """
        values = answer["values"]
        self.asked = self.done = False
        if not answer["result"]:
            self.words = f"stop refused: {values}"
        elif not values["success"]:
            self.words = f"stop not done: {values['message']}"
        elif not values.get("done"):
            self.words = "stop not done yet: the robot does it as soon as it is back"
        else:
            self.done = True
            self.words = "stop: the robot is stopped until it is resumed"


class Driver:
    """Drives a robot by one line, while that lasts. A stop that the line before left unanswered comes first.

    :param line: to the robot
    :param topic: of the commands
    :param name: of the program: what the relay writes down as the reason of what it asks
    :param clock: seconds, suspends included
    :param stop: what is known of the relay's stop, also by the lines before
    :param heard: takes the messages of topics that the program itself has subscribed to: the topic, the message
    :ivar in_control: whether the robot is this program's to drive
    :ivar obstacle: why it can't be driven, in words; empty where nothing is known against it
    :ivar suppressed: whether the topic obeys somebody else than who has control
    :ivar wanted_by: who else asks for control; empty where nobody does
    :ivar round_trip: seconds that the way to the robot and back took last; ``None`` before the first
    :ivar said: what the relay refused last, in its words, until it is asked for something else
    """

    def __init__(
        self,
        line: RosbridgeConnection,
        topic: str,
        name: str,
        clock: Callable[[], float],
        stop: StopNotice,
        heard: Callable[[str, dict[str, Any]], None] = lambda topic, message: None,
    ) -> None:
        self.in_control = False
        self.suppressed = False
        self.obstacle = ""
        self.wanted_by = ""
        self.round_trip: float | None = None
        self.said = ""
        self._line = line
        self._topic = topic
        self._name = name
        self._clock = clock
        self._stop = stop
        self._heard = heard
        self._level = ""
        self._limits: dict[str, Any] = {}
        self._waiting: dict[str, Callable[[dict[str, Any]], None]] = {}
        self._asking = False
        self._moved = False
        self._beat = -math.inf
        self._unanswered: float | None = None
        if stop.asked:
            self._say_stop()
        line.say(op="set_level", level="error")
        line.say(op="advertise", topic=topic, type=TWIST)
        line.say(op="subscribe", topic="/relay/control")
        line.say(op="subscribe", topic="/relay/status")

    @property
    def limits(self) -> MaximumSpeeds:
        """What the robot allows whoever drives here, as far as it is known."""
        told = self._limits.get(self._level) or {}
        found = (told.get(each) for each in ("linear", "angular"))
        return MaximumSpeeds(*(math.inf if each is None else float(each) for each in found))

    @property
    def late(self) -> bool:
        """Whether the robot has not answered for so long that nobody should go on driving it."""
        return self._silence > LATE

    @property
    def _silence(self) -> float:
        return 0.0 if self._unanswered is None else self._clock() - self._unanswered

    def hear(self, seconds: float) -> None:
        """Take what comes within this time, one message at most, and see that the robot is reached.

        :raises Lost: nothing has come back for long
        """
        message = self._line.hear(seconds)
        if message is not None:
            self._take(message)
        if self._silence > SILENT:
            raise Lost(f"the relay has not answered for {SILENT:g} s")
        now = self._clock()
        if self._unanswered is None and now - self._beat >= BEAT:
            self._beat = self._unanswered = now
            self._ask("/relay/ping", self._beaten, robot=True)

    def take(self) -> None:
        """Ask for control; whether it is given is heard later, by ``in_control`` or ``said``."""
        if not self.in_control and not self._asking:
            self._asking = True
            self.said = ""
            self._ask("/relay/take_control", self._taken, why=self._name)

    def give_back(self) -> None:
        """Stand still, and let others drive."""
        self.still()
        if self.in_control or self._asking:
            self.in_control = self._asking = False
            self._ask("/relay/release_control", _unheeded, why=self._name)

    def withdraw(self) -> None:
        """Want control no more: a request that waits for its answer is taken back."""
        self._asking = False
        self._ask("/relay/release_control", _unheeded, why=self._name)

    def stop(self) -> None:
        """Stop the robot, whoever drives it, until somebody resumes it."""
        # Wanted before anything is said: a line that breaks in saying it leaves it to the next.
        self._stop.ask()
        self.said = ""
        self.still()
        self._say_stop()

    def drive(self, command: VelocityCommand) -> None:
        """One command, within the robot's limits; nothing where it is not this program's to drive."""
        if not self.in_control:
            return
        top = self.limits
        speed = max(-top.speed, min(top.speed, command.speed))
        turn = max(-top.turn, min(top.turn, command.turn))
        self._moved = bool(speed or turn)
        self._line.say(op="publish", topic=self._topic, msg=twist(VelocityCommand(speed, turn)))

    def still(self) -> None:
        """Zero, if the last command was none."""
        if self._moved:
            self.drive(STILL)

    def _say_stop(self) -> None:
        self._ask("/relay/stop", self._stopped, why=self._name)

    def _ask(self, service: str, answered: Callable[[dict[str, Any]], None], **args: Any) -> None:
        self._waiting[self._line.call(service, **args)] = answered

    def _take(self, message: dict[str, Any]) -> None:
        if message["op"] == "service_response":
            self._waiting.pop(str(message["id"]), _unheeded)(message)
        elif message["op"] == "status":
            self.said = str(message["msg"])
        elif message["op"] == "publish" and message["topic"] == "/relay/control":
            self._control(message["msg"])
        elif message["op"] == "publish" and message["topic"] == "/relay/status":
            self._level = str(message["msg"]["level"] or "")
        elif message["op"] == "publish":
            self._heard(str(message["topic"]), message["msg"])

    def _control(self, told: dict[str, Any]) -> None:
        holder, request, stopped = told["holder"], told["request"], told["stopped"]
        self.wanted_by = str(request["user"]) if request and not request["you"] else ""
        self._limits = told["limits"] or {}
        self.in_control = bool(holder and holder["you"])
        elsewhere = (str(each["resource"]) for each in told.get("suppressed") or [])
        self.suppressed = self._topic.lstrip("/") in (each.lstrip("/") for each in elsewhere)
        self._moved = self._moved and self.in_control
        if stopped:
            self.obstacle = f"the robot is stopped by {stopped['by']}"
        elif holder and not holder["you"]:
            self.obstacle = f"{holder['user']} has control"
        elif not told["you"]["may_control"]:
            self.obstacle = "you may not control this robot"
        else:
            self.obstacle = ""

    def _taken(self, answer: dict[str, Any]) -> None:
        wanted, self._asking = self._asking, False
        self._answered(answer)
        if wanted and answer["result"] and answer["values"]["success"]:
            self.in_control = True

    def _answered(self, answer: dict[str, Any]) -> None:
        if not answer["result"]:
            self.said = str(answer["values"])
        elif not answer["values"]["success"]:
            self.said = str(answer["values"]["message"])

    def _stopped(self, answer: dict[str, Any]) -> None:
        # Of several that were asked for, the last one's answer counts.
        if self._stopped not in self._waiting.values():
            self._stop.answer(answer)

    def _beaten(self, answer: dict[str, Any]) -> None:
        asked, self._unanswered = self._unanswered, None
        if asked is not None and answer["result"]:
            self.round_trip = self._clock() - asked


def _unheeded(answer: dict[str, Any]) -> None:
    """What is answered changes nothing."""
