"""``/rosapi/…`` about types, from the definitions the robot sends: packages the relay has never seen work too."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterable
from typing import Any

from relay_protocol.errors import Invalid, NotFound, SwitchboardError
from relay_protocol.limits import MIB
from relay_protocol.ros_types import TypeRegistry
from relay_server.common.gather import PerKeySemaphore, gather_per_key
from relay_server.relay_node import interfaces as catalogue
from relay_server.relay_node.arguments import text
from relay_server.relay_node.view import VisibleGraph, view
from relay_server.sessions.session import Session
from relay_server.sessions.type_names import normal_type

RAW_CHARACTERS = 4 * MIB
"""Most characters of definitions in one answer, which take 40 ms; what is beyond is left out, with a remark instead."""

SURVEYS = 16
"""Questions of one user for all types that may wait for the robot."""

_surveys = PerKeySemaphore(
    SURVEYS, f"{SURVEYS} questions of yours for the types of all topics wait already; try again in a moment"
)

_CONTAINED = re.compile(r"\nMSG: (\w+)/msg/(\w+)[ \t\r]*$", re.MULTILINE)
"""It begins with what is rare and never at the start: so it is found ten times as fast."""


async def known(session: Session, type_name: str, own_text: bool = False) -> TypeRegistry:
    """Where the definition of a type is, once it is there.

    :param own_text: its own text is wanted; else one that contains it will do
    :raises NotFound: the robot does not have it
    :raises Invalid: the robot's definition is unusable
    :raises Unavailable: the robot is offline
    """
    if type_name.startswith(catalogue.PACKAGES) and catalogue.TYPES.knows(type_name):
        return catalogue.TYPES
    await session.channel.asking.definition(type_name, own_text)
    return session.robot.types


def _type(args: Any, kind: str) -> str:
    """The argument ``type``, in full.

    :raises Invalid: it is left out, no type name, or a type of another kind
    """
    type_name = normal_type(text(args, "type"), kind)
    if not type_name:
        raise Invalid("give 'type', a string")
    return type_name


async def message_details(session: Session, args: Any) -> Any:
    """``/rosapi/message_details``: a type the robot does not have gets an empty answer, as in rosapi."""
    type_name = _type(args, "msg")
    try:
        types = await known(session, type_name)
        await session.share.own_turn()
        with session.share.counted():
            return {"typedefs": types.typedefs(type_name)}
    except NotFound:
        return {"typedefs": []}


async def _part_details(session: Session, args: Any, kind: str, part: str) -> Any:
    type_name = _type(args, kind)
    types = await known(session, type_name)
    await session.share.own_turn()
    with session.share.counted():
        return {"typedefs": types.typedefs(f"{type_name}_{part}")}


async def service_request_details(session: Session, args: Any) -> Any:
    """``/rosapi/service_request_details``"""
    return await _part_details(session, args, "srv", "Request")


async def service_response_details(session: Session, args: Any) -> Any:
    """``/rosapi/service_response_details``"""
    return await _part_details(session, args, "srv", "Response")


async def action_goal_details(session: Session, args: Any) -> Any:
    """``/rosapi/action_goal_details``"""
    return await _part_details(session, args, "action", "Goal")


async def action_result_details(session: Session, args: Any) -> Any:
    """``/rosapi/action_result_details``"""
    return await _part_details(session, args, "action", "Result")


async def action_feedback_details(session: Session, args: Any) -> Any:
    """``/rosapi/action_feedback_details``"""
    return await _part_details(session, args, "action", "Feedback")


async def topics_and_raw_types(session: Session, args: Any) -> Any:
    """``/rosapi/topics_and_raw_types``: one type that is not to be had spoils nothing."""
    found = view(session).topics
    types = [next(iter(topic.types), "") for topic in found.values()]
    with _surveys.take(session.allowance):
        texts = await _texts(session, types)
    await session.share.own_turn()
    with session.share.counted():
        return {"topics": list(found), "types": types, "typedefs_full_text": _given(types, texts)}


def _given(types: list[str], texts: dict[str, str]) -> list[str]:
    """The full text of each type as rosapi gives it, as far as there is room."""
    room, given = RAW_CHARACTERS, []
    for type_name in types:
        full = texts[type_name]
        if len(full) > room:
            full = "# left out: the definitions of all topics are too large for one answer"
        else:
            full = _CONTAINED.sub(r"\nMSG: \1/\2", full)
        room -= len(full)
        given.append(full)
    return given


async def _texts(session: Session, types: Iterable[str]) -> dict[str, str]:
    """The full text of each type."""
    texts: dict[str, str] = {}

    async def ask(type_name: str) -> None:
        texts[type_name] = await _full_text(session, type_name)

    await gather_per_key(deque(dict.fromkeys(types)), ask)
    return texts


async def _full_text(session: Session, type_name: str) -> str:
    if not type_name:
        return ""
    try:
        types = await known(session, type_name, own_text=True)
        return types.definition(type_name)
    except SwitchboardError as error:
        return f"# no definition: {error}"


async def interfaces(session: Session, args: Any) -> Any:
    """``/rosapi/interfaces``: all types the robot has; of a robot that does not tell them, those in its graph."""
    if "cdr" in session.robot.encodings:
        told: Iterable[str] = await session.channel.asking.interfaces()
        await session.share.own_turn()
    else:
        told = _in_graph(view(session))
    with session.share.counted():
        return {"interfaces": sorted({*told, *catalogue.TYPE_NAMES})}


def _in_graph(seen: VisibleGraph) -> Iterable[str]:
    for things in (seen.topics, seen.services, seen.actions):
        for each in things.values():
            yield from each.types
