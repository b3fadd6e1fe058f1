"""The ROS 2 platform, for rclpy of Humble and later.

The executor has its own thread (:mod:`~robot_client.platforms.ros2.executor`); everything else runs on the
reactor's thread.
"""

from __future__ import annotations

import os
import platform as machine
import time
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from importlib import metadata
from importlib.util import find_spec
from typing import Any

import rclpy
from twisted.internet.defer import Deferred, fail

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from robot_client.addresses import read_interfaces_again
from robot_client.alerts import OnAlert, ignore_alert
from robot_client.motion.typed_topic import TypedTopic
from robot_client.platforms.base import (
    Check,
    CommandEffect,
    Facts,
    GraphView,
    OnCall,
    OnCancel,
    OnChange,
    OnGoal,
    OnSample,
    Platform,
)
from robot_client.platforms.ros2 import graph
from robot_client.platforms.ros2.device_topic import DeviceTopic
from robot_client.platforms.ros2.errors import refusals
from robot_client.platforms.ros2.executor import ReactorBridge
from robot_client.platforms.ros2.goals import RosGoal, RosGoals
from robot_client.platforms.ros2.health import BATTERY, DIAGNOSTICS, BatteryReader, Diagnostics
from robot_client.platforms.ros2.names import action_type, check_name, service_type, topic_type
from robot_client.platforms.ros2.nodes import Nodes
from robot_client.platforms.ros2.offered_services import (
    RosActionServer,
    RosOfferedServices,
    RosServiceServer,
)
from robot_client.platforms.ros2.service_calls import RosServiceCalls
from robot_client.platforms.ros2.topics import (
    LatchedStamps,
    LingeringPublishers,
    PublisherOptions,
    RosPublisher,
    RosSubscription,
)
from robot_client.platforms.ros2.transport import on_this_machine
from robot_client.platforms.ros2.types import Types
from robot_client.ros_log import ensure_log_folder

REFRESH_ALL_EVERY = 3
"""Reads of the graph after which all subscriptions and publishers are refreshed."""

CLOSE_SECONDS = 0.3
"""Seconds in which the last messages must arrive when the daemon stops; a stop is among them."""

_DISTROS = {3: "humble", 4: "iron", 7: "jazzy", 9: "kilted"}
"""By the major version of rclpy."""


