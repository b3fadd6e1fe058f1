"""What of the relay's own events names something of a robot: only who may use that is told (SPEC section 1.14)."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import msgspec

from relay_db.base import canonical_json
from relay_db.queries import NameIs, StoredEventRecord
from relay_db.queries.event_search import OURS
from relay_protocol.rights import Operation, Rules

FIELDS = {
    "motion.begun": "topic",
    "publication.begun": "topic",
    "robot.suppressed": "resource",
    "robot.inhibited": "resource",
    "robot.key_used_twice": "addresses",
    "param.set": "param",
    "video.joined": "camera",
    "video.left": "camera",
    "call.begun": "service",
    "call.ended": "service",
    "goal.begun": "action",
    "goal.ended": "action",
}
"""By kind, the field of its data that names something."""


def _topic(rules: Rules, name: str) -> bool:
    # What carries pictures nobody knows here: the robot may be away.
    hears = (Operation.SUBSCRIBE, Operation.VIEW)
    return _may(rules, Operation.PUBLISH, name) or all(_may(rules, each, name) for each in hears)


def _camera(rules: Rules, name: str) -> bool:
    return _may(rules, Operation.VIEW, name)


def _call(rules: Rules, name: str) -> bool:
    return _may(rules, Operation.CALL, name)


def _param(rules: Rules, name: str) -> bool:
    return _may(rules, Operation.CALL, f"{name.partition(':')[0]}/get_parameters")


def _addresses(rules: Rules, name: str) -> bool:
    return _may(rules, Operation.MANAGE, "")


def _may(rules: Rules, operation: Operation, name: str) -> bool:
    return rules.judge(operation, name).allowed


_WAYS: Mapping[str, Callable[[Rules, str], bool]] = {
    "topic": _topic,
    "resource": _topic,
    "camera": _camera,
    "service": _call,
    "action": _call,
    "param": _param,
    "addresses": _addresses,
}


def told(event: StoredEventRecord, rules: Rules) -> str:
    """The data of an event of a robot, without the name of what its reader may not use there."""
    field = FIELDS.get(event.kind) if event.source.startswith(OURS) else None
    if field is None:
        return event.data
    data = msgspec.json.decode(event.data)
    name = data.get(field)
    if not isinstance(name, str) or _WAYS[field](rules, name):
        return event.data
    return canonical_json({each: value for each, value in data.items() if each != field})


def may_ask(rules: Rules, source: NameIs | None, data: tuple[tuple[str, str], ...]) -> bool:
    """Whether somebody may look among a robot's events for these values: by what is found he would know the names.

    :param source: those of nobody but programs and users he may
    """
    ours = source is None or source.text.startswith(OURS) or (source.prefix and OURS.startswith(source.text))
    return not ours or all(name not in _WAYS or _WAYS[name](rules, value) for name, value in data)
