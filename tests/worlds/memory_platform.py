"""A robot's middleware in memory: a test sets its graph, services and goals and reads what was published."""

from __future__ import annotations

import struct
import uuid
from collections.abc import Callable

from twisted.internet.defer import Deferred, fail

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound
from robot_client.alerts import OnAlert, ignore_alert
from robot_client.motion.typed_topic import TypedTopic
from robot_client.platforms.base import (
    ABORTED,
    NOT_STARTED,
    Check,
    CommandEffect,
    Facts,
    GoalOutcome,
    GraphView,
    OnCall,
    OnCancel,
    OnChange,
    OnDropped,
    OnGoal,
    OnLatched,
    OnSample,
    Platform,
)
from robot_client.platforms.definitions import normalise

TWIST = "geometry_msgs/msg/Twist"
_HEADER = b"\0\1\0\0"
_TWIST = struct.Struct("<6d")


def twist(forward: float = 0.0, turn: float = 0.0) -> bytes:
    """A Twist as CDR; metres and radians per second."""
    return _HEADER + _TWIST.pack(forward, 0.0, 0.0, 0.0, 0.0, turn)


class MemorySubscription:
    """A subscription; samples come by :meth:`MemoryPlatform.emit`."""

    stamp = 0
    stamps_id = ""

    def __init__(self, platform: MemoryPlatform, topic: str, type: str, on_sample: OnSample) -> None:
        self.type = type
        self.topic = topic
        self.latched = False
        self.publishers = 1
        self.on_dropped: OnDropped = lambda count: None
        self.unmatched: list[str] = []
        self.on_sample = on_sample
        self.on_change: OnChange = lambda: None
        self.kept_samples: dict[int, bytes] = {}
        """Samples that the publishers keep, by stamp."""
        self.request_ends: list[Callable[[], None]] = []
        """Each ends one :meth:`request_latched`."""
        self._platform = platform

    def request_latched(self, on_latched: OnLatched, on_end: Callable[[], None]) -> None:
        self.request_ends.append(on_end)
        for stamp, body in self.kept_samples.items():
            on_latched(stamp, body)

    def close(self) -> None:
        self._platform.subscriptions.remove(self)


class MemoryPublisher:
    """A publisher; its messages are in :attr:`MemoryPlatform.published`."""

    def __init__(
        self,
        platform: MemoryPlatform,
        topic: str,
        latch: bool = False,
        qos: link.QoS | None = None,
        queue_size: int = 0,
    ) -> None:
        self.topic = topic
        self.latch = latch
        self.qos = qos
        self.queue_size = queue_size
        self.unmatched: list[str] = []
        self.on_change: OnChange = lambda: None
        self._platform = platform

    def publish(self, body: bytes) -> None:
        self._platform.published.append((self.topic, body))

    def close(self) -> None:
        self._platform.publishers.remove(self)


class MemoryServiceServer:
    """An advertised service; :meth:`call` stands for a caller in the robot's graph."""

    def __init__(self, platform: MemoryPlatform, name: str, type: str, on_call: OnCall) -> None:
        self.type = type
        self.answers: list[bytes] = []
        self._platform = platform
        self._name = name
        self._on_call = on_call

    def call(self, body: bytes) -> None:
        """Call it; the response is added to :attr:`answers`."""
        self._on_call(body, self._answer)

    def close(self) -> None:
        del self._platform.advertised_services[self._name]

    def _answer(self, body: bytes) -> None:
        if not body.startswith(_HEADER):
            raise Invalid(f"the bytes are no response of type {self.type}")
        self.answers.append(body)


class MemoryServedGoal:
    """A goal of :meth:`MemoryActionServer.send`."""

    def __init__(self, action: MemoryActionServer) -> None:
        self.feedback_sent: list[bytes] = []
        self.end: tuple[int, bytes | None] | None = None
        self._action = action

    def feedback(self, body: bytes) -> None:
        if not body.startswith(_HEADER):
            raise Invalid(f"the bytes are no feedback of type {self._action.type}")
        self.feedback_sent.append(body)

    def finish(self, status: int, body: bytes | None) -> None:
        if body is not None and not body.startswith(_HEADER):
            raise Invalid(f"the bytes are no result of type {self._action.type}")
        self.end = self.end or (status, body)

    def cancel(self) -> None:
        """Cancel it as the node that sent it."""
        self._action.on_cancel(self)


