"""What a robot platform offers to the daemon: ROS 2 is one, memory another.

All methods are called on the reactor's thread, all callbacks come there. Requests that can't be done raise
one of :mod:`relay_protocol.errors` with a sentence for the client.
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
"""Sees that something may still be done; raises one of :mod:`relay_protocol.errors` where it may not."""

OnCall = Callable[[bytes, Callable[[bytes], None]], None]
"""Takes a request and what its answer is to be given to, which raises :class:`Invalid` for bytes that are none."""

NEVER_BEGAN = 0
SUCCEEDED = 4
CANCELED = 5
ABORTED = 6
"""How a goal ended, as in ``action_msgs/msg/GoalStatus``."""

Entry = TypeVar("Entry", link.Topic, link.Service)


class Facts(NamedTuple):
    """What a platform knows of itself, for ``describe``."""

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


class Motion(enum.Enum):
    """What a command would do."""

    STILL = "still"
    MOVING = "moving"
    INVALID = "invalid"
    """No message of its type, or with a number that is none (NaN, infinity)."""


OnKept = Callable[[int, bytes], None]
"""Takes the stamp and the body of a sample that a publisher keeps."""


class SubscriptionHandle(Protocol):
    """A topic the daemon listens to."""

    type: str
    unmatched: list[str]
    """Nodes that publish it and are not heard, because they offer less than was asked for; with the reason."""
    stamp: int
    """Of the sample that is being passed on: nanoseconds since 1970 when it first came, 0 when nobody noted it."""

    @property
    def replays(self) -> str:
        """Names the memory of stamps: under the same name a stamp means the same sample. Empty: no :meth:`recall`."""

    @property
    def latched(self) -> bool:
        """Whether its publishers keep their last messages for late joiners."""

    @property
    def publishers(self) -> int:
        """How many publish now."""

    def recall(self, on_kept: OnKept, on_end: Callable[[], None]) -> None:
        """Ask the publishers for what they keep for late joiners; ends what was asked before.

        :param on_kept: called with each of these samples, also with those passed on before, and with what is published
            meanwhile
        :param on_end: called once, when all have had time to come; not when the source is closed before
        """

    def close(self) -> None:
        """Stop listening; no sample comes any more."""


class PublisherHandle(Protocol):
    """A topic the daemon publishes."""

    unmatched: list[str]
    """Nodes that subscribe to it and get nothing, because they ask for more than is offered; with the reason."""

    def publish(self, body: bytes) -> None:
        """Publish one message in the platform's encoding."""

    def close(self) -> None:
        """Take the publisher away."""


class AdvertisementHandle(Protocol):
    """A service or action the daemon offers."""

    type: str

    def close(self) -> None:
        """Offer it no more: calls get no answer, goals are aborted."""


class ServedGoal(Protocol):
    """A goal from the graph that somebody at the relay pursues."""

    def feedback(self, body: bytes) -> None:
        """Publish how far it has come.

        :raises Invalid: the bytes are no feedback of the action's type
        """

    def finish(self, status: int, body: bytes | None) -> None:
        """End it; what is neither :data:`SUCCEEDED` nor a :data:`CANCELED` that was asked for is an abort.

        :param body: the result, ``None`` for an empty one
        :raises Invalid: the bytes are no result of the action's type; the goal goes on
        """


OnGoal = Callable[[bytes, ServedGoal], None]
OnCancel = Callable[[ServedGoal], None]


class GoalOutcome(NamedTuple):
    """How a goal of ours ended.

    :param status: one of the four above
    :param body: the result, ``None`` if there is none
    :param reason: why there is none
    :param certain: whether the action has ended it, or never got it; else it may go on though nobody hears of it
    """

    status: int
    body: bytes | None
    reason: str = ""
    certain: bool = True


class GoalHandle(Protocol):
    """A goal that an action of the robot pursues for us."""

    id: bytes
    """What the action knows it by, 16 bytes."""
    result: Deferred[GoalOutcome]
    """Fires once in every case."""

    def cancel(self) -> None:
        """Want it no more, however far it is; :attr:`result` still comes. An action that was asked is asked again."""


