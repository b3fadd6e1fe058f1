"""``/rosapi/…``: the services of rosapi, answered from the mirror of the graph."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Coroutine, Iterable
from typing import Any

from relay_protocol.errors import Invalid, NotFound, SwitchboardError
from relay_protocol.limits import MIB
from relay_protocol.ros_types import TypeRegistry
from relay_server.channels.names import normal_type
from relay_server.common.concurrency import PerKeySemaphore, gather_per_key
from relay_server.relay_node import interfaces as catalogue
from relay_server.relay_node import params
from relay_server.relay_node.arguments import name, text
from relay_server.relay_node.visible_graph import VisibleGraph, node_details_of, visible_graph
from relay_server.sessions.context import ClientContext

RAW_CHARACTERS = 4 * MIB
"""Most characters of definitions in one answer, which take 40 ms; what is beyond is left out, with a remark instead."""

SURVEYS = 16
"""Questions of one user for all types that may wait for the robot."""

_surveys = PerKeySemaphore(
    SURVEYS, f"{SURVEYS} questions of yours for the types of all topics wait already; try again in a moment"
)

_CONTAINED = re.compile(r"\nMSG: (\w+)/msg/(\w+)[ \t\r]*$", re.MULTILINE)
"""It begins with what is rare and never at the start: so it is found ten times as fast."""


async def known(client: ClientContext, type_name: str, own_text: bool = False) -> TypeRegistry:
    """Where the definition of a type is, once it is there.

    :param own_text: its own text is wanted; else one that contains it will do
    :raises NotFound: the robot does not have it
    :raises Invalid: the robot's definition is unusable
    :raises Unavailable: the robot is offline
    """
    if type_name.startswith(catalogue.PACKAGES) and catalogue.TYPES.knows(type_name):
        return catalogue.TYPES
    await client.channel.requests.definition(type_name, own_text)
    return client.robot.types


def _type(args: Any, kind: str) -> str:
    """The argument ``type``, in full.

    :raises Invalid: it is left out, no type name, or a type of another kind
    """
    type_name = normal_type(text(args, "type"), kind)
    if not type_name:
        raise Invalid("give 'type', a string")
    return type_name


async def message_details(client: ClientContext, args: Any) -> Any:
    """``/rosapi/message_details``: a type the robot does not have gets an empty answer, as in rosapi."""
    type_name = _type(args, "msg")
    try:
        types = await known(client, type_name)
        await client.quota.wait_for_turn()
        with client.quota.counted():
            return {"typedefs": types.typedefs(type_name)}
    except NotFound:
        return {"typedefs": []}


async def _part_details(client: ClientContext, args: Any, kind: str, part: str) -> Any:
    type_name = _type(args, kind)
    types = await known(client, type_name)
    await client.quota.wait_for_turn()
    with client.quota.counted():
        return {"typedefs": types.typedefs(f"{type_name}_{part}")}


async def service_request_details(client: ClientContext, args: Any) -> Any:
    """``/rosapi/service_request_details``"""
    return await _part_details(client, args, "srv", "Request")


async def service_response_details(client: ClientContext, args: Any) -> Any:
    """``/rosapi/service_response_details``"""
    return await _part_details(client, args, "srv", "Response")


async def action_goal_details(client: ClientContext, args: Any) -> Any:
    """``/rosapi/action_goal_details``"""
    return await _part_details(client, args, "action", "Goal")


async def action_result_details(client: ClientContext, args: Any) -> Any:
    """``/rosapi/action_result_details``"""
    return await _part_details(client, args, "action", "Result")


async def action_feedback_details(client: ClientContext, args: Any) -> Any:
    """``/rosapi/action_feedback_details``"""
    return await _part_details(client, args, "action", "Feedback")


async def topics_and_raw_types(client: ClientContext, args: Any) -> Any:
    """``/rosapi/topics_and_raw_types``: one type that is not to be had spoils nothing."""
    found = visible_graph(client).topics
    types = [next(iter(topic.types), "") for topic in found.values()]
    with _surveys.take(client.quota.user):
        texts = await _texts(client, types)
    await client.quota.wait_for_turn()
    with client.quota.counted():
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


async def _texts(client: ClientContext, types: Iterable[str]) -> dict[str, str]:
    """The full text of each type."""
    texts: dict[str, str] = {}

    async def ask(type_name: str) -> None:
        texts[type_name] = await _full_text(client, type_name)

    await gather_per_key(deque(dict.fromkeys(types)), ask)
    return texts


async def _full_text(client: ClientContext, type_name: str) -> str:
    if not type_name:
        return ""
    try:
        types = await known(client, type_name, own_text=True)
        return types.definition(type_name)
    except SwitchboardError as error:
        return f"# no definition: {error}"


async def interfaces(client: ClientContext, args: Any) -> Any:
    """``/rosapi/interfaces``: all types the robot has; of a robot that does not list them, those in its graph."""
    if "cdr" in client.robot.encodings:
        names: Iterable[str] = await client.channel.requests.interfaces()
        await client.quota.wait_for_turn()
    else:
        names = _in_graph(visible_graph(client))
    with client.quota.counted():
        return {"interfaces": sorted({*names, *catalogue.TYPE_NAMES})}


def _in_graph(visible: VisibleGraph) -> Iterable[str]:
    for things in (visible.topics, visible.services, visible.actions):
        for each in things.values():
            yield from each.types


def _first(types: Iterable[str]) -> str:
    return next(iter(types), "")


async def topics(client: ClientContext, args: Any) -> Any:
    """``/rosapi/topics``"""
    found = visible_graph(client).topics
    return {"topics": list(found), "types": [_first(topic.types) for topic in found.values()]}


async def topics_for_type(client: ClientContext, args: Any) -> Any:
    """``/rosapi/topics_for_type``"""
    wanted = normal_type(text(args, "type"))
    return {"topics": [each for each, topic in visible_graph(client).topics.items() if wanted in topic.types]}


async def topic_type(client: ClientContext, args: Any) -> Any:
    """``/rosapi/topic_type``"""
    topic = visible_graph(client).topic(name(args, "topic"))
    return {"type": _first(topic.types) if topic else ""}


async def publishers(client: ClientContext, args: Any) -> Any:
    """``/rosapi/publishers``"""
    topic = visible_graph(client).topic(name(args, "topic"))
    return {"publishers": topic.publishers if topic else []}


async def subscribers(client: ClientContext, args: Any) -> Any:
    """``/rosapi/subscribers``"""
    topic = visible_graph(client).topic(name(args, "topic"))
    return {"subscribers": topic.subscribers if topic else []}


async def services(client: ClientContext, args: Any) -> Any:
    """``/rosapi/services``"""
    return {"services": list(visible_graph(client).services)}


async def services_for_type(client: ClientContext, args: Any) -> Any:
    """``/rosapi/services_for_type``"""
    wanted = normal_type(text(args, "type"), "srv")
    return {
        "services": [
            each for each, service in visible_graph(client).services.items() if wanted in service.types
        ]
    }


async def service_type(client: ClientContext, args: Any) -> Any:
    """``/rosapi/service_type``"""
    service = visible_graph(client).services.get(name(args, "service"))
    return {"type": _first(service.types) if service else ""}


async def service_node(client: ClientContext, args: Any) -> Any:
    """``/rosapi/service_node``"""
    service = visible_graph(client).services.get(name(args, "service"))
    return {"node": _first(service.providers) if service else ""}


async def service_providers(client: ClientContext, args: Any) -> Any:
    """``/rosapi/service_providers``: by the service's type, which is how rosapi means it, or by its name."""
    wanted, full = text(args, "service"), name(args, "service")
    try:
        type_name = normal_type(wanted, "srv")
    except Invalid:
        type_name = ""
    found = [
        each
        for known, each in visible_graph(client).services.items()
        if known == full or type_name in each.types
    ]
    return {"providers": sorted({node for each in found for node in each.providers})}


