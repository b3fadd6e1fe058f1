"""The interface between the daemon and a robot's middleware; ``ros2/`` and ``mqtt/`` implement it.

All methods are called on the reactor's thread, and all callbacks run there. A request that can't be carried
out raises one of :mod:`relay_protocol.errors`; its text is for the client. Message bodies are bytes in
:attr:`Platform.encoding`.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from typing import NamedTuple, Protocol, TypeVar

import msgspec
from twisted.internet.defer import Deferred

from relay_protocol import link
from robot_client.alerts import OnAlert
from robot_client.motion.typed_topic import TypedTopic

OnSample = Callable[[bytes], None]
OnChange = Callable[[], None]
Check = Callable[[], None]
"""Called right before a request is sent; raises one of :mod:`relay_protocol.errors` if it must not be
sent."""

OnCall = Callable[[bytes, Callable[[bytes], None]], None]
"""Takes a request and a callable for the response, which raises :class:`Invalid` for bytes that are no response."""

OnLatched = Callable[[int, bytes], None]
"""Takes the stamp and the body of a sample that a publisher keeps for late joiners."""

NOT_STARTED = 0
SUCCEEDED = 4
CANCELED = 5
ABORTED = 6
"""End states of a goal, as in ``action_msgs/msg/GoalStatus``; ``NOT_STARTED`` is its ``STATUS_UNKNOWN``."""

Entry = TypeVar("Entry", link.Topic, link.Service)


class Facts(NamedTuple):
    """Description of a platform, for the ``describe`` message."""

    platform: str
    distro: str = ""
    extra: dict[str, str] = {}  # noqa: RUF012  (NamedTuple default, never changed)
    sim_time: bool = False


class GraphView(msgspec.Struct, frozen=True, kw_only=True):
    """The whole graph at one moment, without the daemon's own nodes."""

    topics: dict[str, link.Topic] = msgspec.field(default_factory=dict)
    services: dict[str, link.Service] = msgspec.field(default_factory=dict)
    actions: dict[str, link.Service] = msgspec.field(default_factory=dict)
    nodes: frozenset[str] = frozenset()


class CommandEffect(enum.Enum):
    """The effect of a command on the robot."""

    STILL = "still"
    MOVING = "moving"
    INVALID = "invalid"
    """The bytes are no message of the type, or a number in it is NaN or infinite."""


OnDropped = Callable[[int], None]
"""Called with the number of samples that were dropped before they reached the reactor."""


class SubscriptionHandle(Protocol):
    """A subscription of the daemon."""

    type: str
    on_dropped: OnDropped
    unmatched: list[str]
    """Publishers whose quality of service is too weak for this subscription to receive them: node, reason."""
    stamp: int
    """When the sample that is being passed on first arrived, nanoseconds since 1970; 0 if that was not
    recorded."""

    @property
    def stamps_id(self) -> str:
        """Id of the record of stamps: under the same id a stamp means the same sample. Empty: no latched
        samples can be requested again.
        """

    @property
    def latched(self) -> bool:
        """Whether a publisher keeps its last messages for late joiners (transient local)."""

    @property
    def publishers(self) -> int:
        """Number of publishers now."""

    def request_latched(self, on_latched: OnLatched, on_end: Callable[[], None]) -> None:
        """Fetch the samples that publishers keep for late joiners. A running request ends first.

        :param on_latched: called with each of these samples, with those passed on before, and with samples
            that are published meanwhile
        :param on_end: called once, when all have had time to arrive; not if the subscription is closed
            earlier
        """

    def close(self) -> None:
        """End the subscription; no callback runs after this."""


class PublisherHandle(Protocol):
    """A publisher of the daemon."""

    unmatched: list[str]
    """Subscribers that request a stronger quality of service than is offered, and receive nothing: node,
    reason."""

    def publish(self, body: bytes) -> None:
        """Publish one message."""

    def close(self) -> None:
        """Remove the publisher."""


