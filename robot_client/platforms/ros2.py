"""ROS 2 as a platform, with whatever rclpy the robot has (Humble and later).

The executor turns in a thread of its own (:mod:`~robot_client.platforms.ros2_executor`); everything else
runs on the reactor's thread.
"""

from __future__ import annotations

import os
import platform as machine
import time
from collections.abc import Callable, Mapping
from importlib import metadata
from typing import Any

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message
from rclpy.signals import SignalHandlerOptions
from twisted.internet.defer import Deferred, fail

try:
    from rclpy.event_handler import PublisherEventCallbacks
except ImportError:  # Humble
    from rclpy.qos_event import PublisherEventCallbacks

from relay_protocol import link
from relay_protocol.errors import Invalid, SwitchboardError, Unavailable
from robot_client.platforms import ros2_graph, ros2_qos
from robot_client.platforms.base import (
    Facts,
    GraphView,
    Motion,
    OnCall,
    OnCancel,
    OnGoal,
    OnSample,
    Platform,
)
from robot_client.platforms.definitions import normalise
from robot_client.platforms.ros2_actions import RosAction
from robot_client.platforms.ros2_calls import Calls
from robot_client.platforms.ros2_errors import in_words
from robot_client.platforms.ros2_executor import Hop, Spinner, make_executor
from robot_client.platforms.ros2_goals import Goals, RosGoal
from robot_client.platforms.ros2_services import RosService
from robot_client.platforms.ros2_topics import (
    Lingering,
    RosSink,
    RosSource,
    action_type,
    check_name,
    service_type,
    topic_type,
)
from robot_client.platforms.ros2_types import Types
from robot_client.ros_log import ensure_log_folder
from robot_client.topics import TypedTopic

BATTERY = "sensor_msgs/msg/BatteryState"
# The executor would hold on to a publisher by its events after its end, and with it to the topic's type.
_NO_EVENTS = PublisherEventCallbacks(use_default_callbacks=False)
LOOK_EVERY = 3
"""Looks at the graph from one time all subscriptions look at what their publishers offer to the next."""

_ACTIONS = "_actions"
"""What the name of the node for actions adds to ours."""

FAREWELL = 0.3
"""Seconds the last messages have to arrive when the daemon leaves; a stop is among them."""


