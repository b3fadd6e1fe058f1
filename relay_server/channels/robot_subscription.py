"""One topic that the relay subscribes to on a robot: its samples go to the subscriptions of all clients."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable

from relay_protocol import link
from relay_protocol.link import QoS
from relay_protocol.ros_types import TypeRegistry
from relay_server.channels.client_subscription import SLOW_LINK, SLOW_ROBOT, ClientSubscription
from relay_server.channels.latched import LATCHED_BYTES, LatchedSamples
from relay_server.channels.members import ChannelMember
from relay_server.channels.robot_requests import RequestPhase
from relay_server.channels.samples import Converter, RenderError, Sample
from relay_server.channels.thinning import least_thinning
from relay_server.common.clock import Clock, Timer, cancel

MAX_UNTYPED = 64
"""Most samples of one topic that wait for its type's definition."""

TOO_LARGE, UNREADABLE, NO_TYPE, OTHER = "too_large", "unreadable", "no_type", "other"
NOT_THINNED = "not_thinned"
LOSSES = (TOO_LARGE, SLOW_LINK, SLOW_ROBOT, NOT_THINNED)
"""Reasons a robot gives for samples that it has not sent."""


class RobotSubscription:
    """A topic that the relay subscribes to on the robot, once for all its clients.

    :param number: of the subscription on the robot link
    :param type_name: empty while it is unknown
    :param types: returns the robot's known types
    :param on_conversion_error: called with the reason, the first time a message can't be converted
    :param request_latched: requests from the robot which samples the topic's publishers keep
    """

    def __init__(
        self,
        clock: Clock,
        *,
        number: int,
        topic: str,
        type_name: str,
        qos: QoS | None,
        types: Callable[[], TypeRegistry],
        on_conversion_error: Callable[[RobotSubscription, str], None],
        request_latched: Callable[[RobotSubscription], None],
    ) -> None:
        self.number = number
        self.topic = topic
        self.type = type_name
        self.type_confirmed = False
        """Whether the robot has the topic with this type; otherwise a client named the type."""
        self.qos = qos
        self.phase = RequestPhase.WAITING
        self.throttle_ms = 0
        self.thin: link.Thinning | None = None
        self.encoding = "cdr"
        self.latched = False
        self.publishers = 0
        self.refusals = 0
        """Refusals by the robot since it last subscribed."""
        self.silent_refusals = 0
        """Number of first refusals that clients are not notified of."""
        self.retry: Timer | None = None
        self.type_error = ""
        """Why the type's definition is not available; empty if it is."""
        self.unmatched: list[str] = []
        """Publishers that do not offer the quality of service a client has requested, with the reason."""
        self.losses: Counter[str] = Counter()
        """Samples that no client received, by reason (SPEC 1.7, ``lost``)."""
        self.received = 0
        """Samples received."""
        self.clients: dict[ChannelMember, ClientSubscription] = {}
        self.named_types: dict[ChannelMember, str] = {}
        """The type that each client names; clients that leave it to the graph are not included."""
        self.served: list[ClientSubscription] = []
        """Subscriptions that receive the samples: all but those of clients that name another type."""
        self._live: list[ClientSubscription] = []
        """Those of :attr:`served` that receive samples as they come: without those that first receive older ones."""
        self._joined_while_offline: set[ChannelMember] = set()
        """Clients that subscribed while the robot was offline."""
        self.pending_latched: dict[ChannelMember, ClientSubscription] = {}
        """Late joiners that receive the latched samples once the topic is no longer inhibited."""
        self._types = types
        self._on_conversion_error = on_conversion_error
        self._converter = self._new_converter()
        self.latched_samples = LatchedSamples(clock, lambda: request_latched(self), self._update_served)
        self._untyped: deque[Sample] = deque(maxlen=MAX_UNTYPED)
        self._waiting_for_type: set[ChannelMember] = set()
        """Clients that receive the latched samples once the topic's type is known."""
        self._latest_frame_stamp = 0
        """The ``frame_stamp`` of the latest sample."""
        self._frame_stamps_at_join: dict[ChannelMember, int] = {}
        """The latest ``frame_stamp`` when each client subscribed, if the topic was not latched yet."""

    # --- clients ----------------------------------------------------------------------------------------

    def join(
        self, member: ChannelMember, client_subscription: ClientSubscription, type_name: str | None
    ) -> None:
        """Add a client, or replace its subscription.

        :param type_name: the type it names; empty: it leaves the type to the graph; ``None``: as before
        """
        if self.phase is not RequestPhase.ACTIVE and member not in self.clients:
            self._joined_while_offline.add(member)
        self.clients[member] = client_subscription
        if type_name:
            self.named_types[member] = type_name
        elif type_name is not None:
            self.named_types.pop(member, None)
        self._update_served()

    def leave(self, member: ChannelMember) -> bool:
        """Remove a client; returns whether it had a subscription."""
        self.named_types.pop(member, None)
        self.pending_latched.pop(member, None)
        self._joined_while_offline.discard(member)
        self._waiting_for_type.discard(member)
        self._frame_stamps_at_join.pop(member, None)
        self.latched_samples.leave(member)
        was_subscribed = self.clients.pop(member, None) is not None
        self._update_served()
        return was_subscribed

    def serves(self, member: ChannelMember) -> bool:
        """Whether a client receives the samples."""
        return member in self.clients and self.named_types.get(member, self.type) == self.type

    def naming_other_types(self) -> list[tuple[ChannelMember, str]]:
        """Clients that name another type, with that type."""
        return [(member, wanted) for member, wanted in self.named_types.items() if wanted != self.type]

    def _update_served(self) -> None:
        served = [member for member in self.clients if self.serves(member)]
        self.served = [self.clients[member] for member in served]
        self._live = [
            self.clients[member] for member in served if not self.latched_samples.waits_for_replay(member)
        ]

    def least_throttle_ms(self) -> int:
        """The longest throttle in milliseconds that still satisfies every served subscription."""
        return int(
            min((client_subscription.robot_throttle for client_subscription in self.served), default=0.0)
            * 1000
        )

    def least_thinning(self) -> link.Thinning | None:
        """The thinning of point clouds that still satisfies every served subscription."""
        return least_thinning(client_subscription.thin for client_subscription in self.served)

    # --- the robot's side ---------------------------------------------------------------------------------

    def requested(self) -> None:
        """Note that the robot was asked to subscribe."""
        self.phase = RequestPhase.REQUESTED
        cancel(self.retry)
        self._converter = self._new_converter()

    def activate(self, type_name: str, encoding: str, latched: bool, publishers: int, memory: str) -> None:
        """Handle that the robot has subscribed, or that its publishers have changed.

        :param memory: see :attr:`LatchedSamples.memory`
        """
        begins = latched and not (self.latched and self.phase is RequestPhase.ACTIVE)
        self.phase = RequestPhase.ACTIVE
        self.refusals = 0
        if (type_name, encoding) != (self.type, self.encoding):
            self._forget_samples()
        self.encoding = encoding
        self.latched = latched
        self.publishers = publishers
        self.retype(type_name)
        early, self._joined_while_offline = self._joined_while_offline, set()
        if latched:
            self.latched_samples.robot_subscribed(memory, publishers)
        if begins:
            self.latched_samples.begin_count()
        if begins and memory:
            self.latched_samples.begin(self._latest_frame_stamp)
            self._begin_latched(early)
        if not self.type_error:
            self._clear_failures()

    def _begin_latched(self, early: set[ChannelMember]) -> None:
        """Replay latched samples to earlier subscribers, as the robot begins to send what publishers keep.

        A throttled subscription gets all of them, as its throttle would have passed only the last. Others get the
        samples from before they subscribed; they received the later ones live.
        """
        since, self._frame_stamps_at_join = self._frame_stamps_at_join, {}
        for member, client_subscription in list(self.clients.items()):
            if client_subscription.throttle or (member in early and self.latched_samples.newest):
                self.replay_latched(member, client_subscription, live=False)
            elif member in since and self.serves(member):
                self.latched_samples.join(member, client_subscription, live=True, since=since[member])

    def retype(self, type_name: str) -> None:
        """Set the topic's type."""
        if type_name != self.type:
            self.type_error = ""
        self.type = type_name
        self._converter = self._new_converter()
        self._update_served()

    def reset(self) -> None:
        """Forget everything, as the robot is no longer subscribed."""
        self._reset_request()
        self._forget_samples()

    def lost(self) -> None:
        """Handle the loss of the robot; after its return it may continue with the samples it sent before."""
        self._reset_request()
        self.latched_samples.lost()
        self._latest_frame_stamp = 0
        self._untyped.clear()
        self._waiting_for_type.clear()
        self._frame_stamps_at_join.clear()
        self._update_served()

    def _reset_request(self) -> None:
        self.phase = RequestPhase.WAITING
        self.refusals = self.silent_refusals = 0
        self.type_error = ""
        self.unmatched = []
        self.pending_latched.clear()
        cancel(self.retry)
        self._clear_failures()

    def _clear_failures(self) -> None:
        for client_subscription in self.clients.values():
            client_subscription.clear_failures()

    def _forget_samples(self) -> None:
        self.pending_latched.clear()
        self.latched_samples.forget()
        self._latest_frame_stamp = 0
        self._untyped.clear()
        self._waiting_for_type.clear()
        self._frame_stamps_at_join.clear()
        self._update_served()

    def _new_converter(self) -> Converter:
        return Converter(self._types(), self.type, self.encoding, self._conversion_failed)

    def _conversion_failed(self, reason: str) -> None:
        self.losses[UNREADABLE] += 1
        if self.losses[UNREADABLE] == 1:
            self._on_conversion_error(self, reason)

    def samples_dropped(self, loss: link.SamplesDropped) -> None:
        """Count samples that the robot has not sent."""
        self.losses[loss.reason if loss.reason in LOSSES else OTHER] += loss.count
        for client_subscription in list(self.clients.values()):
            client_subscription.samples_dropped(loss)
        if loss.reason == TOO_LARGE:
            for client_subscription in list(self.clients.values()):
                client_subscription.notify_error(
                    RenderError.NOT_SENT,
                    f"a message of {loss.size} bytes is too large to be sent. Publish it smaller, or raise "
                    "--largest-sample-mb of the relay and largest_sample_mb of the robot",
                )
        elif loss.reason == NOT_THINNED:
            for client_subscription in list(self.clients.values()):
                client_subscription.notify_error(
                    RenderError.NOT_SENT, f"a point cloud can't be thinned, so it is not sent: {loss.why}"
                )

    # --- samples ------------------------------------------------------------------------------------------

    def sample(self, body: bytes, ros_time_ns: int, frame_stamp: int) -> None:
        """Pass a sample of the robot to the clients.

        :param ros_time_ns: the robot's ROS time when it received the sample, nanoseconds
        :param frame_stamp: the robot's wall clock then, nanoseconds since 1970; from a robot with a memory it
            identifies the sample
        """
        converter = self._converter
        sample = Sample(body, ros_time_ns, converter)
        if self.latched:
            self.flush_latched()
            if not self.latched_samples.add(frame_stamp, sample):
                return
        self.received += 1
        self._latest_frame_stamp = frame_stamp
        if converter.ready or converter.check_ready():
            for client_subscription in self._live:
                client_subscription.receive(sample)
            return
        self.losses[NO_TYPE] += _append_bounded(self._untyped, sample)
        for client_subscription in self._live:
            if client_subscription.raw:
                client_subscription.receive(sample)

    def type_known(self) -> None:
        """Pass on the samples that waited, as a definition of the type has come."""
        self._converter = self._new_converter()
        if self.type_error:
            self.type_error = ""
            self._clear_failures()
        waiting = list(self._untyped)
        self._untyped.clear()
        unready, self._waiting_for_type = self._waiting_for_type, set()
        for member in unready:
            if self.serves(member):
                self.replay_latched(member, self.clients[member], live=False)
        for sample in waiting:
            for client_subscription in self._live:
                if not client_subscription.raw:
                    client_subscription.receive(sample)

    def replay_latched(
        self, member: ChannelMember, client_subscription: ClientSubscription, live: bool
    ) -> None:
        """Replay the latched samples to a new subscription.

        Before the topic's type is known there are none; those of a robot that can't repeat its samples wait for all in
        :attr:`_untyped`.

        :param live: whether its client receives the topic already
        """
        if not self.latched:
            self._frame_stamps_at_join[member] = self._latest_frame_stamp
        elif self._converter.check_ready() or client_subscription.raw:
            self.latched_samples.join(member, client_subscription, live)
        elif self.latched_samples.memory and not live:
            self._waiting_for_type.add(member)

    def flush_latched(self) -> None:
        """Replay the latched samples to late joiners, as the topic is no longer inhibited."""
        if not self.pending_latched:
            return
        pending_latched, self.pending_latched = self.pending_latched, {}
        for member, client_subscription in pending_latched.items():
            if self.serves(member):
                self.replay_latched(member, client_subscription, live=True)


def _append_bounded(samples: deque[Sample], sample: Sample) -> int:
    """Append a sample and drop the oldest beyond the limits of count and bytes; return how many were dropped."""
    dropped = int(len(samples) == samples.maxlen)
    samples.append(sample)
    while len(samples) > 1 and sum(each.size for each in samples) > LATCHED_BYTES:
        samples.popleft()
        dropped += 1
    return dropped


def unmatched_publishers_text(nodes: list[str]) -> str:
    """Warning for a client whose requested quality of service some publishers do not offer."""
    listed = ", ".join(nodes)
    return f"these publishers do not offer the requested quality of service, and are not received: {listed}"
