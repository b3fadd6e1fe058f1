"""The state of control as one client may see it (SPEC 1.7), and as the HTTP API returns it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Literal, NotRequired, TypedDict

from relay_protocol.link import Inhibited, Limits, Suppressed
from relay_protocol.rights import Level, Operation, Rules
from relay_server.control.controller import RobotController
from relay_server.control.lease import ControlRequest, Holder, LeaseClient, LeaseState
from relay_server.control.types import ROBOT, ControlSnapshot
from relay_server.robots.registry import RobotState

ControlState = Literal["free", "held", "requested"]


class FurtherStopInfo(TypedDict):
    """A stop of a robot that was stopped already, by another request.

    :param since: Unix seconds
    """

    by: str
    why: str
    since: float


class StopInfo(TypedDict):
    """Why a robot is stopped.

    :param since: Unix seconds
    :param confirmed: whether the robot has confirmed it
    :param again: the latest further stop
    """

    by: str
    why: str
    since: float
    confirmed: bool
    again: FurtherStopInfo | None


class OverrideInfo(TypedDict):
    """A topic that is suppressed or inhibited without control of the robot.

    :param hold: whether it delivers its last value in place of new ones
    """

    resource: str
    by: str
    hold: bool


class Overrides(TypedDict):
    """All topics of a robot that are suppressed or inhibited."""

    suppressed: list[OverrideInfo]
    inhibited: list[OverrideInfo]


class HolderInfo(TypedDict):
    """The client that has control of a robot.

    :param implicit: whether a command acquired it
    """

    user: str
    client: int
    since: float
    you: bool
    implicit: bool


class ControlRequestInfo(TypedDict):
    """A request for control.

    :param until: Unix seconds from which an owner takes over by asking again; from an implicit holder, any client
    """

    user: str
    client: int
    since: float
    why: str
    you: bool
    until: float


class SuppressionInfo(TypedDict):
    """A suppressed topic, commanded by other clients than the holder.

    :param ms: milliseconds left
    """

    resource: str
    ms: int
    sources: list[int]
    by: str


class InhibitionInfo(TypedDict):
    """An inhibited topic, which delivers nothing or only its last value.

    :param ms: milliseconds left
    """

    resource: str
    ms: int
    hold: bool
    by: str


class SpeedLimits(TypedDict):
    """Speed and acceleration limits of a level, in SI units; null: no limit."""

    linear: float | None
    angular: float | None
    linear_acceleration: float | None
    angular_acceleration: float | None


class YouAndControl(TypedDict):
    """Actions on control that the caller may use.

    :param client: number of the caller's connection that has control
    """

    client: int | None
    may_control: bool
    may_resume: bool


class ControlInfo(TypedDict):
    """The state of control of a robot.

    :param limits: by level
    """

    robot: str
    state: ControlState
    holder: HolderInfo | None
    request: ControlRequestInfo | None
    stopped: StopInfo | None
    moving: bool
    suppressed: list[SuppressionInfo]
    inhibited: list[InhibitionInfo]
    limits: dict[str, SpeedLimits]
    you: YouAndControl


class ControlAnswer(TypedDict):
    """The outcome of a request about control.

    :param message: for display
    """

    success: bool
    message: str


class ControlTakeInfo(ControlAnswer):
    """The outcome of taking control; without success, the holder was asked for it.

    :param message: for display
    :param kept: seconds that control lasts without a further request of the caller
    """

    kept: float
    control: ControlInfo


class StopAnswer(TypedDict):
    """Whether the robot is stopped now, and why."""

    stopped: StopInfo | None


class StopValues(ControlAnswer):
    """The answer of the service ``/relay/stop``.

    :param message: for display
    :param done: whether the robot has confirmed the stop and done all of it
    :param stopped: why the robot is stopped or will be; null if nothing is known
    """

    done: bool
    stopped: StopInfo | None


class StopServiceAnswer(TypedDict):
    """The answer to a call of ``/relay/stop``."""

    values: StopValues


class StopProblem(TypedDict):
    """A stop that the robot could not carry out completely."""

    type: str
    title: str
    status: int
    detail: str
    code: str
    stopped: NotRequired[StopInfo | None]


class ControlReader:
    """The client that the state is shown to.

    :param rules: its rights on the robot
    :param mine: returns whether a connection belongs to the client
    """

    def __init__(self, rules: Rules, mine: Callable[[LeaseClient], bool]) -> None:
        self.rules = rules
        self.mine = mine

    def may_know(self, resource: str) -> bool:
        """Whether the client may see a resource, as it may subscribe or publish to it."""
        return any(
            self.rules.decide(operation, resource).allowed
            for operation in (Operation.SUBSCRIBE, Operation.PUBLISH)
        )


def control(controller: RobotController, reader: ControlReader, number: int | None) -> ControlInfo:
    """The holder of control, the request for it, and why the robot is stopped.

    :param number: of the client's connection; ``None``: it has none, or several
    """
    lease, motion = controller.lease, controller.robot.motion_state
    mine = lease.holder is not None and reader.mine(lease.holder.client)
    return {
        "robot": controller.robot.name,
        "state": state(controller.snapshot),
        "holder": None if lease.holder is None else _holder(lease.holder, reader),
        "request": None if lease.request is None else _request(lease.request, reader),
        "stopped": stopped(controller.snapshot),
        "moving": motion.moving,
        "suppressed": [_suppression(each) for each in motion.suppressed if reader.may_know(each.resource)],
        "inhibited": [_inhibition(each) for each in motion.inhibited if reader.may_know(each.resource)],
        "limits": {level: _limits(limits) for level, limits in motion.limits.items()},
        "you": {
            "client": number,
            "may_control": reader.rules.decide(Operation.CONTROL, ROBOT).allowed,
            "may_resume": mine or reader.rules.level is Level.OWNER,
        },
    }


def state(snapshot: ControlSnapshot) -> ControlState:
    """The state of control; ``free`` also until the robot has confirmed a holder."""
    shown: dict[LeaseState, ControlState] = {LeaseState.HELD: "held", LeaseState.REQUESTED: "requested"}
    return shown.get(snapshot.lease.state, "free")


def holder(snapshot: ControlSnapshot) -> str | None:
    """Name of the user who has control, if any."""
    holder_of = snapshot.lease.holder
    return None if holder_of is None else holder_of.client.name


def stopped(snapshot: ControlSnapshot) -> StopInfo | None:
    """Why the robot is stopped, if it is."""
    found = snapshot.stopped
    if found is None:
        return None
    again = found.again
    further: FurtherStopInfo | None = (
        None if again is None else {"by": again.by, "why": again.why, "since": again.since}
    )
    return {
        "by": found.by,
        "why": found.why,
        "since": found.since,
        "confirmed": found.confirmed,
        "again": further,
    }


def overrides(robot: RobotState) -> Overrides:
    """Suppressed and inhibited topics of a robot, with the users that did so."""

    def shown(facts: Iterable[Suppressed | Inhibited]) -> list[OverrideInfo]:
        return [
            {"resource": each.resource, "by": each.by, "hold": isinstance(each, Inhibited) and each.hold}
            for each in facts
        ]

    return {
        "suppressed": shown(robot.motion_state.suppressed),
        "inhibited": shown(robot.motion_state.inhibited),
    }


def visible_overrides(found: Overrides, rules: Rules) -> Overrides:
    """Those without topics that a reader with these rights may not use."""
    reader = ControlReader(rules, lambda client: False)
    return {
        "suppressed": [each for each in found["suppressed"] if reader.may_know(each["resource"])],
        "inhibited": [each for each in found["inhibited"] if reader.may_know(each["resource"])],
    }


def _holder(holder_of: Holder, reader: ControlReader) -> HolderInfo:
    client = holder_of.client
    return {
        "user": client.name,
        "client": client.number,
        "since": holder_of.since,
        "you": reader.mine(client),
        "implicit": holder_of.implicit,
    }


def _request(request: ControlRequest, reader: ControlReader) -> ControlRequestInfo:
    client = request.client
    return {
        "user": client.name,
        "client": client.number,
        "since": request.since,
        "why": request.why,
        "you": reader.mine(client),
        "until": request.until,
    }


def _suppression(suppressed: Suppressed) -> SuppressionInfo:
    return {
        "resource": suppressed.resource,
        "ms": suppressed.ms,
        "sources": suppressed.sources,
        "by": suppressed.by,
    }


def _inhibition(inhibited: Inhibited) -> InhibitionInfo:
    return {
        "resource": inhibited.resource,
        "ms": inhibited.ms,
        "hold": inhibited.hold,
        "by": inhibited.by,
    }


def _limits(limits: Limits) -> SpeedLimits:
    return {
        "linear": limits.linear,
        "angular": limits.angular,
        "linear_acceleration": limits.linear_acceleration,
        "angular_acceleration": limits.angular_acceleration,
    }