class Ros2Platform(Platform):
    """One node in the robot's ROS 2 graph.

    :param reactor: for timers, and for the way back from the executor's thread
    :param name: of the node
    :param guard: how the names of guards' nodes begin; they are left out of the graph like our own
    :param executor: ``events`` or ``single``
    :param battery: whether to listen to the first battery topic there is
    :param sim_time: whether the node's clock follows ``/clock``; nothing but stamps goes by it
    """

    encoding = "cdr"

    def __init__(
        self,
        reactor: Any,
        name: str,
        guard: str = "",
        executor: str = "events",
        battery: bool = True,
        sim_time: bool = False,
    ) -> None:
        self._reactor = reactor
        self._name = name
        self._guard = guard
        self._kind = executor
        self._want_battery = battery
        self._sim_time = sim_time
        self._own = tuple("/" + each for each in (name, guard) if each)
        self._types = Types()
        self._hop = Hop(reactor.callFromThread)
        self._sources: list[RosSource] = []
        self._sinks: list[RosSink] = []
        self._services: dict[str, RosService] = {}
        self._actions: dict[str, RosAction] = {}
        self._seen: Mapping[str, link.Topic] = {}
        self._looks = 0
        self._battery: RosSource | None = None
        self._battery_sample: bytes | None = None
        self._context: Any = None
        self._node: Any = None
        self._spinner: Any = None
        self._acting: tuple[Any, Spinner] | None = None
        self._calls: Any = None
        self._goals: Any = None
        self._lingering: Any = None

    @property
    def dropped(self) -> int:
        """Samples that the reactor was too slow for."""
        return self._hop.dropped

    def start(self) -> None:
        """Enter the graph."""
        ensure_log_folder()
        self._context = rclpy.Context()
        try:
            rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
            self._node, self._spinner = self._spun(self._name, self._kind)
        except Exception as error:
            raise Unavailable(f"ROS 2 does not start: {error}") from error
        self._lingering = Lingering(self._node, self._reactor)
        self._calls = Calls(self._node, self._hop, self._types, self._reactor)
        self._goals = Goals(self._for_actions, self._hop, self._types, self._reactor)
        self._hop.open(self._reactor)
        self._spinner.start()

    def _spun(self, name: str, executor: str) -> tuple[Any, Spinner]:
        node = rclpy.create_node(
            name,
            context=self._context,
            start_parameter_services=False,
            enable_rosout=False,
            parameter_overrides=[Parameter("use_sim_time", value=self._sim_time)],
        )
        # The node's clock stands still when a simulation pauses.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        return node, Spinner(make_executor(executor, self._context), node, steady)

    def _for_actions(self) -> tuple[Any, Spinner]:
        """The node that actions are on, made when it is first needed, and what turns its executor.

        Action servers and clients are what rclpy calls waitables. When one goes while something for it waits in an
        EventsExecutor, that ends the process (rclpy 7.1): it calls Python without the interpreter's lock.
        """
        if self._kind != "events":
            return self._node, self._spinner
        if self._acting is None:
            self._acting = self._spun(self._name + _ACTIONS, "single")
            self._acting[1].start()
        return self._acting

    def stop(self) -> None:
        """Leave the graph."""
        if self._spinner is None:
            return
        self._calls.close()
        for source in list(self._sources):
            source.close()
        for sink in list(self._sinks):
            sink.close()
        for service in list(self._services.values()):
            service.close()
        for action in self._actions.values():
            action.close()
        if self._goals.close() or self._actions:
            time.sleep(FAREWELL)  # cancels and aborts leave by the executor's thread
        self._goals.leave()
        for action in list(self._actions.values()):
            action.go()
        if self._acting is not None:
            node, spinner = self._acting
            self._acting = None
            spinner.stop()
            node.destroy_node()
        self._spinner.stop()
        self._hop.close()
        self._lingering.end(FAREWELL)
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)
        self._spinner = None

    def facts(self) -> Facts:
        """ROS 2, its distribution and middleware."""
        return Facts(
            "ros2",
            os.environ.get("ROS_DISTRO", "") or _distro(),
            {
                "rmw": rclpy.get_rmw_implementation_identifier(),
                "domain": os.environ.get("ROS_DOMAIN_ID", "0"),
                "python": machine.python_version(),
            },
            self._sim_time,
        )

    def graph(self) -> GraphView:
        """Read the graph; subscriptions follow what changed in it."""
        view = ros2_graph.read(self._node, self._own)
        self._follow(view)
        self._calls.sweep()
        self._goals.sweep()
        if self._want_battery:
            self._find_battery(view)
        return view

    def _follow(self, view: GraphView) -> None:
        """Have subscriptions look at their publishers, which costs more than the whole graph: where others publish than
        before, and all of them now and then, for a node may change its mind.
        """
        before, self._seen = self._seen, view.topics
        self._looks += 1
        every = self._looks % LOOK_EVERY == 0
        for source in list(self._sources):
            now, then = view.topics.get(source.topic), before.get(source.topic)
            if every or now is None or then is None or now.publishers != then.publishers:
                source.refresh()

    def subscribe(
        self,
        topic: str,
        type: str,
        qos: link.QoS | None,
        on_sample: OnSample,
        on_change: Callable[[], None],
    ) -> RosSource:
        """Listen to a topic, present or not yet."""
        topic, full = self.resolve(topic, type)
        try:
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
                self._guard,
            )
        except SwitchboardError:
            raise
        except Exception as error:
            raise Invalid(f"ROS 2 refuses the subscription of {topic} as {full}: {in_words(error)}") from None
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
            node = f"{each.node_namespace.rstrip('/')}/{each.node_name}"
            if not node.startswith(self._own):
                theirs.add(each.topic_type)
            elif each.node_name == self._name:
                ours.add(each.topic_type)
        # What was commanded in vain, and the guard's readiness to stop it, must not decide for the robot's driver.
        types = theirs or (set() if type else ours)
        return TypedTopic(full, topic_type(full, type, sorted(types)))

    def advertise(
        self, topic: str, type: str, latch: bool, qos: link.QoS | None, queue_size: int = 0
    ) -> RosSink:
        """Make a publisher."""
        topic, full = self.resolve(topic, type)
        kind = self._types.message(full)
        self._lingering.give_way(topic, kind)
        listening = self._node.get_subscriptions_info_by_topic(topic)
        profile = ros2_qos.for_publisher([each.qos_profile for each in listening], latch, qos, queue_size)
        try:
            publisher = self._node.create_publisher(kind, topic, profile, event_callbacks=_NO_EVENTS)
        except Exception as error:
            raise Invalid(f"ROS 2 refuses to publish {topic} as {full}: {in_words(error)}") from None
        sink = RosSink(publisher, self._sunk)
        self._sinks.append(sink)
        return sink

    def _sunk(self, sink: RosSink) -> None:
        self._sinks.remove(sink)
        self._lingering.take(sink.publisher)

    def call(self, service: str, type: str, request: bytes, timeout: float) -> Deferred[bytes]:
        """Call a service once."""
        try:
            check_name(self._node.resolve_service_name, service, "service")
            full = service_type(service, type, self._node.get_service_names_and_types())
            call: Deferred[bytes] = self._calls.call(service, full, request, timeout)
        except SwitchboardError as error:
            return fail(error)
        return call

    def serve(self, service: str, type: str, on_call: OnCall) -> RosService:
        """Offer a service."""
        full = check_name(self._node.resolve_service_name, service, "service")
        self._check_free(f"service {service}", full, full in self._services)
        name = normalise(type, "srv")
        kind = self._types.service(name)
        try:
            offer = RosService(
                self._node,
                self._hop,
                self._spinner,
                full,
                name,
                kind,
                on_call,
                self._withdrawn,
            )
        except Exception as error:
            raise Invalid(f"ROS 2 refuses the service {service} as {name}: {in_words(error)}") from None
        self._services[full] = offer
        return offer

    def act(self, action: str, type: str, on_goal: OnGoal, on_cancel: OnCancel) -> RosAction:
        """Offer an action."""
        full = check_name(self._node.resolve_topic_name, action, "action")
        former = self._actions.get(full)
        self._check_free(f"action {action}", full + ros2_graph.GOAL, former is not None and not former.closed)
        name = normalise(type, "action")
        kind = self._types.action(name)
        if former is not None:
            former.go()
        node, spinner = self._for_actions()
        try:
            offer = RosAction(
                node,
                self._hop,
                spinner,
                self._reactor,
                full,
                name,
                kind,
                on_goal,
                on_cancel,
                self._gone,
            )
        except Exception as error:
            raise Invalid(f"ROS 2 refuses the action {action} as {name}: {in_words(error)}") from None
        self._actions[full] = offer
        return offer

    def _withdrawn(self, service: RosService) -> None:
        del self._services[service.name]

    def _gone(self, action: RosAction) -> None:
        if self._actions.get(action.name) is action:
            del self._actions[action.name]

    def _check_free(self, what: str, service: str, ours: bool) -> None:
        if ours:
            raise Invalid(f"somebody at the relay offers the {what} already")
        other = ros2_graph.provider(self._node, service, (self._name, self._name + _ACTIONS))
        if other is not None:
            raise Invalid(f"the robot has the {what} already: {other} offers it")

    def pursue(self, action: str, type: str, goal: bytes, on_feedback: OnSample | None) -> RosGoal:
        """Have an action pursue a goal."""
        full = check_name(self._node.resolve_topic_name, action, "action")
        name = action_type(full, type, self._node.get_service_names_and_types())
        begun: RosGoal = self._goals.pursue(full, name, goal, on_feedback)
        return begun

    def definition(self, type: str) -> link.TypeDefinition:
        """The text of a type and all it contains."""
        return self._types.definition(type)

    def interfaces(self) -> list[str]:
        """Names of all types that are installed."""
        return self._types.names()

    def judge(self, type: str, body: bytes) -> Motion:
        """What this command would do."""
        return self._types.judge(type, body)

    def zero(self, type: str) -> bytes:
        """The message that stands still."""
        return self._types.zero(type, self._node.get_clock().now().to_msg())

    def battery(self) -> float | None:
        """Charge as the first battery topic tells it."""
        if self._battery_sample is None:
            return None
        try:
            state: Any = deserialize_message(self._battery_sample, self._types.message(BATTERY))
        except (
            Exception
        ):  # any node may publish anything there; rclpy's errors differ from release to release
            self._battery_sample = None
            return None
        return float(state.percentage) if 0.0 <= state.percentage <= 1.0 else None

    def trouble(self) -> str | None:
        """Whether the executor is stuck."""
        trouble: str | None = self._spinner.trouble()
        if trouble is None and self._acting is not None:
            trouble = self._acting[1].trouble()
        return trouble

    def _find_battery(self, view: GraphView) -> None:
        if self._battery is not None:
            return
        topic = next((name for name, each in sorted(view.topics.items()) if BATTERY in each.types), None)
        if topic is None or not view.topics[topic].publishers:
            return

        def keep(body: bytes) -> None:
            self._battery_sample = body

        try:
            self._battery = self.subscribe(topic, BATTERY, link.QoS(depth=1), keep, lambda: None)
        except SwitchboardError:
            self._want_battery = False  # no such type here; a robot without a gauge is a robot


_DISTROS = {3: "humble", 4: "iron", 7: "jazzy", 9: "kilted"}
"""By the major version of rclpy."""


def _distro() -> str:
    """The distribution, for installations that don't set ``ROS_DISTRO``."""
    for name in ("ros-rclpy", "rclpy"):
        try:
            return _DISTROS.get(int(metadata.version(name).split(".")[0]), "")
        except (metadata.PackageNotFoundError, ValueError):
            continue
    return ""