class AdvertisementHandle(Protocol):
    """A service or action that the daemon advertises in the robot's graph."""

    type: str

    def close(self) -> None:
        """Withdraw it: open calls get no response, open goals are aborted."""


class ServedGoal(Protocol):
    """A goal from the robot's graph that a client of the relay executes."""

    def feedback(self, body: bytes) -> None:
        """Publish feedback.

        :raises Invalid: the bytes are no feedback of the action's type
        """

    def finish(self, status: int, body: bytes | None) -> None:
        """End the goal. Any status but :data:`SUCCEEDED`, or :data:`CANCELED` after a cancel request,
        aborts it.

        :param body: the result, ``None`` for an empty one
        :raises Invalid: the bytes are no result of the action's type; the goal stays open
        """


OnGoal = Callable[[bytes, ServedGoal], None]
OnCancel = Callable[[ServedGoal], None]


class GoalOutcome(NamedTuple):
    """The end of a goal that the daemon sent.

    :param status: :data:`NOT_STARTED`, :data:`SUCCEEDED`, :data:`CANCELED` or :data:`ABORTED`
    :param body: the result, ``None`` if there is none
    :param reason: why there is no result
    :param certain: whether the action has ended the goal or never got it; if not, it may still be executing
    """

    status: int
    body: bytes | None
    reason: str = ""
    certain: bool = True


class GoalHandle(Protocol):
    """A goal that the daemon sent to an action of the robot."""

    id: bytes
    """The goal's UUID, 16 bytes."""
    result: Deferred[GoalOutcome]
    """Fires exactly once; never fails."""

    def cancel(self) -> None:
        """Request cancellation at any stage; :attr:`result` still fires. Calling it again repeats the
        request."""