class MemoryActionServer:
    """An advertised action; :meth:`send` stands for a node that sends a goal."""

    def __init__(
        self, platform: MemoryPlatform, name: str, type: str, on_goal: OnGoal, on_cancel: OnCancel
    ) -> None:
        self.type = type
        self.on_cancel = on_cancel
        self.goals: list[MemoryServedGoal] = []
        self._platform = platform
        self._name = name
        self._on_goal = on_goal

    def send(self, body: bytes) -> MemoryServedGoal:
        goal = MemoryServedGoal(self)
        self.goals.append(goal)
        self._on_goal(body, goal)
        return goal

    def close(self) -> None:
        for goal in self.goals:
            goal.finish(ABORTED, None)
        del self._platform.advertised_actions[self._name]


class MemoryGoalHandle:
    """A goal that the daemon sent; a test ends it by :attr:`result`."""

    def __init__(self, action: str, body: bytes, on_feedback: OnSample | None) -> None:
        self.id = uuid.uuid4().bytes
        self.result: Deferred[GoalOutcome] = Deferred()
        self.action = action
        self.body = body
        self.cancel_requests = 0
        self._on_feedback = on_feedback

    @property
    def cancelled(self) -> bool:
        return self.cancel_requests > 0

    def send_feedback(self, body: bytes) -> None:
        """Publish feedback as the action; it arrives if it was requested."""
        if self._on_feedback is not None:
            self._on_feedback(body)

    def cancel(self) -> None:
        self.cancel_requests += 1


Service = Callable[[bytes], "bytes | Deferred[bytes]"]


