"""``/rosapi/…``: what answers each service. Fields and manners are those of rosapi for ROS 2 (rosbridge_suite).

A topic, service or action the caller may not use is absent from every answer. Names are taken with and without their
leading slash, types as ``pkg/Name`` and ``pkg/msg/Name``.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from relay_server.local import graph, params, time, types
from relay_server.session import Session

SERVICES: dict[str, Callable[[Session, Any], Awaitable[Any]]] = {
    f"/rosapi/{handler.__name__}": handler
    for handler in (
        graph.action_servers,
        graph.action_type,
        graph.node_details,
        graph.nodes,
        graph.publishers,
        graph.service_node,
        graph.service_providers,
        graph.service_type,
        graph.services,
        graph.services_for_type,
        graph.subscribers,
        graph.topic_type,
        graph.topics,
        graph.topics_for_type,
        params.delete_param,
        params.get_param,
        params.get_param_names,
        params.has_param,
        params.set_param,
        time.get_ros_version,
        time.get_time,
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