class Platform(Protocol):
    """One robot's middleware."""

    encoding: str
    """Encoding of message bodies, such as ``cdr``."""
    on_alert: OnAlert
    """Receives alerts of the platform."""

    @property
    def dropped(self) -> int:
        """Samples since the start that were discarded before they reached the reactor."""

    def start(self) -> None:
        """Connect to the middleware.

        :raises Unavailable: it can't be reached
        """

    def stop(self) -> None:
        """Disconnect; all subscriptions and publishers are closed."""

    def facts(self) -> Facts:
        """Description of the platform."""

    def graph(self) -> GraphView:
        """The graph now."""

    def endpoints(self, name: str, kind: str) -> frozenset[bytes]:
        """Ids of the publishers of a topic or the servers of a service, without the daemon's own.

        A process that is started again has other ids. The middleware may list endpoints of a killed process for
        a while: DDS usually for 20 s.

        :param kind: ``topic`` or ``service``
        :raises Invalid: not a valid name
        """

    def subscribe(
        self, topic: str, type: str, qos: link.QoS | None, on_sample: OnSample, on_change: OnChange
    ) -> SubscriptionHandle:
        """Subscribe to a topic, which need not exist yet.

        :param type: empty to take the topic's only type from the graph
        :param on_change: called when :attr:`SubscriptionHandle.latched`, ``publishers`` or ``unmatched``
            changed
        """

    def after_samples(self, call: Callable[[], None]) -> None:
        """Call once, when all samples that arrived together have been passed on."""

    def resolve(self, topic: str, type: str) -> TypedTopic:
        """The full name and type that :meth:`advertise` would use.

        :param type: empty to take the topic's only type from the graph
        """

    def full_name(self, name: str, kind: str) -> str:
        """The absolute name after remapping.

        :param kind: ``topic``, ``service`` or ``action``
        :raises Invalid: not a valid name
        """

    def advertise(
        self,
        topic: str,
        type: str,
        latch: bool,
        qos: link.QoS | None,
        queue_size: int = 0,
        on_change: OnChange = lambda: None,
    ) -> PublisherHandle:
        """Create a publisher. Policies that ``qos`` leaves out follow the requests of the topic's subscribers.

        :param queue_size: messages kept for slow subscribers, unless ``qos`` gives a depth; below 1: the
            default
        :param on_change: called when :attr:`PublisherHandle.unmatched` changed
        """

    def call(
        self, service: str, type: str, request: bytes, timeout: float, check: Check | None = None
    ) -> Deferred[bytes]:
        """Call a service once. Cancelling the Deferred gives up the call.

        :param timeout: seconds
        :param check: called on the reactor's thread right before the request is sent, when the service has
            been found; if it raises, nothing is sent and the call fails with that error
        """

    def prepare_call(self, service: str, type: str) -> None:
        """Keep a client of this service open, so that later calls with this type need not discover the
        service."""

    def advertise_service(self, service: str, type: str, on_call: OnCall) -> AdvertisementHandle:
        """Advertise a service; its calls arrive one after the other and may be answered in any order."""

    def advertise_action(
        self, action: str, type: str, on_goal: OnGoal, on_cancel: OnCancel
    ) -> AdvertisementHandle:
        """Advertise an action; every goal is accepted.

        :param on_cancel: called with each goal that is to be cancelled
        """

    def send_goal(self, action: str, type: str, goal: bytes, on_feedback: OnSample | None) -> GoalHandle:
        """Send a goal to an action of the robot.

        :param type: empty to take the action's only type from the graph
        :param on_feedback: ``None`` if no feedback is needed
        """

    def definition(self, type: str) -> link.TypeDefinition:
        """The text of a type and of all types it contains."""

    def interfaces(self) -> list[str]:
        """Full names of all types that :meth:`definition` knows, sorted."""

    def classify_command(self, type: str, body: bytes) -> CommandEffect:
        """Whether a command moves the robot."""

    def zero_template(self, type: str, body: bytes) -> bytes:
        """The shape of the zero command that may follow this command: as many axes, the same joints. Empty
        for types whose messages all have one shape.

        :param body: a command that :meth:`classify_command` found valid
        """

    def zero_command(self, type: str, template: bytes = b"") -> bytes:
        """A command of this type that means standstill, stamped with the current time if it has a header.

        :param template: from :meth:`zero_template` of the command it follows
        """

    def battery(self) -> float | None:
        """Charge, 0 to 1; ``None`` if unknown."""

    def publish_device(self, state: link.DeviceReport) -> None:
        """Publish the state of the robot's computer in its graph, if programs there can read it."""

    def fault(self) -> str | None:
        """A sentence that says why the middleware no longer works; ``None``: it works."""

    def depends_on_addresses(self) -> bool:
        """Whether it must be made again when the addresses of the machine change."""
        return False

    def renew(self) -> None:
        """Leave the graph and join it again; all handles are closed.

        :raises Unavailable: it can't join; :meth:`renew` may be called again
        """
        self.stop()
        self.start()


def graph_changes(old: GraphView, new: GraphView) -> link.Graph | None:
    """The changes between two views as a message; ``None`` if there are none."""
    nodes: dict[str, dict[str, object] | None] = {name: {} for name in new.nodes - old.nodes}
    nodes.update(dict.fromkeys(old.nodes - new.nodes))
    changes = link.Graph(
        topics=_changed_entries(old.topics, new.topics),
        services=_changed_entries(old.services, new.services),
        actions=_changed_entries(old.actions, new.actions),
        nodes=nodes,
    )
    return changes if changes.topics or changes.services or changes.actions or changes.nodes else None


def full_graph(view: GraphView) -> link.Graph:
    """A view as a full ``graph`` message."""
    return link.Graph(
        full=True,
        topics=dict(view.topics),
        services=dict(view.services),
        actions=dict(view.actions),
        nodes={name: {} for name in view.nodes},
    )


def _changed_entries(old: dict[str, Entry], new: dict[str, Entry]) -> dict[str, Entry | None]:
    changed: dict[str, Entry | None] = {name: entry for name, entry in new.items() if old.get(name) != entry}
    changed.update(dict.fromkeys(old.keys() - new.keys()))
    return changed