class Platform(Protocol):
    """One robot's middleware."""

    encoding: str
    on_alert: OnAlert
    """Is told what a person should know."""

    @property
    def dropped(self) -> int:
        """Samples that never reached the reactor, since start."""

    def start(self) -> None:
        """Connect to the middleware.

        :raises Unavailable: it is not there, in words
        """

    def stop(self) -> None:
        """Leave it; every source and sink is closed."""

    def facts(self) -> Facts:
        """What it is."""

    def graph(self) -> GraphView:
        """What there is now."""

    def subscribe(
        self, topic: str, type: str, qos: link.QoS | None, on_sample: OnSample, on_change: OnChange
    ) -> SubscriptionHandle:
        """Listen to a topic, present or not yet.

        :param type: empty to take the topic's one type from the graph
        :param on_change: called when :attr:`SubscriptionHandle.latched`, ``publishers`` or ``unmatched`` changed
        """

    def after_samples(self, call: Callable[[], None]) -> None:
        """Call once when the samples that came together have all been passed on."""

    def resolve(self, topic: str, type: str) -> TypedTopic:
        """Name and type that :meth:`advertise` would use, however they are spelled.

        :param type: empty to take the topic's one type from the graph
        """

    def full_name(self, name: str, what: str) -> str:
        """The absolute name that is used in the end, however it is spelled.

        :param what: ``topic``, ``service`` or ``action``
        :raises Invalid: it is no name
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
        """Make a publisher. What ``qos`` leaves out follows what the topic's subscribers ask for.

        :param queue_size: messages kept for subscribers that are slow, unless ``qos`` says it; the usual below 1
        :param on_change: called when :attr:`PublisherHandle.unmatched` changed
        """

    def call(
        self, service: str, type: str, request: bytes, timeout: float, check: Check | None = None
    ) -> Deferred[bytes]:
        """Call a service once; fails with a sentence. Cancelling the result gives the call up.

        :param check: called on the reactor's thread right before the request is sent, when the service is found; the
            call fails with what it raises, and nothing is sent
        """

    def prepare_call(self, service: str, type: str) -> None:
        """Keep for good what calls a service, so that it need not be found again when it is called by this type."""

    def serve(self, service: str, type: str, on_call: OnCall) -> AdvertisementHandle:
        """Offer a service; its calls come one after the other and are answered in any order."""

    def act(self, action: str, type: str, on_goal: OnGoal, on_cancel: OnCancel) -> AdvertisementHandle:
        """Offer an action; every goal is accepted.

        :param on_cancel: told of a goal nobody wants any more
        """

    def pursue(self, action: str, type: str, goal: bytes, on_feedback: OnSample | None) -> GoalHandle:
        """Have an action of the robot pursue a goal.

        :param type: empty to take the action's one type from the graph
        :param on_feedback: ``None`` when nobody wants to know
        """

    def definition(self, type: str) -> link.TypeDefinition:
        """The text of a type and all it contains."""

    def interfaces(self) -> list[str]:
        """Full names of all types that :meth:`definition` knows, sorted."""

    def judge(self, type: str, body: bytes) -> Motion:
        """What this command would do."""

    def resting(self, type: str, body: bytes) -> bytes:
        """What the zero that follows this command is like: as many axes, the same joints; empty where all are alike.

        :param body: a command that was judged, and found valid
        """

    def zero(self, type: str, rest: bytes = b"") -> bytes:
        """The message of this type that stands still, stamped now where it has a header.

        :param rest: what :meth:`resting` gave for the command it follows
        """

    def battery(self) -> float | None:
        """Charge, 0 to 1, where known."""

    def trouble(self) -> str | None:
        """A sentence when the middleware is stuck, else ``None``."""


def difference(old: GraphView, new: GraphView) -> link.Graph | None:
    """What changed between two views, as a message; ``None`` if nothing did."""
    nodes: dict[str, dict[str, object] | None] = {name: {} for name in new.nodes - old.nodes}
    nodes.update(dict.fromkeys(old.nodes - new.nodes))
    changes = link.Graph(
        topics=_changed(old.topics, new.topics),
        services=_changed(old.services, new.services),
        actions=_changed(old.actions, new.actions),
        nodes=nodes,
    )
    return changes if changes.topics or changes.services or changes.actions or changes.nodes else None


def whole(view: GraphView) -> link.Graph:
    """A view as a full ``graph`` message."""
    return link.Graph(
        full=True,
        topics=dict(view.topics),
        services=dict(view.services),
        actions=dict(view.actions),
        nodes={name: {} for name in view.nodes},
    )


def _changed(old: dict[str, Entry], new: dict[str, Entry]) -> dict[str, Entry | None]:
    changed: dict[str, Entry | None] = {name: entry for name, entry in new.items() if old.get(name) != entry}
    changed.update(dict.fromkeys(old.keys() - new.keys()))
    return changed
