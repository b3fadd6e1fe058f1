"""A platform without a robot: topics and services in memory, for tests and for trying the link."""

from __future__ import annotations

import struct
import uuid
from collections.abc import Callable

from twisted.internet.defer import Deferred, fail

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound
from robot_client.alerts import OnAlert, nobody
from robot_client.motion.typed_topic import TypedTopic
from robot_client.platforms.base import (
    ABORTED,
    NEVER_BEGAN,
    Check,
    Facts,
    GoalOutcome,
    GraphView,
    Motion,
    OnCall,
    OnCancel,
    OnChange,
    OnGoal,
    OnKept,
    OnSample,
    Platform,
)
from robot_client.platforms.definitions import normalise

TWIST = "geometry_msgs/msg/Twist"
_HEADER = b"\0\1\0\0"
_TWIST = struct.Struct("<6d")


def twist(forward: float = 0.0, turn: float = 0.0) -> bytes:
    """A Twist as CDR."""
    return _HEADER + _TWIST.pack(forward, 0.0, 0.0, 0.0, 0.0, turn)


class MemorySource:
    """A subscription; samples come by :meth:`MemoryPlatform.emit`."""

    stamp = 0
    replays = ""

    def __init__(self, platform: MemoryPlatform, topic: str, type: str, on_sample: OnSample) -> None:
        self.type = type
        self.topic = topic
        self.latched = False
        self.publishers = 1
        self.unmatched: list[str] = []
        self.on_sample = on_sample
        self.on_change: OnChange = lambda: None
        self.keeps: dict[int, bytes] = {}
        """What its publishers keep, by stamp."""
        self.recalls: list[Callable[[], None]] = []
        """What ends each :meth:`recall`."""
        self._platform = platform

    def recall(self, on_kept: OnKept, on_end: Callable[[], None]) -> None:
        """Tell what is in :attr:`keeps`."""
        self.recalls.append(on_end)
        for stamp, body in self.keeps.items():
            on_kept(stamp, body)

    def close(self) -> None:
        """Stop listening."""
        self._platform.sources.remove(self)


class MemorySink:
    """A publisher; what it publishes is in :attr:`MemoryPlatform.published`."""

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
        """Record one message."""
        self._platform.published.append((self.topic, body))

    def close(self) -> None:
        """Take the publisher away."""
        self._platform.sinks.remove(self)


class MemoryService:
    """A service offered to nobody; :meth:`call` stands for a caller."""

    def __init__(self, platform: MemoryPlatform, name: str, type: str, on_call: OnCall) -> None:
        self.type = type
        self.answers: list[bytes] = []
        self._platform = platform
        self._name = name
        self._on_call = on_call

    def call(self, body: bytes) -> None:
        """Call it; what is answered comes to :attr:`answers`."""
        self._on_call(body, self._answer)

    def close(self) -> None:
        """Offer it no more."""
        del self._platform.offered[self._name]

    def _answer(self, body: bytes) -> None:
        if not body.startswith(_HEADER):
            raise Invalid(f"the bytes are no response of type {self.type}")
        self.answers.append(body)


class MemoryServedGoal:
    """A goal of :meth:`MemoryAction.send`."""

    def __init__(self, action: MemoryAction) -> None:
        self.said: list[bytes] = []
        self.end: tuple[int, bytes | None] | None = None
        self._action = action

    def feedback(self, body: bytes) -> None:
        """Record it."""
        if not body.startswith(_HEADER):
            raise Invalid(f"the bytes are no feedback of type {self._action.type}")
        self.said.append(body)

    def finish(self, status: int, body: bytes | None) -> None:
        """Record the end."""
        if body is not None and not body.startswith(_HEADER):
            raise Invalid(f"the bytes are no result of type {self._action.type}")
        self.end = self.end or (status, body)

    def cancel(self) -> None:
        """Be the one who wants it no more."""
        self._action.on_cancel(self)


class MemoryAction:
    """An action offered to nobody; :meth:`send` stands for one who wants something."""

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
        """Give it a goal."""
        goal = MemoryServedGoal(self)
        self.goals.append(goal)
        self._on_goal(body, goal)
        return goal

    def close(self) -> None:
        """Offer it no more; goals are aborted."""
        for goal in self.goals:
            goal.finish(ABORTED, None)
        del self._platform.acted[self._name]


class MemoryGoal:
    """A goal of ours; what becomes of it is set by :meth:`feed` and :attr:`result`."""

    def __init__(self, action: str, body: bytes, on_feedback: OnSample | None) -> None:
        self.id = uuid.uuid4().bytes
        self.result: Deferred[GoalOutcome] = Deferred()
        self.action = action
        self.body = body
        self.cancels = 0
        """How often it was cancelled."""
        self._on_feedback = on_feedback

    @property
    def cancelled(self) -> bool:
        """Whether nobody wants it."""
        return self.cancels > 0

    def feed(self, body: bytes) -> None:
        """Tell how far it is, if anybody wants to know."""
        if self._on_feedback is not None:
            self._on_feedback(body)

    def cancel(self) -> None:
        """Note that nobody wants it."""
        self.cancels += 1


Service = Callable[[bytes], "bytes | Deferred[bytes]"]


