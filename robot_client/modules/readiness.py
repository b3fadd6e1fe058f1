"""Whether a module is ready, by the robot's ROS graph: a topic, a service, or the state of a lifecycle node."""

from __future__ import annotations

from typing import Protocol

from twisted.internet.defer import Deferred

from relay_protocol.errors import SwitchboardError
from robot_client.modules.settings import ModuleSettings
from robot_client.platforms.base import Check, GraphView

GET_STATE = "lifecycle_msgs/srv/GetState"
"""Type of the service ``NODE/get_state`` of a lifecycle node."""

ACTIVE = 3
"""``PRIMARY_STATE_ACTIVE`` of lifecycle_msgs/msg/State."""

STATE_SECONDS = 2.0
"""Seconds a lifecycle node may take to answer with its state."""

_EMPTY_REQUEST = b"\0\1\0\0\0"
"""A request of :data:`GET_STATE`, which has no fields, as CDR."""

_STATE_ID = 4
"""Offset of the state's id in the response."""


class RobotGraph(Protocol):
    """The parts of :class:`robot_client.platforms.base.Platform` that are needed here."""

    def graph(self) -> GraphView:
        """The graph now."""

    def endpoints(self, name: str, kind: str) -> frozenset[bytes]:
        """Ids of the publishers of a topic or the servers of a service."""

    def call(
        self, service: str, type: str, request: bytes, timeout: float, check: Check | None = None
    ) -> Deferred[bytes]:
        """Call a service once."""


def ready_endpoints(settings: ModuleSettings, graph: RobotGraph) -> frozenset[bytes]:
    """Ids of the publishers of ``ready_topic`` or the servers of ``ready_service``; none without these settings."""
    try:
        if settings.ready_topic:
            return graph.endpoints(settings.ready_topic, "topic")
        if settings.ready_service:
            return graph.endpoints(settings.ready_service, "service")
    except SwitchboardError:
        pass  # not a valid name, so nothing can have it
    return frozenset()


def check_ready(settings: ModuleSettings, graph: RobotGraph, before: frozenset[bytes]) -> Deferred[bool]:
    """Whether what the settings name is there now; false as well if that can't be found out.

    :param before: the :func:`ready_endpoints` when the run began. They don't count: the middleware lists those of
        a killed process for a while.
    """
    return Deferred.fromCoroutine(_is_ready(settings, graph, before)).addErrback(lambda _: False)


async def _is_ready(settings: ModuleSettings, graph: RobotGraph, before: frozenset[bytes]) -> bool:
    if settings.ready_lifecycle:
        return await _is_active(settings.ready_lifecycle, graph)
    return bool(ready_endpoints(settings, graph) - before)


async def _is_active(node: str, graph: RobotGraph) -> bool:
    service = f"{node}/get_state"
    known = graph.graph().services.get(service)
    if known is None or GET_STATE not in known.types:
        return False
    response = await graph.call(service, GET_STATE, _EMPTY_REQUEST, STATE_SECONDS)
    return response[_STATE_ID : _STATE_ID + 1] == bytes([ACTIVE])