class Ros2Platform(Platform):
    """One node in the robot's ROS 2 graph.

    :param reactor: for timers, and for calls from the executor's thread
    :param name: of the node
    :param guard: prefix of the names of guards' nodes, which are left out of the graph like our own
    :param executor: ``events`` or ``single``
    :param battery: whether to read the first battery topic
    :param diagnostics: whether to raise alerts from ``/diagnostics``
    :param sim_time: whether the node's clock follows ``/clock``; only stamps use it
    """

    encoding = "cdr"
    _calls: RosServiceCalls
    _goals: RosGoals
    _offered: RosOfferedServices
    _lingering: LingeringPublishers

    def __init__(
        self,
        reactor: Any,
        name: str,
        guard: str = "",
        executor: str = "events",
        battery: bool = True,
        sim_time: bool = False,
        diagnostics: bool = True,
    ) -> None:
        self.on_alert: OnAlert = ignore_alert
        self._reactor = reactor
        self._name = name
        self._guard = guard
        self._sim_time = sim_time
        self._own = tuple("/" + each for each in (name, guard) if each)
        self._types = Types()
        self._bridge = ReactorBridge(reactor.callFromThread)
        self._nodes = Nodes(name, executor, sim_time)
        self._renewals = 0
        self._namesakes = graph.Namesakes()
        self._subscriptions: list[RosSubscription] = []
        self._stamps = LatchedStamps()
        self._publishers: list[RosPublisher] = []
        self._last_topics: Mapping[str, link.Topic] = {}
        self._graph_reads = 0
        self._battery = BatteryReader(self._types, self._subscribe_battery, self._alert) if battery else None
        self._diagnostics = (
            Diagnostics(self._types, self._subscribe_diagnostics, self._alert, reactor.seconds)
            if diagnostics
            else None
        )
        self._node: Any = None
        self._device_topic: DeviceTopic | None = None
        self._device_state: link.DeviceReport | None = None

    @property
    def dropped(self) -> int:
        """Samples that were dropped because the reactor was too slow."""
        return self._bridge.dropped

    def start(self) -> None:
        """Join the graph."""
        ensure_log_folder()
        self._nodes.start()
        self._node = self._nodes.main.node
        self._lingering = LingeringPublishers(self._node, self._reactor)
        self._calls = RosServiceCalls(self._node, self._bridge, self._types, self._reactor)
        self._goals = RosGoals(self._nodes.for_actions, self._bridge, self._types, self._reactor)
        self._offered = RosOfferedServices(self._nodes, self._bridge, self._types, self._reactor)
        self._bridge.open(self._reactor)
        self._nodes.main.start()

    def stop(self) -> None:
        """Leave the graph."""
        if self._node is None:
            return
        self._calls.close()
        self._device_topic = None
        for subscription in list(self._subscriptions):
            subscription.close()
        for publisher in list(self._publishers):
            publisher.close()
        had_actions = self._offered.close()
        if self._goals.close() or had_actions:
            time.sleep(CLOSE_SECONDS)  # the executor's thread sends cancels and aborts, without confirmation
        self._goals.destroy()
        self._offered.destroy()
        self._nodes.stop()
        self._bridge.close()
        self._lingering.destroy_all(CLOSE_SECONDS)
        self._nodes.destroy()
        self._node = None

    def depends_on_addresses(self) -> bool:
        return not on_this_machine(os.environ)

    def renew(self) -> None:
        prepared = self._calls.prepared
        self.stop()
        read_interfaces_again()
        # DDS discovery remembers a dead node for a while; a node of the same name would be mistaken for it.
        self._renewals += 1
        self._name = f"{self._own[0].removeprefix('/')}_{self._renewals}"
        self._nodes = Nodes(self._name, self._nodes.kind, self._sim_time)
        self.start()
        for service, type in prepared:
            self.prepare_call(service, type)
        for reader in (self._battery, self._diagnostics):
            if reader is not None:
                reader.subscribe_again()
        if self._device_state is not None:
            self.publish_device(self._device_state)

    def facts(self) -> Facts:
        return Facts(
            platform="ros2",
            distro=os.environ.get("ROS_DISTRO", "") or _distro(),
            extra={
                "rmw": rclpy.get_rmw_implementation_identifier(),
                "domain": os.environ.get("ROS_DOMAIN_ID", "0"),
                "python": machine.python_version(),
            },
            sim_time=self._sim_time,
        )

    def graph(self) -> GraphView:
        """Read the graph; subscriptions and publishers adapt to its changes."""
        view = graph.read(self._node, self._own, self._namesakes)
        self._refresh(view)
        self._calls.remove_idle()
        self._goals.remove_idle()
        if self._battery is not None:
            self._battery.update(view)
        if self._diagnostics is not None:
            self._diagnostics.update(view)
        return view

    def endpoints(self, name: str, kind: str) -> frozenset[bytes]:
        full = self.full_name(name, kind)
        find = self._calls.servers if kind == "service" else self._node.get_publishers_info_by_topic
        # An endpoint whose node is unknown may be our own.
        return graph.endpoint_ids(
            each for each in self._of_others(find(full)) if each.node_name != graph.UNKNOWN
        )

    def _refresh(self, view: GraphView) -> None:
        """Refresh subscriptions and publishers whose counterparts changed, and all of them sometimes, since
        a node may change its quality of service. Each refresh costs more than reading the whole graph.
        """
        before, self._last_topics = self._last_topics, view.topics
        self._graph_reads += 1
        refresh_all = self._graph_reads % REFRESH_ALL_EVERY == 0
        for subscription in list(self._subscriptions):
            now, then = view.topics.get(subscription.topic), before.get(subscription.topic)
            if refresh_all or now is None or then is None or now.publishers != then.publishers:
                subscription.refresh()
        for publisher in list(self._publishers):
            now, then = view.topics.get(publisher.topic), before.get(publisher.topic)
            if refresh_all or now is None or then is None or now.subscribers != then.subscribers:
                publisher.refresh()

    def subscribe(
        self, topic: str, type: str, qos: link.QoS | None, on_sample: OnSample, on_change: OnChange
    ) -> RosSubscription:
        topic, full = self.resolve(topic, type)
        with refusals(f"the subscription of {topic} as {full}"):
            subscription = RosSubscription(
                self._node,
                self._bridge,
                self._types,
                topic,
                full,
                qos,
                on_sample,
                on_change,
                self._subscriptions.remove,
                self._reactor,
                self._stamps,
                self._guard,
            )
        self._subscriptions.append(subscription)
        return subscription

    def after_samples(self, call: Callable[[], None]) -> None:
        """Call at the end of the current batch from the executor's thread."""
        self._bridge.after(call)

    def resolve(self, topic: str, type: str) -> TypedTopic:
        """See :meth:`robot_client.platforms.base.Platform.resolve`. The type is that of other nodes, else
        the requested one."""
        full = check_name(self._node.resolve_topic_name, topic, "topic")
        theirs, ours = set(), set()
        for each in (
            *self._node.get_publishers_info_by_topic(full),
            *self._node.get_subscriptions_info_by_topic(full),
        ):
            node = graph.full_name(each.node_name, each.node_namespace)
            if not node.startswith(self._own):
                theirs.add(each.topic_type)
            elif each.node_name == self._name:
                ours.add(each.topic_type)
        # A client's publisher with a wrong type, and the guard's for it, must not decide the type.
        types = theirs or (set() if type else ours)
        return TypedTopic(full, topic_type(full, type, sorted(types)))

    def full_name(self, name: str, kind: str) -> str:
        service = kind == "service"
        resolve = self._node.resolve_service_name if service else self._node.resolve_topic_name
        return check_name(resolve, name, kind)

    def advertise(
        self,
        topic: str,
        type: str,
        latch: bool,
        qos: link.QoS | None,
        queue_size: int = 0,
        on_change: OnChange = lambda: None,
    ) -> RosPublisher:
        topic, full = self.resolve(topic, type)
        message_class = self._types.message(full)
        self._lingering.destroy_other_types(topic, message_class)
        with refusals(f"to publish {topic} as {full}"):
            publisher = RosPublisher(
                self._node,
                self._reactor,
                message_class,
                topic,
                PublisherOptions(latch, qos, queue_size),
                partial(self._other_subscriptions, topic),
                on_change,
                self._publishers_unused,
            )
        self._publishers.append(publisher)
        return publisher

    def _other_subscriptions(self, topic: str) -> list[Any]:
        """Subscriptions of other nodes to a topic; ours adapt to the publishers."""
        return self._of_others(self._node.get_subscriptions_info_by_topic(topic))

    def _of_others(self, endpoints: Iterable[Any]) -> list[Any]:
        return [
            each
            for each in endpoints
            if not graph.full_name(each.node_name, each.node_namespace).startswith(self._own)
        ]

    def _publishers_unused(self, publisher: RosPublisher, unused: list[Any]) -> None:
        if publisher.closed:
            self._publishers.remove(publisher)
        for each in unused:
            self._lingering.add(each)

    def call(
        self, service: str, type: str, request: bytes, timeout: float, check: Check | None = None
    ) -> Deferred[bytes]:
        try:
            check_name(self._node.resolve_service_name, service, "service")
            known = self._node.get_service_names_and_types()
            full = type if self._calls.is_prepared(service, type) else service_type(service, type, known)
            return self._calls.call(service, full, request, timeout, check)
        except SwitchboardError as error:
            return fail(error)

    def prepare_call(self, service: str, type: str) -> None:
        check_name(self._node.resolve_service_name, service, "service")
        self._calls.prepare(service, type)

    def advertise_service(self, service: str, type: str, on_call: OnCall) -> RosServiceServer:
        return self._offered.advertise_service(service, type, on_call)

    def advertise_action(
        self, action: str, type: str, on_goal: OnGoal, on_cancel: OnCancel
    ) -> RosActionServer:
        return self._offered.advertise_action(action, type, on_goal, on_cancel)

    def send_goal(self, action: str, type: str, goal: bytes, on_feedback: OnSample | None) -> RosGoal:
        full = check_name(self._node.resolve_topic_name, action, "action")
        name = action_type(full, type, self._node.get_service_names_and_types())
        return self._goals.send_goal(full, name, goal, on_feedback)

    def definition(self, type: str) -> link.TypeDefinition:
        return self._types.definition(type)

    def interfaces(self) -> list[str]:
        return self._types.names()

    def classify_command(self, type: str, body: bytes) -> CommandEffect:
        return self._types.classify_command(type, body)

    def zero_template(self, type: str, body: bytes) -> bytes:
        return self._types.zero_template(type, body)

    def zero_command(self, type: str, template: bytes = b"") -> bytes:
        return self._types.zero_command(type, self._node.get_clock().now().to_msg(), template)

    def battery(self) -> float | None:
        return None if self._battery is None else self._battery.charge()

    def publish_device(self, state: link.DeviceReport) -> None:
        self._device_state = state
        if self._node is None or find_spec("diagnostic_msgs") is None:
            return
        if self._device_topic is None:
            self._device_topic = DeviceTopic(self._nodes.for_device())
        self._device_topic.publish(state)

    def fault(self) -> str | None:
        return self._nodes.fault() if self._node is not None else "the daemon has left the ROS graph"

    def _subscribe_diagnostics(self, topic: str, on_sample: OnSample) -> RosSubscription:
        return self.subscribe(topic, DIAGNOSTICS, link.QoS(depth=50), on_sample, lambda: None)

    def _alert(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        self.on_alert(level, text, kind, about, over)

    def _subscribe_battery(self, topic: str, on_sample: OnSample) -> RosSubscription:
        return self.subscribe(topic, BATTERY, link.QoS(depth=1), on_sample, lambda: None)


def _distro() -> str:
    """The distribution, for installations that do not set ``ROS_DISTRO``; empty if unknown."""
    for name in ("ros-rclpy", "rclpy"):
        try:
            return _DISTROS.get(int(metadata.version(name).split(".")[0]), "")
        except (metadata.PackageNotFoundError, ValueError):
            continue
    return ""
