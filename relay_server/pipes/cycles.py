"""Finds pipes that would feed themselves."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from relay_server.channels.names import resolve
from relay_server.pipes.schemas import PipeEnd

EndKey = tuple[int, str]
"""What is at an end of a pipe: the number of a robot, and a topic, service or action of it. For a program it is 0."""


def end_key(end: PipeEnd, robot_id: int, owner_id: int) -> EndKey:
    """The key of an end. A topic and a service of one name are two things, as are programs of two users.

    :param robot_id: of the end's robot; not used for a program
    """
    if end.program:
        return 0, f"{owner_id}/{end.address}"
    name = resolve(end.name)
    action, of_action, _ = name.partition("/_action/")
    if of_action:
        # Feedback and status of an action, or what begins a goal.
        return robot_id, f"action {action}"
    kind = "service" if end.service else "action" if end.action else "topic"
    return robot_id, f"{kind} {name}"


class PipeEdge(NamedTuple):
    """What a pipe connects.

    :param limited: whether it has a rate limit
    """

    name: str
    source: EndKey
    target: EndKey
    limited: bool


def find_cycle(new: PipeEdge, others: Iterable[PipeEdge]) -> list[str]:
    """The names of pipes that a message would pass again and again if ``new`` ran too; empty: there is no such cycle.

    A pipe with a rate limit ends a cycle: messages still go round, but no faster than that.
    """
    if new.limited:
        return []
    following: dict[EndKey, list[PipeEdge]] = {}
    for edge in others:
        if not edge.limited:
            following.setdefault(edge.source, []).append(edge)
    seen = {new.target}
    paths = [[new]]
    while paths:
        path = paths.pop()
        if path[-1].target == new.source:
            return [each.name for each in path]
        for edge in following.get(path[-1].target, ()):
            if edge.target not in seen or edge.target == new.source:
                seen.add(edge.target)
                paths.append([*path, edge])
    return []
