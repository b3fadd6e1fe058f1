"""What clients of the relay offer to the robot's ROS 2 graph."""

from __future__ import annotations

from relay_protocol.errors import Invalid
from robot_client.platforms.base import OnCall, OnCancel, OnGoal
from robot_client.platforms.definitions import normalise
from robot_client.platforms.ros2 import graph
from robot_client.platforms.ros2.actions import RosAction
from robot_client.platforms.ros2.errors import refusals
from robot_client.platforms.ros2.executor import ReactorBridge
from robot_client.platforms.ros2.names import check_name
from robot_client.platforms.ros2.nodes import Nodes
from robot_client.platforms.ros2.services import RosService
from robot_client.platforms.ros2.types import Interface, Types
from robot_client.twisted_types import ReactorClock


class RosAdvertisements:
    """The services and actions there are, none of which another node has.

    :param clock: for timers
    """

    def __init__(self, nodes: Nodes, hop: ReactorBridge, types: Types, clock: ReactorClock) -> None:
        self._nodes = nodes
        self._node = nodes.main.node
        self._hop = hop
        self._types = types
        self._clock = clock
        self._services: dict[str, RosService] = {}
        self._actions: dict[str, RosAction] = {}

    def serve(self, service: str, type: str, on_call: OnCall) -> RosService:
        """Offer a service; see :meth:`robot_client.platforms.base.Platform.serve`."""
        full = check_name(self._node.resolve_service_name, service, "service")
        self._check_free(f"service {service}", full, full in self._services)
        name = normalise(type, "srv")
        interface = Interface(full, name, self._types.service(name))
        with refusals(f"the service {service} as {name}"):
            offer = RosService(self._nodes.main, self._hop, interface, on_call, self._withdrawn)
        self._services[full] = offer
        return offer

    def act(self, action: str, type: str, on_goal: OnGoal, on_cancel: OnCancel) -> RosAction:
        """Offer an action; see :meth:`robot_client.platforms.base.Platform.act`."""
        full = check_name(self._node.resolve_topic_name, action, "action")
        former = self._actions.get(full)
        self._check_free(f"action {action}", full + graph.GOAL, former is not None and not former.closed)
        name = normalise(type, "action")
        interface = Interface(full, name, self._types.action(name))
        if former is not None:
            former.go()
        spinner = self._nodes.for_actions()
        with refusals(f"the action {action} as {name}"):
            offer = RosAction(spinner, self._hop, self._clock, interface, on_goal, on_cancel, self._gone)
        self._actions[full] = offer
        return offer

    def close(self) -> bool:
        """Offer nothing more; whether there are actions, whose aborts are on their way."""
        for service in list(self._services.values()):
            service.close()
        for action in self._actions.values():
            action.close()
        return bool(self._actions)

    def leave(self) -> None:
        """Take the actions away."""
        for action in list(self._actions.values()):
            action.go()

    def _check_free(self, what: str, service: str, ours: bool) -> None:
        if ours:
            raise Invalid(f"somebody at the relay offers the {what} already")
        other = graph.provider(self._node, service, self._nodes.names)
        if other is not None:
            raise Invalid(f"the robot has the {what} already: {other} offers it")

    def _withdrawn(self, service: RosService) -> None:
        del self._services[service.name]

    def _gone(self, action: RosAction) -> None:
        if self._actions.get(action.name) is action:
            del self._actions[action.name]
