"""Service calls of the ROS 2 platform: never blocking, never waiting for a service that is gone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from rclpy.serialization import deserialize_message, serialize_message
from twisted.internet.defer import Deferred

from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from robot_client.platforms.base import Check
from robot_client.platforms.ros2 import qos
from robot_client.platforms.ros2.errors import in_words
from robot_client.platforms.ros2.executor import ReactorBridge
from robot_client.platforms.ros2.types import Types
from robot_client.twisted_types import DelayedCall, ReactorClock

LOOK = 0.02
"""Seconds between looks for a service whose client was just made."""

APPEAR = 1.0
"""Seconds a service in the graph has to be reached."""

WATCH = 0.25
GONE = 1.0
"""Seconds a called service may be out of reach before the call is given up."""

IDLE = 30.0


class _ServiceClient(NamedTuple):
    """A client of a service.

    :param lossy: whether it takes answers that may be lost, because the service sends no others
    """

    client: Any
    used: list[float]
    lossy: bool


class RosServiceCalls:
    """All calls of one node.

    :param clock: timers and seconds
    """

    def __init__(self, node: Any, hop: ReactorBridge, types: Types, clock: ReactorClock) -> None:
        self.node = node
        self.hop = hop
        self.clock = clock
        self._types = types
        self._clients: dict[tuple[str, str], _ServiceClient] = {}
        self._kept: set[tuple[str, str]] = set()
        """Clients that stay, by service and type."""
        self._pending: set[_RosCall] = set()

    def keep(self, service: str, type: str) -> None:
        """Make a client that stays: it has found the service long before it is to call it."""
        self._client(service, type, self._types.service(type))
        self._kept.add((service, type))

    def keeps(self, service: str, type: str) -> bool:
        """Whether there is a client for this that stays."""
        return (service, type) in self._kept

    def call(
        self, service: str, type: str, request: bytes, timeout: float, check: Check | None = None
    ) -> Deferred[bytes]:
        """Call once; see :meth:`robot_client.platforms.base.Platform.call`."""
        kind = self._types.service(type)
        try:
            message = deserialize_message(request, kind.Request)
        except Exception:
            raise Invalid(f"the arguments for {service} are no request of type {type}") from None
        client = self._client(service, type, kind)
        call = _RosCall(self, service, client, message, timeout, self._pending.discard, check)
        self._pending.add(call)
        call.begin()
        return call.result

    def sweep(self) -> None:
        """Destroy the clients nobody used for a while."""
        now = self.clock.seconds()
        busy = {call.client for call in self._pending}
        for key, (client, used, _) in list(self._clients.items()):
            if key not in self._kept and client not in busy and now - used[0] > IDLE:
                del self._clients[key]
                self.node.destroy_client(client)

    def close(self) -> None:
        """Give up everything."""
        for call in list(self._pending):
            call.give_up(Unavailable("the robot is shutting down"))
        for known in self._clients.values():
            self.node.destroy_client(known.client)
        self._clients.clear()
        self._kept.clear()

    def _client(self, service: str, type: str, kind: Any) -> Any:
        known = self._clients.get((service, type))
        if known is None or not known.client.service_is_ready():
            known = self._fitting(service, type, kind, known)
        known.used[0] = self.clock.seconds()
        return known.client

    def _fitting(self, service: str, type: str, kind: Any, known: _ServiceClient | None) -> _ServiceClient:
        """A client of the quality of service that the service has, where its node is in the graph."""
        servers = self.servers(service)
        lossy = qos.lossy(servers)
        if known is not None:
            busy = any(call.client is known.client for call in self._pending)
            if busy or not servers or lossy == known.lossy:
                return known
            self.node.destroy_client(known.client)
        client = self.node.create_client(kind, service, qos_profile=qos.for_service(lossy))
        made = self._clients[service, type] = _ServiceClient(client, [0.0], lossy)
        return made

    def servers(self, service: str) -> list[Any]:
        """The ends by which a service gets its requests, as the graph tells of them."""
        topic = f"rq{self.node.resolve_service_name(service)}Request"
        return list(self.node.get_subscriptions_info_by_topic(topic, no_mangle=True))


class _RosCall:
    """One call, from looking for the service to its answer."""

    def __init__(
        self,
        calls: RosServiceCalls,
        service: str,
        client: Any,
        request: Any,
        timeout: float,
        on_done: Callable[[_RosCall], None],
        check: Check | None,
    ) -> None:
        self.client = client
        self.result: Deferred[bytes] = Deferred(lambda _: self._end())
        self._service = service
        self._request = request
        self._calls = calls
        self._timeout = timeout
        self._on_done = on_done
        self._check = check
        self._future: Any = None
        self._seen = self._began = calls.clock.seconds()
        self._next: DelayedCall | None = None
        self._limit: DelayedCall | None = None

    def begin(self) -> None:
        """Look for the service; ask it once it is there."""
        self._limit = self._calls.clock.callLater(self._timeout, self._too_late)
        self._look()

    def give_up(self, reason: SwitchboardError) -> None:
        """End without an answer."""
        self._end()
        self.result.errback(reason)

    def _look(self) -> None:
        if self.client.service_is_ready():
            self._ask()
        elif self._calls.clock.seconds() - self._began > APPEAR:
            why = qos.unsafe_service(self._calls.servers(self._service))
            why = why or "its node is gone or silent"
            self.give_up(NotFound(f"the service {self._service} can't be reached; {why}"))
        else:
            self._next = self._calls.clock.callLater(LOOK, self._look)

    def _ask(self) -> None:
        """Send the request, if it may still be sent.

        Orders of the relay are done on this thread as well: none can come between the judgement and the request.
        """
        try:
            if self._check is not None:
                self._check()
        except SwitchboardError as error:
            self.give_up(error)
            return
        hop = self._calls.hop
        self._future = self.client.call_async(self._request)
        self._future.add_done_callback(lambda future: hop.put(self._answered, future))
        self._seen = self._calls.clock.seconds()
        self._next = self._calls.clock.callLater(WATCH, self._watch)

    def _watch(self) -> None:
        now = self._calls.clock.seconds()
        if self.client.service_is_ready():
            self._seen = now
        elif now - self._seen > GONE:
            self.give_up(Unavailable(f"the service {self._service} vanished before it answered"))
            return
        self._next = self._calls.clock.callLater(WATCH, self._watch)

    def _answered(self, future: Any) -> None:
        if self.result.called or self._on_done is _nothing:
            return
        try:
            body = bytes(serialize_message(future.result()))
        except Exception as error:
            self.give_up(Unavailable(f"the call of {self._service} failed: {in_words(error)}"))
            return
        self._end()
        self.result.callback(body)

    def _too_late(self) -> None:
        self.give_up(Unavailable(f"the service {self._service} did not answer within {self._timeout:g} s"))

    def _end(self) -> None:
        for timer in (self._next, self._limit):
            if timer is not None and timer.active():
                timer.cancel()
        if self._future is not None and not self._future.done():
            self.client.remove_pending_request(self._future)
        self._on_done(self)
        self._on_done = _nothing


def _nothing(call: _RosCall) -> None:
    """Said once already."""
