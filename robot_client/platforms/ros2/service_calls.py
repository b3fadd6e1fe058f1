"""Calls of the robot's services: nothing blocks, and a call ends when its service has disappeared."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message
from twisted.internet.defer import Deferred

from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from robot_client.platforms.base import Check
from robot_client.platforms.ros2 import graph, qos
from robot_client.platforms.ros2.errors import error_text
from robot_client.platforms.ros2.executor import ReactorBridge
from robot_client.platforms.ros2.types import Types
from robot_client.twisted_types import DelayedCall, ReactorClock

DISCOVERY_POLL = 0.02
"""Seconds between checks for a service whose client was just created."""

DISCOVERY_SECONDS = 3.0
"""Seconds in which a service of the graph must be reached. A busy machine discovers in one to two."""

SETTLE_SECONDS = 0.1
"""Seconds for which a new client does not send. The service may discover the reader of its answers later than the
client discovers the service, and then its answer is lost (https://github.com/ros2/rmw_fastrtps/issues/842)."""

CHECK_INTERVAL = 0.25
GONE_SECONDS = 1.0
"""Seconds for which a called service may be unreachable before the call is given up."""

IDLE_SECONDS = 30.0
"""Seconds after which an unused client is destroyed."""


class _ServiceClient:
    """A client of a service.

    :param best_effort: whether its reliability is best effort, because the service's is
    :param created_at: seconds
    """

    def __init__(self, client: Any, best_effort: bool, created_at: float) -> None:
        self.client = client
        self.best_effort = best_effort
        self.created_at = created_at
        self.used_at = 0.0
        """When it was last used, seconds."""


class RosServiceCalls:
    """All calls of one node.

    :param clock: for timers
    """

    def __init__(self, node: Any, bridge: ReactorBridge, types: Types, clock: ReactorClock) -> None:
        self.node = node
        self.bridge = bridge
        self.clock = clock
        self._types = types
        self._clients: dict[tuple[str, str], _ServiceClient] = {}
        self._prepared: set[tuple[str, str]] = set()
        """Service and type of clients that are never destroyed."""
        self._pending: set[_RosCall] = set()

    def prepare(self, service: str, type: str) -> None:
        """Create a client that is never destroyed, so that it has discovered the service before the first
        call."""
        self._client(service, type, self._types.service(type))
        self._prepared.add((service, type))

    @property
    def prepared(self) -> frozenset[tuple[str, str]]:
        """Service and type of these clients, also after :meth:`close`."""
        return frozenset(self._prepared)

    def is_prepared(self, service: str, type: str) -> bool:
        """Whether there is such a client."""
        return (service, type) in self._prepared

    def call(
        self, service: str, type: str, request: bytes, timeout: float, check: Check | None = None
    ) -> Deferred[bytes]:
        """See :meth:`robot_client.platforms.base.Platform.call`."""
        kind = self._types.service(type)
        try:
            message = deserialize_message(request, kind.Request)
        except Exception:
            raise Invalid(f"the arguments for {service} are not a request of type {type}") from None
        known = self._client(service, type, kind)
        call = _RosCall(self, service, known, message, timeout, self._pending.discard, check)
        self._pending.add(call)
        call.start()
        return call.result

    def remove_idle(self) -> None:
        """Destroy clients that were not used for :data:`IDLE_SECONDS`."""
        now = self.clock.seconds()
        busy = {call.client for call in self._pending}
        for key, known in list(self._clients.items()):
            idle = known.client not in busy and now - known.used_at > IDLE_SECONDS
            if idle and key not in self._prepared:
                del self._clients[key]
                self.node.destroy_client(known.client)

    def close(self) -> None:
        """Give up all calls and destroy all clients."""
        for call in list(self._pending):
            call.give_up(Unavailable("the robot is shutting down"))
        for known in self._clients.values():
            self.node.destroy_client(known.client)
        self._clients.clear()

    def _client(self, service: str, type: str, kind: Any) -> _ServiceClient:
        known = self._clients.get((service, type))
        if known is None or not known.client.service_is_ready():
            known = self._matching_client(service, type, kind, known)
        known.used_at = self.clock.seconds()
        return known

    def _matching_client(
        self, service: str, type: str, kind: Any, known: _ServiceClient | None
    ) -> _ServiceClient:
        """A client with the reliability of the service, if its node is in the graph."""
        servers = self.servers(service)
        best_effort = qos.is_best_effort(servers)
        if known is not None:
            busy = any(call.client is known.client for call in self._pending)
            if busy or not servers or best_effort == known.best_effort:
                return known
            self.node.destroy_client(known.client)
        client = self.node.create_client(kind, service, qos_profile=qos.for_service(best_effort))
        created = self._clients[service, type] = _ServiceClient(client, best_effort, self.clock.seconds())
        return created

    def servers(self, service: str) -> list[Any]:
        """Endpoints in the graph that receive the requests of a service."""
        return graph.servers(self.node, self.node.resolve_service_name(service))


class _RosCall:
    """One call, from discovery of the service to its response."""

    def __init__(
        self,
        calls: RosServiceCalls,
        service: str,
        known: _ServiceClient,
        request: Any,
        timeout: float,
        on_done: Callable[[_RosCall], None],
        check: Check | None,
    ) -> None:
        self.client = known.client
        self.result: Deferred[bytes] = Deferred(lambda _: self._end())
        self._service = service
        self._request = request
        self._not_before = known.created_at + SETTLE_SECONDS
        self._calls = calls
        self._timeout = timeout
        self._on_done = on_done
        self._check = check
        self._future: Any = None
        self._last_seen = self._began = calls.clock.seconds()
        self._next: DelayedCall | None = None
        self._limit: DelayedCall | None = None

    def start(self) -> None:
        """Send the request once the service is discovered."""
        self._limit = self._calls.clock.callLater(self._timeout, self._timed_out)
        self._discover()

    def give_up(self, reason: SwitchboardError) -> None:
        """End without a response."""
        self._end()
        self.result.errback(reason)

    def _discover(self) -> None:
        is_ready = self.client.service_is_ready()
        if is_ready and self._calls.clock.seconds() >= self._not_before:
            self._send()
        elif not is_ready and self._calls.clock.seconds() - self._began > DISCOVERY_SECONDS:
            reason = qos.unsafe_service(self._calls.servers(self._service))
            reason = reason or "its node is gone or silent"
            self.give_up(NotFound(f"the service {self._service} can't be reached; {reason}"))
        else:
            self._next = self._calls.clock.callLater(DISCOVERY_POLL, self._discover)

    def _send(self) -> None:
        """Send the request if the check allows it.

        The relay's commands are carried out on this thread too, so none can come between the check and the request.
        """
        try:
            if self._check is not None:
                self._check()
        except SwitchboardError as error:
            self.give_up(error)
            return
        bridge = self._calls.bridge
        self._future = self.client.call_async(self._request)
        self._future.add_done_callback(lambda future: bridge.put(self._responded, future))
        self._last_seen = self._calls.clock.seconds()
        self._next = self._calls.clock.callLater(CHECK_INTERVAL, self._check_server)

    def _check_server(self) -> None:
        now = self._calls.clock.seconds()
        if self.client.service_is_ready():
            self._last_seen = now
        elif now - self._last_seen > GONE_SECONDS:
            self.give_up(Unavailable(f"the service {self._service} disappeared before it responded"))
            return
        self._next = self._calls.clock.callLater(CHECK_INTERVAL, self._check_server)

    def _responded(self, future: Any) -> None:
        if self.result.called or self._on_done is _already_done:
            return
        try:
            body = bytes(serialize_message(future.result()))
        except Exception as error:
            self.give_up(Unavailable(f"the call of {self._service} failed: {error_text(error)}"))
            return
        self._end()
        self.result.callback(body)

    def _timed_out(self) -> None:
        self.give_up(Unavailable(f"the service {self._service} did not respond within {self._timeout:g} s"))

    def _end(self) -> None:
        for timer in (self._next, self._limit):
            if timer is not None and timer.active():
                timer.cancel()
        if self._future is not None and not self._future.done():
            self.client.remove_pending_request(self._future)
        self._on_done(self)
        self._on_done = _already_done


def _already_done(call: _RosCall) -> None:
    """Replaces ``on_done`` after its call."""