async def nodes(client: ClientContext, args: Any) -> Any:
    """``/rosapi/nodes``"""
    return {"nodes": visible_graph(client).nodes}


async def node_details(client: ClientContext, args: Any) -> Any:
    """``/rosapi/node_details``"""
    node = name(args, "node")
    work = node_details_of([node], visible_graph(client))[node]
    return {"subscribing": work.subscribes, "publishing": work.publishes, "services": work.services}


async def action_servers(client: ClientContext, args: Any) -> Any:
    """``/rosapi/action_servers``"""
    return {"action_servers": list(visible_graph(client).actions)}


async def action_type(client: ClientContext, args: Any) -> Any:
    """``/rosapi/action_type``"""
    action = visible_graph(client).actions.get(name(args, "action"))
    return {"type": _first(action.types) if action else ""}


async def get_time(client: ClientContext, args: Any) -> Any:
    """``/rosapi/get_time``: the robot's simulated time where it has one, else the relay's wall clock."""
    sec, nanosec = divmod(client.channel.now_ns(), 10**9)
    # roslibpy reads the names of ROS 1.
    return {"time": {"sec": sec, "nanosec": nanosec, "secs": sec, "nsecs": nanosec}}


async def get_ros_version(client: ClientContext, args: Any) -> Any:
    """``/rosapi/get_ros_version``"""
    return {"version": 2, "distro": client.robot.description.distro}


SERVICES: dict[str, Callable[[ClientContext, Any], Coroutine[Any, Any, Any]]] = {
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
        action_feedback_details,
        action_goal_details,
        action_result_details,
        interfaces,
        message_details,
        service_request_details,
        service_response_details,
        topics_and_raw_types,
    )
}
