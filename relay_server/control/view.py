"""What is told of control: to each client what it may know, and which of it is its own (SPEC section 1.7)."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import msgspec

from relay_protocol.link import Inhibited, Suppressed
from relay_protocol.rights import Level, Operation, Rules
from relay_server.control.controller import RobotController
from relay_server.control.lease import ControlRequest, Holder, LeaseClient, LeaseState
from relay_server.control.types import ROBOT, ControlSnapshot
from relay_server.robots.registry import RobotState


class ControlReader:
    """Who is told.

    :param rules: its rights on the robot
    :param mine: whether a connection is its own
    """

    def __init__(self, rules: Rules, mine: Callable[[LeaseClient], bool]) -> None:
        self.rules = rules
        self.mine = mine

    def may_know(self, resource: str) -> bool:
        """What one may not use is not shown."""
        return any(
            self.rules.judge(operation, resource).allowed
            for operation in (Operation.SUBSCRIBE, Operation.PUBLISH)
        )


def control(desk: RobotController, asker: ControlReader, number: int | None) -> dict[str, Any]:
    """Who moves the robot, who asks to, and why it stands.

    :param number: of the asker's connection, ``None`` when it has none or is told of all
    """
    lease, safety = desk.lease, desk.robot.safety
    mine = lease.holder is not None and asker.mine(lease.holder.client)
    return {
        "robot": desk.robot.name,
        "state": state(desk.standing),
        "holder": None if lease.holder is None else _holder(lease.holder, asker),
        "request": None if lease.request is None else _request(lease.request, asker),
        "stopped": stopped(desk.standing),
        "moving": safety.moving,
        "suppressed": _known(safety.suppressed, asker),
        "inhibited": _known(safety.inhibited, asker),
        "limits": {level: msgspec.structs.asdict(limits) for level, limits in safety.limits.items()},
        "you": {
            "client": number,
            "may_control": asker.rules.judge(Operation.CONTROL, ROBOT).allowed,
            "may_resume": mine or asker.rules.level is Level.OWNER,
        },
    }


def state(standing: ControlSnapshot) -> str:
    """``free``, ``held`` or ``requested``; while the robot is being told of somebody nobody has it."""
    now = standing.lease.state
    shown = now if now in (LeaseState.HELD, LeaseState.REQUESTED) else LeaseState.FREE
    return str(shown.value)


def holder(standing: ControlSnapshot) -> str | None:
    """The user who has control, if anybody has."""
    tenure = standing.lease.holder
    return None if tenure is None else tenure.client.name


def stopped(standing: ControlSnapshot) -> dict[str, Any] | None:
    """Why the robot stands, if it was stopped."""
    found = standing.stopped
    if found is None:
        return None
    return {**found._asdict(), "again": None if found.again is None else found.again._asdict()}


def overrides(robot: RobotState, rules: Rules | None = None) -> dict[str, list[dict[str, Any]]]:
    """Who has a hand on topics of a robot without having control of it: who commands, and who keeps quiet.

    :param rules: of who is told, who learns of no topic that he may not use; ``None``: of all
    """
    asker = None if rules is None else ControlReader(rules, lambda client: False)

    def told(facts: Iterable[Suppressed | Inhibited]) -> list[dict[str, Any]]:
        return [
            {"resource": each.resource, "by": each.by, "hold": isinstance(each, Inhibited) and each.hold}
            for each in facts
            if asker is None or asker.may_know(each.resource)
        ]

    return {"suppressed": told(robot.safety.suppressed), "inhibited": told(robot.safety.inhibited)}


def _holder(tenure: Holder, asker: ControlReader) -> dict[str, Any]:
    client = tenure.client
    return {
        "user": client.name,
        "client": client.number,
        "since": tenure.since,
        "you": asker.mine(client),
        "implicit": tenure.implicit,
    }


def _request(request: ControlRequest, asker: ControlReader) -> dict[str, Any]:
    client = request.client
    return {
        "user": client.name,
        "client": client.number,
        "since": request.since,
        "why": request.why,
        "you": asker.mine(client),
        "until": request.until,
    }


def _known(told: Iterable[Suppressed | Inhibited], asker: ControlReader) -> list[dict[str, Any]]:
    return [msgspec.structs.asdict(each) for each in told if asker.may_know(each.resource)]