class MemoryPlatform(Platform):
    """Topics, services and types as a test sets them.

    :param view: the graph
    """

    encoding = "cdr"

    def __init__(self, view: GraphView | None = None) -> None:
        self.on_alert: OnAlert = ignore_alert
        self.view = view or GraphView()
        self.subscriptions: list[MemorySubscription] = []
        self.publishers: list[MemoryPublisher] = []
        self.published: list[tuple[str, bytes]] = []
        self.services: dict[str, Service] = {}
        self.pending_discovery: list[Deferred[None]] | None = None
        """If a list: each call adds a Deferred here and finds its service when that fires. If ``None``: at once."""
        self.prepared_calls: list[tuple[str, str]] = []
        """Service and type of each :meth:`prepare_call`."""
        self.actions: set[str] = set()
        self.goals: list[MemoryGoalHandle] = []
        self.advertised_services: dict[str, MemoryServiceServer] = {}
        self.advertised_actions: dict[str, MemoryActionServer] = {}
        self.definitions: dict[str, str] = {}
        self.zero_templates: dict[str, bytes] = {}
        self.charge: float | None = None
        self.running = False
        self.renewals = 0
        self.endpoint_ids: dict[str, set[bytes]] = {}
        """Result of :meth:`endpoints` by name."""
        self._after_samples: list[Callable[[], None]] = []

    @property
    def dropped(self) -> int:
        return 0

    def start(self) -> None:
        self.running = True

    def stop(self) -> None:
        self.running = False

    def renew(self) -> None:
        self.renewals += 1

    def facts(self) -> Facts:
        return Facts("memory")

    def graph(self) -> GraphView:
        return self.view

    def endpoints(self, name: str, kind: str) -> frozenset[bytes]:
        return frozenset(self.endpoint_ids.get(name, ()))

    def emit(self, topic: str, *bodies: bytes) -> None:
        """Publish messages as a node of the robot; they arrive together."""
        for body in bodies:
            for subscription in list(self.subscriptions):
                if subscription.topic == topic:
                    subscription.on_sample(body)
        calls, self._after_samples = self._after_samples, []
        for call in calls:
            call()

    def after_samples(self, call: Callable[[], None]) -> None:
        self._after_samples.append(call)

    def subscribe(
        self, topic: str, type: str, qos: link.QoS | None, on_sample: OnSample, on_change: OnChange
    ) -> MemorySubscription:
        if not type:
            known = self.view.topics.get(topic)
            if known is None:
                raise NotFound(f"there is no topic {topic} in the robot's graph")
            type = known.types[0]
        subscription = MemorySubscription(self, topic, type, on_sample)
        subscription.on_change = on_change
        self.subscriptions.append(subscription)
        return subscription

    def resolve(self, topic: str, type: str) -> TypedTopic:
        full = "/" + topic.removeprefix("/")
        known = self.view.topics.get(full)
        if not type and known is None:
            raise Invalid(f"{topic} can't be advertised without a type")
        return TypedTopic(full, normalise(type) if type or known is None else known.types[0])

    def full_name(self, name: str, kind: str) -> str:
        return "/" + name.removeprefix("/")

    def advertise(
        self,
        topic: str,
        type: str,
        latch: bool,
        qos: link.QoS | None,
        queue_size: int = 0,
        on_change: OnChange = lambda: None,
    ) -> MemoryPublisher:
        publisher = MemoryPublisher(self, self.resolve(topic, type).name, latch, qos, queue_size)
        publisher.on_change = on_change
        self.publishers.append(publisher)
        return publisher

    def call(
        self, service: str, type: str, request: bytes, timeout: float, check: Check | None = None
    ) -> Deferred[bytes]:
        function = self.services.get(service)
        if function is None:
            return fail(NotFound(f"there is no service {service} on this robot"))
        found: Deferred[None] = Deferred()
        checked = found.addCallback(lambda _: None if check is None else check())
        answered = checked.addCallback(lambda _: function(request))
        if self.pending_discovery is None:
            found.callback(None)
        else:
            self.pending_discovery.append(found)
        return answered

    def prepare_call(self, service: str, type: str) -> None:
        self.prepared_calls.append((service, type))

    def advertise_service(self, service: str, type: str, on_call: OnCall) -> MemoryServiceServer:
        if service in self.services or service in self.advertised_services:
            raise Invalid(f"the robot has the service {service} already")
        server = MemoryServiceServer(self, service, normalise(type, "srv"), on_call)
        self.advertised_services[service] = server
        return server

    def advertise_action(
        self, action: str, type: str, on_goal: OnGoal, on_cancel: OnCancel
    ) -> MemoryActionServer:
        if action in self.actions or action in self.advertised_actions:
            raise Invalid(f"the robot has the action {action} already")
        server = MemoryActionServer(self, action, normalise(type, "action"), on_goal, on_cancel)
        self.advertised_actions[action] = server
        return server

    def send_goal(
        self, action: str, type: str, goal: bytes, on_feedback: OnSample | None
    ) -> MemoryGoalHandle:
        """Start a goal, or end it at once if the action is not in :attr:`actions`."""
        handle = MemoryGoalHandle(action, goal, on_feedback)
        self.goals.append(handle)
        if action not in self.actions:
            handle.result.callback(GoalOutcome(NOT_STARTED, None, f"the action {action} can't be reached"))
        return handle

    def interfaces(self) -> list[str]:
        return sorted(self.definitions)

    def definition(self, type: str) -> link.TypeDefinition:
        if type not in self.definitions:
            raise NotFound(f"the type {type} is not installed on this robot")
        return link.TypeDefinition(type=type, text=self.definitions[type])

    def classify_command(self, type: str, body: bytes) -> CommandEffect:
        """Read a Twist, whatever the type."""
        if len(body) != len(_HEADER) + _TWIST.size:
            return CommandEffect.INVALID
        values = _TWIST.unpack_from(body, len(_HEADER))
        if any(value != value or abs(value) == float("inf") for value in values):
            return CommandEffect.INVALID
        return CommandEffect.MOVING if any(values) else CommandEffect.STILL

    def zero_template(self, type: str, body: bytes) -> bytes:
        return self.zero_templates.get(type, b"")

    def zero_command(self, type: str, template: bytes = b"") -> bytes:
        """A Twist, or the template itself."""
        return template or twist()

    def battery(self) -> float | None:
        return self.charge

    def publish_device(self, state: link.DeviceReport) -> None:
        pass

    def fault(self) -> str | None:
        return None
