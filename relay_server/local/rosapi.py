"""``/rosapi/…`` answered from the relay's mirror of the graph, without asking the robot.

A topic or service the caller may not use is absent from every answer. Names are taken with and without their
leading slash, as rosapi does.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Any

from relay_protocol.errors import Invalid, SwitchboardError
from relay_protocol.link import Service, Topic
from relay_protocol.rights import Operation
from relay_server.session import Session, normal_type

LOCAL_TOPICS = {"/relay/status": "switchboard_msgs/msg/Status"}


def _text(args: Any, field: str) -> str:
    value = (
        args.get(field) if isinstance(args, dict) else args[0] if isinstance(args, list) and args else None
    )
    if not isinstance(value, str):
        raise Invalid(f"give '{field}', a string")
    return value


def _name(args: Any, field: str) -> str:
    text = _text(args, field)
    return text if text.startswith("/") else "/" + text


def _topics(session: Session) -> dict[str, Topic]:
    """The topics the caller may subscribe or publish to."""
    judge = session.permit.judge
    seen = {
        name: topic
        for name, topic in sorted(session.robot.graph.topics.items())
        if judge(Operation.SUBSCRIBE, name).allowed or judge(Operation.PUBLISH, name).allowed
    }
    for name, type_name in LOCAL_TOPICS.items():
        seen[name] = Topic(types=[type_name], publishers=["/relay"])
    return seen


def _services(session: Session) -> dict[str, Service]:
    """The services the caller may call."""
    judge = session.permit.judge
    return {
        name: service
        for name, service in sorted(session.robot.graph.services.items())
        if judge(Operation.CALL, name).allowed
    }


def _first(types: Iterable[str]) -> str:
    return next(iter(types), "")


async def topics(session: Session, args: Any) -> Any:
    found = _topics(session)
    return {"topics": list(found), "types": [_first(topic.types) for topic in found.values()]}


async def topics_for_type(session: Session, args: Any) -> Any:
    wanted = normal_type(_text(args, "type"))
    return {"topics": [name for name, topic in _topics(session).items() if wanted in topic.types]}


async def topic_type(session: Session, args: Any) -> Any:
    topic = _topics(session).get(_name(args, "topic"))
    return {"type": _first(topic.types) if topic else ""}


async def topics_and_raw_types(session: Session, args: Any) -> Any:
    found = _topics(session)
    types = [_first(topic.types) for topic in found.values()]
    texts = []
    for type_name in types:
        texts.append(await _definition(session, type_name))
    return {"topics": list(found), "types": types, "typedefs_full_text": texts}


async def _definition(session: Session, type_name: str) -> str:
    if type_name in LOCAL_TOPICS.values():
        return ""
    try:
        await session.channel.definition(type_name)
    except SwitchboardError:
        return ""
    return session.robot.types.definition(type_name)


async def publishers(session: Session, args: Any) -> Any:
    topic = _topics(session).get(_name(args, "topic"))
    return {"publishers": topic.publishers if topic else []}


async def subscribers(session: Session, args: Any) -> Any:
    topic = _topics(session).get(_name(args, "topic"))
    return {"subscribers": topic.subscribers if topic else []}


async def services(session: Session, args: Any) -> Any:
    return {"services": list(_services(session))}


async def services_for_type(session: Session, args: Any) -> Any:
    wanted = normal_type(_text(args, "type"), "srv")
    return {"services": [name for name, service in _services(session).items() if wanted in service.types]}


async def service_type(session: Session, args: Any) -> Any:
    service = _services(session).get(_name(args, "service"))
    return {"type": _first(service.types) if service else ""}


async def service_node(session: Session, args: Any) -> Any:
    service = _services(session).get(_name(args, "service"))
    return {"node": _first(service.providers) if service else ""}


async def service_providers(session: Session, args: Any) -> Any:
    wanted = _text(args, "service")
    # It may be given by its type or by its name, and both may have slashes inside.
    try:
        type_name = normal_type(wanted, "srv")
    except Invalid:
        type_name = ""
    full = _name(args, "service")
    found = [each for name, each in _services(session).items() if name == full or type_name in each.types]
    return {"providers": sorted({node for each in found for node in each.providers})}


async def nodes(session: Session, args: Any) -> Any:
    return {"nodes": sorted(session.robot.graph.nodes)}


async def node_details(session: Session, args: Any) -> Any:
    node = _name(args, "node")
    topics = _topics(session)
    return {
        "subscribing": [name for name, topic in topics.items() if node in topic.subscribers],
        "publishing": [name for name, topic in topics.items() if node in topic.publishers],
        "services": [name for name, each in _services(session).items() if node in each.providers],
    }


async def message_details(session: Session, args: Any) -> Any:
    type_name = normal_type(_text(args, "type"))
    await session.channel.definition(type_name)
    return {"typedefs": session.robot.types.typedefs(type_name)}


async def _service_details(session: Session, args: Any, part: str) -> Any:
    type_name = normal_type(_text(args, "type"), "srv")
    await session.channel.definition(type_name)
    return {"typedefs": session.robot.types.typedefs(f"{type_name}_{part}")}


async def service_request_details(session: Session, args: Any) -> Any:
    return await _service_details(session, args, "Request")


async def service_response_details(session: Session, args: Any) -> Any:
    return await _service_details(session, args, "Response")


async def get_time(session: Session, args: Any) -> Any:
    now = time.time_ns()
    return {"time": {"sec": now // 10**9, "nanosec": now % 10**9}}


async def get_ros_version(session: Session, args: Any) -> Any:
    return {"version": 2, "distro": session.robot.description.distro}


SERVICES: dict[str, Callable[[Session, Any], Any]] = {
    f"/rosapi/{handler.__name__}": handler
    for handler in (
        topics,
        topics_for_type,
        topic_type,
        topics_and_raw_types,
        publishers,
        subscribers,
        services,
        services_for_type,
        service_type,
        service_node,
        service_providers,
        nodes,
        node_details,
        message_details,
        service_request_details,
        service_response_details,
        get_time,
        get_ros_version,
    )
}