class MemoryPlatform(Platform):
    """Topics, services and types as one sets them.

    :param view: the graph it shows
    """

    encoding = "cdr"

    def __init__(self, view: GraphView | None = None) -> None:
        self.on_alert: OnAlert = nobody
        self.view = view or GraphView()
        self.sources: list[MemorySource] = []
        self.sinks: list[MemorySink] = []
        self.published: list[tuple[str, bytes]] = []
        self.services: dict[str, Service] = {}
        self.looking: list[Deferred[None]] | None = None
        """Where it is a list, services take their time to be found: each call until what is added here fires."""
        self.prepared: list[tuple[str, str]] = []
        """Services that are to be called some time, and by which types."""
        self.actions: set[str] = set()
        self.goals: list[MemoryGoal] = []
        self.offered: dict[str, MemoryService] = {}
        self.acted: dict[str, MemoryAction] = {}
        self.definitions: dict[str, str] = {}
        self.rests: dict[str, bytes] = {}
        self.charge: float | None = None
        self.running = False
        self._after: list[Callable[[], None]] = []

    @property
    def dropped(self) -> int:
        """Never any."""
        return 0

    def start(self) -> None:
        """Be there."""
        self.running = True

    def stop(self) -> None:
        """Be gone."""
        self.running = False

    def facts(self) -> Facts:
        """What it is."""
        return Facts("memory")

    def graph(self) -> GraphView:
        """The graph set."""
        return self.view

    def emit(self, topic: str, *bodies: bytes) -> None:
        """Let messages appear on a topic, together."""
        for body in bodies:
            for source in list(self.sources):
                if source.topic == topic:
                    source.on_sample(body)
        after, self._after = self._after, []
        for call in after:
            call()

    def after_samples(self, call: Callable[[], None]) -> None:
        """Call at the end of what is emitted."""
        self._after.append(call)

    def subscribe(
        self, topic: str, type: str, qos: link.QoS | None, on_sample: OnSample, on_change: OnChange
    ) -> MemorySource:
        """Listen to what is emitted."""
        if not type:
            known = self.view.topics.get(topic)
            if known is None:
                raise NotFound(f"there is no topic {topic} in the robot's graph")
            type = known.types[0]
        source = MemorySource(self, topic, type, on_sample)
        source.on_change = on_change
        self.sources.append(source)
        return source

    def resolve(self, topic: str, type: str) -> TypedTopic:
        """Make name and type full."""
        full = "/" + topic.removeprefix("/")
        known = self.view.topics.get(full)
        if not type and known is None:
            raise Invalid(f"{topic} can't be advertised without a type")
        return TypedTopic(full, normalise(type) if type or known is None else known.types[0])

    def full_name(self, name: str, what: str) -> str:
        """Make a name absolute."""
        return "/" + name.removeprefix("/")

    def advertise(
        self,
        topic: str,
        type: str,
        latch: bool,
        qos: link.QoS | None,
        queue_size: int = 0,
        on_change: OnChange = lambda: None,
    ) -> MemorySink:
        """Make a recording publisher."""
        sink = MemorySink(self, self.resolve(topic, type).topic, latch, qos, queue_size)
        sink.on_change = on_change
        self.sinks.append(sink)
        return sink

    def call(
        self, service: str, type: str, request: bytes, timeout: float, check: Check | None = None
    ) -> Deferred[bytes]:
        """Ask the function set for a service, when it is found."""
        function = self.services.get(service)
        if function is None:
            return fail(NotFound(f"there is no service {service} on this robot"))
        found: Deferred[None] = Deferred()
        checked = found.addCallback(lambda _: None if check is None else check())
        answered = checked.addCallback(lambda _: function(request))
        if self.looking is None:
            found.callback(None)
        else:
            self.looking.append(found)
        return answered

    def prepare_call(self, service: str, type: str) -> None:
        """Note that it is to be called some time."""
        self.prepared.append((service, type))

    def serve(self, service: str, type: str, on_call: OnCall) -> MemoryService:
        """Offer a service."""
        if service in self.services or service in self.offered:
            raise Invalid(f"the robot has the service {service} already")
        offer = self.offered[service] = MemoryService(self, service, normalise(type, "srv"), on_call)
        return offer

    def act(self, action: str, type: str, on_goal: OnGoal, on_cancel: OnCancel) -> MemoryAction:
        """Offer an action."""
        if action in self.actions or action in self.acted:
            raise Invalid(f"the robot has the action {action} already")
        full = normalise(type, "action")
        offer = self.acted[action] = MemoryAction(self, action, full, on_goal, on_cancel)
        return offer

    def pursue(self, action: str, type: str, goal: bytes, on_feedback: OnSample | None) -> MemoryGoal:
        """Begin a goal that the one who set the action ends."""
        made = MemoryGoal(action, goal, on_feedback)
        self.goals.append(made)
        if action not in self.actions:
            made.result.callback(GoalOutcome(NEVER_BEGAN, None, f"the action {action} can't be reached"))
        return made

    def interfaces(self) -> list[str]:
        """The types set."""
        return sorted(self.definitions)

    def definition(self, type: str) -> link.TypeDefinition:
        """The text set for a type."""
        if type not in self.definitions:
            raise NotFound(f"the type {type} is not installed on this robot")
        return link.TypeDefinition(type=type, text=self.definitions[type])

    def judge(self, type: str, body: bytes) -> Motion:
        """Look into a Twist."""
        if len(body) != len(_HEADER) + _TWIST.size:
            return Motion.INVALID
        values = _TWIST.unpack_from(body, len(_HEADER))
        if any(value != value or abs(value) == float("inf") for value in values):
            return Motion.INVALID
        return Motion.MOVING if any(values) else Motion.STILL

    def resting(self, type: str, body: bytes) -> bytes:
        """What :attr:`rests` says of the type."""
        return self.rests.get(type, b"")

    def zero(self, type: str, rest: bytes = b"") -> bytes:
        """A Twist that stands still, or what was given for it."""
        return rest or twist()

    def battery(self) -> float | None:
        """The charge set."""
        return self.charge

    def trouble(self) -> str | None:
        """Never any."""
        return None
