"""ROS 2 as a platform, with whatever rclpy the robot has (Humble and later).

The executor turns in a thread of its own (:mod:`~robot_client.platforms.ros2.executor`); everything else
runs on the reactor's thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from twisted.internet.defer import Deferred, fail

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from robot_client.alerts import OnAlert, nobody
from robot_client.motion.typed_topic import TypedTopic
from robot_client.platforms.base import (
    Check,
    Facts,
    GraphView,
    Motion,
    OnCall,
    OnCancel,
    OnChange,
    OnGoal,
    OnSample,
    Platform,
)
from robot_client.platforms.ros2 import facts, graph
from robot_client.platforms.ros2.actions import RosAction
from robot_client.platforms.ros2.advertisements import RosAdvertisements
from robot_client.platforms.ros2.battery import BATTERY, BatteryReader
from robot_client.platforms.ros2.diagnostics import DIAGNOSTICS, Diagnostics
from robot_client.platforms.ros2.errors import refusals
from robot_client.platforms.ros2.executor import ReactorBridge
from robot_client.platforms.ros2.goals import RosGoal, RosGoals
from robot_client.platforms.ros2.names import action_type, check_name, service_type, topic_type
from robot_client.platforms.ros2.nodes import Nodes
from robot_client.platforms.ros2.service_calls import RosServiceCalls
from robot_client.platforms.ros2.services import RosService
from robot_client.platforms.ros2.topics import Lingering, Offered, RosSink, RosSource, Stamps
from robot_client.platforms.ros2.types import Types
from robot_client.ros_log import ensure_log_folder

LOOK_EVERY = 3
"""Looks at the graph from one time all subscriptions look at what their publishers offer to the next."""

FAREWELL = 0.3
"""Seconds the last messages have to arrive when the daemon leaves; a stop is among them."""


class Ros2Platform(Platform):
    """One node in the robot's ROS 2 graph.

    :param reactor: for timers, and for the way back from the executor's thread
    :param name: of the node
    :param guard: how the names of guards' nodes begin; they are left out of the graph like our own
    :param executor: ``events`` or ``single``
    :param battery: whether to listen to the first battery topic there is
    :param diagnostics: whether to tell what ``/diagnostics`` says is wrong
    :param sim_time: whether the node's clock follows ``/clock``; nothing but stamps goes by it
    """

    encoding = "cdr"
    _calls: RosServiceCalls
    _goals: RosGoals
    _offers: RosAdvertisements
    _lingering: Lingering

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
        self.on_alert: OnAlert = nobody
        self._reactor = reactor
        self._name = name
        self._guard = guard
        self._sim_time = sim_time
        self._own = tuple("/" + each for each in (name, guard) if each)
        self._types = Types()
        self._hop = ReactorBridge(reactor.callFromThread)
        self._nodes = Nodes(name, executor, sim_time)
        self._sources: list[RosSource] = []
        self._stamps = Stamps()
        self._sinks: list[RosSink] = []
        self._seen: Mapping[str, link.Topic] = {}
        self._looks = 0
        self._battery = BatteryReader(self._types, self._gauge) if battery else None
        self._diagnostics = (
            Diagnostics(self._types, self._listen, self._tell, reactor.seconds) if diagnostics else None
        )
        self._node: Any = None

    @property
    def dropped(self) -> int:
        """Samples that the reactor was too slow for."""
        return self._hop.dropped

    def start(self) -> None:
        """Enter the graph."""
        ensure_log_folder()
        self._nodes.enter()
        self._node = self._nodes.main.node
        self._lingering = Lingering(self._node, self._reactor)
        self._calls = RosServiceCalls(self._node, self._hop, self._types, self._reactor)
        self._goals = RosGoals(self._nodes.for_actions, self._hop, self._types, self._reactor)
        self._offers = RosAdvertisements(self._nodes, self._hop, self._types, self._reactor)
        self._hop.open(self._reactor)
        self._nodes.main.start()

    def stop(self) -> None:
        """Leave the graph."""
        if self._node is None:
            return
        self._calls.close()
        for source in list(self._sources):
            source.close()
        for sink in list(self._sinks):
            sink.close()
        offered = self._offers.close()
        if self._goals.close() or offered:
            time.sleep(FAREWELL)  # cancels and aborts leave by the executor's thread, unconfirmed
        self._goals.leave()
        self._offers.leave()
        self._nodes.stop()
        self._hop.close()
        self._lingering.end(FAREWELL)
        self._nodes.leave()
        self._node = None

    def facts(self) -> Facts:
        """ROS 2, its distribution and middleware."""
        return facts.read(self._sim_time)

    def graph(self) -> GraphView:
        """Read the graph; subscriptions follow what changed in it."""
        view = graph.read(self._node, self._own)
        self._follow(view)
        self._calls.sweep()
        self._goals.sweep()
        if self._battery is not None:
            self._battery.look(view)
        if self._diagnostics is not None:
            self._diagnostics.look(view)
        return view

    def _follow(self, view: GraphView) -> None:
        """Have subscriptions look at their publishers, and publishers at their subscribers, which costs more than the
        whole graph: where there are others than before, and all of them now and then, for a node may change its mind.
        """
        before, self._seen = self._seen, view.topics
        self._looks += 1
        every = self._looks % LOOK_EVERY == 0
        for source in list(self._sources):
            now, then = view.topics.get(source.topic), before.get(source.topic)
            if every or now is None or then is None or now.publishers != then.publishers:
                source.refresh()
        for sink in list(self._sinks):
            now, then = view.topics.get(sink.topic), before.get(sink.topic)
            if every or now is None or then is None or now.subscribers != then.subscribers:
                sink.refresh()

    def subscribe(
        self, topic: str, type: str, qos: link.QoS | None, on_sample: OnSample, on_change: OnChange
    ) -> RosSource:
        """Listen to a topic, present or not yet."""
        topic, full = self.resolve(topic, type)
        with refusals(f"the subscription of {topic} as {full}"):
            source = RosSource(
                self._node,
                self._hop,
                self._types,
                topic,
                full,
                qos,
                on_sample,
                on_change,
                self._sources.remove,
                self._reactor,
                self._stamps,
                self._guard,
            )
        self._sources.append(source)
        return source

    def after_samples(self, call: Callable[[], None]) -> None:
        """Call when the batch from the executor's thread is done."""
        self._hop.after(call)

    def resolve(self, topic: str, type: str) -> TypedTopic:
        """Expand the name; the type is what others in the graph use, else what is asked for."""
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
        # What was commanded in vain, and the guard's readiness to stop it, must not decide for the robot's driver.
        types = theirs or (set() if type else ours)
        return TypedTopic(full, topic_type(full, type, sorted(types)))

    def full_name(self, name: str, what: str) -> str:
        """Expand a name."""
        service = what == "service"
        resolve = self._node.resolve_service_name if service else self._node.resolve_topic_name
        return check_name(resolve, name, what)

    def advertise(
        self,
        topic: str,
        type: str,
        latch: bool,
        qos: link.QoS | None,
        queue_size: int = 0,
        on_change: OnChange = lambda: None,
    ) -> RosSink:
        """Make a publisher."""
        topic, full = self.resolve(topic, type)
        kind = self._types.message(full)
        self._lingering.give_way(topic, kind)
        with refusals(f"to publish {topic} as {full}"):
            sink = RosSink(
                self._node,
                self._reactor,
                kind,
                topic,
                Offered(latch, qos, queue_size),
                partial(self._subscriptions, topic),
                on_change,
                self._sunk,
            )
        self._sinks.append(sink)
        return sink

    def _subscriptions(self, topic: str) -> list[Any]:
        """What the graph tells of a topic's subscriptions, but for our own, which follow the publishers."""
        return [
            each
            for each in self._node.get_subscriptions_info_by_topic(topic)
            if not graph.full_name(each.node_name, each.node_namespace).startswith(self._own)
        ]

    def _sunk(self, sink: RosSink, publishers: list[Any]) -> None:
        if sink.closed:
            self._sinks.remove(sink)
        for each in publishers:
            self._lingering.take(each)

    def call(
        self, service: str, type: str, request: bytes, timeout: float, check: Check | None = None
    ) -> Deferred[bytes]:
        """Call a service once."""
        try:
            check_name(self._node.resolve_service_name, service, "service")
            known = self._node.get_service_names_and_types()
            full = type if self._calls.keeps(service, type) else service_type(service, type, known)
            return self._calls.call(service, full, request, timeout, check)
        except SwitchboardError as error:
            return fail(error)

    def prepare_call(self, service: str, type: str) -> None:
        """Make a client, and keep it."""
        check_name(self._node.resolve_service_name, service, "service")
        self._calls.keep(service, type)

    def serve(self, service: str, type: str, on_call: OnCall) -> RosService:
        """Offer a service."""
        return self._offers.serve(service, type, on_call)

    def act(self, action: str, type: str, on_goal: OnGoal, on_cancel: OnCancel) -> RosAction:
        """Offer an action."""
        return self._offers.act(action, type, on_goal, on_cancel)

    def pursue(self, action: str, type: str, goal: bytes, on_feedback: OnSample | None) -> RosGoal:
        """Have an action pursue a goal."""
        full = check_name(self._node.resolve_topic_name, action, "action")
        name = action_type(full, type, self._node.get_service_names_and_types())
        return self._goals.pursue(full, name, goal, on_feedback)

    def definition(self, type: str) -> link.TypeDefinition:
        """The text of a type and all it contains."""
        return self._types.definition(type)

    def interfaces(self) -> list[str]:
        """Names of all types that are installed."""
        return self._types.names()

    def judge(self, type: str, body: bytes) -> Motion:
        """What this command would do."""
        return self._types.judge(type, body)

    def resting(self, type: str, body: bytes) -> bytes:
        """What the zero that follows this command is like."""
        return self._types.resting(type, body)

    def zero(self, type: str, rest: bytes = b"") -> bytes:
        """The message that stands still."""
        return self._types.zero(type, self._node.get_clock().now().to_msg(), rest)

    def battery(self) -> float | None:
        """Charge as the first battery topic tells it."""
        return None if self._battery is None else self._battery.charge()

    def trouble(self) -> str | None:
        """Whether an executor is stuck."""
        return self._nodes.trouble()

    def _listen(self, topic: str, on_sample: OnSample) -> RosSource:
        return self.subscribe(topic, DIAGNOSTICS, link.QoS(depth=50), on_sample, lambda: None)

    def _tell(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        self.on_alert(level, text, kind, about, over)

    def _gauge(self, topic: str, on_sample: OnSample) -> RosSource:
        return self.subscribe(topic, BATTERY, link.QoS(depth=1), on_sample, lambda: None)
