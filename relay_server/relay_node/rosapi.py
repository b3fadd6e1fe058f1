"""``/rosapi/…``: what answers each service. Fields and manners are those of rosapi for ROS 2 (rosbridge_suite).

A topic, service or action the caller may not use is absent from every answer. Names are taken with and without their
leading slash, types as ``pkg/Name`` and ``pkg/msg/Name``.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable
from typing import Any

from relay_protocol.errors import Invalid
from relay_server.relay_node import params, types
from relay_server.relay_node.arguments import name, text
from relay_server.relay_node.view import node_details_of, view
from relay_server.sessions.session import Session
from relay_server.sessions.type_names import normal_type


def _first(types: Iterable[str]) -> str:
    return next(iter(types), "")


async def topics(session: Session, args: Any) -> Any:
    """``/rosapi/topics``"""
    found = view(session).topics
    return {"topics": list(found), "types": [_first(topic.types) for topic in found.values()]}


async def topics_for_type(session: Session, args: Any) -> Any:
    """``/rosapi/topics_for_type``"""
    wanted = normal_type(text(args, "type"))
    return {"topics": [each for each, topic in view(session).topics.items() if wanted in topic.types]}


async def topic_type(session: Session, args: Any) -> Any:
    """``/rosapi/topic_type``"""
    topic = view(session).topic(name(args, "topic"))
    return {"type": _first(topic.types) if topic else ""}


async def publishers(session: Session, args: Any) -> Any:
    """``/rosapi/publishers``"""
    topic = view(session).topic(name(args, "topic"))
    return {"publishers": topic.publishers if topic else []}


async def subscribers(session: Session, args: Any) -> Any:
    """``/rosapi/subscribers``"""
    topic = view(session).topic(name(args, "topic"))
    return {"subscribers": topic.subscribers if topic else []}


async def services(session: Session, args: Any) -> Any:
    """``/rosapi/services``"""
    return {"services": list(view(session).services)}


async def services_for_type(session: Session, args: Any) -> Any:
    """``/rosapi/services_for_type``"""
    wanted = normal_type(text(args, "type"), "srv")
    return {"services": [each for each, service in view(session).services.items() if wanted in service.types]}


async def service_type(session: Session, args: Any) -> Any:
    """``/rosapi/service_type``"""
    service = view(session).services.get(name(args, "service"))
    return {"type": _first(service.types) if service else ""}


async def service_node(session: Session, args: Any) -> Any:
    """``/rosapi/service_node``"""
    service = view(session).services.get(name(args, "service"))
    return {"node": _first(service.providers) if service else ""}


async def service_providers(session: Session, args: Any) -> Any:
    """``/rosapi/service_providers``: by the service's type, which is how rosapi means it, or by its name."""
    wanted, full = text(args, "service"), name(args, "service")
    try:
        type_name = normal_type(wanted, "srv")
    except Invalid:
        type_name = ""
    found = [
        each for known, each in view(session).services.items() if known == full or type_name in each.types
    ]
    return {"providers": sorted({node for each in found for node in each.providers})}


async def nodes(session: Session, args: Any) -> Any:
    """``/rosapi/nodes``"""
    return {"nodes": view(session).nodes}


async def node_details(session: Session, args: Any) -> Any:
    """``/rosapi/node_details``"""
    node = name(args, "node")
    work = node_details_of([node], view(session))[node]
    return {"subscribing": work.subscribes, "publishing": work.publishes, "services": work.services}


async def action_servers(session: Session, args: Any) -> Any:
    """``/rosapi/action_servers``"""
    return {"action_servers": list(view(session).actions)}


async def action_type(session: Session, args: Any) -> Any:
    """``/rosapi/action_type``"""
    action = view(session).actions.get(name(args, "action"))
    return {"type": _first(action.types) if action else ""}


async def get_time(session: Session, args: Any) -> Any:
    """``/rosapi/get_time``: the robot's simulated time where it has one, else the relay's wall clock."""
    sec, nanosec = divmod(session.channel.now_ns(), 10**9)
    # roslibpy reads the names of ROS 1.
    return {"time": {"sec": sec, "nanosec": nanosec, "secs": sec, "nsecs": nanosec}}


async def get_ros_version(session: Session, args: Any) -> Any:
    """``/rosapi/get_ros_version``"""
    return {"version": 2, "distro": session.robot.description.distro}


SERVICES: dict[str, Callable[[Session, Any], Awaitable[Any]]] = {
    f"/rosapi/{handler.__name__}": handler
    for handler in (
        action_servers,
        action_type,
        node_details,
        nodes,
        publishers,
        service_node,
        service_providers,
        service_type,
        services,
        services_for_type,
        subscribers,
        topic_type,
        topics,
        topics_for_type,
        params.delete_param,
        params.get_param,
        params.get_param_names,
        params.has_param,
        params.set_param,
        get_ros_version,
        get_time,
        types.action_feedback_details,
        types.action_goal_details,
        types.action_result_details,
        types.interfaces,
        types.message_details,
        types.service_request_details,
        types.service_response_details,
        types.topics_and_raw_types,
    )
}
