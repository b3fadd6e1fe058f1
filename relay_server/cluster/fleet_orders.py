"""Orders to many robots, for those whose home is another relay: each such relay gets one order for its robots."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any, Protocol

import msgspec
from twisted.internet.defer import Deferred, DeferredSemaphore
from twisted.python.failure import Failure
from twisted.web.http import OK

from relay_db.queries import RobotRecord
from relay_protocol import jsontext
from relay_protocol.clocks import now_ns
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.access import Principal
from relay_server.cluster.forwarding import (
    STOP_WATCH_SECONDS,
    WATCH_SECONDS,
    ForwardedClient,
    Forwarder,
    RelayAnswer,
)
from relay_server.cluster.homes import RobotHomes
from relay_server.cluster.relays import RelayInfo
from relay_server.fleet.order import Order, TaskOutcome, body_of

PATH = "/api/v1/fleet"

AT_ONCE = 64
"""Orders that are sent at a time."""
PRECONDITION_REQUIRED = 428
"""The home must know how old the order is (RFC 6585 section 3)."""
MOST_ROBOTS = 200
"""Robots of an order that is sent."""


class OrderForwarding(Protocol):
    """Sends an order to the home of a robot."""

    async def send(
        self, principal: Principal, address: str, order: Order, robot: RobotRecord, earliest_sent: int | None
    ) -> TaskOutcome | None:
        """Have the home carry out an order on one robot.

        :param address: network address of the client
        :param earliest_sent: when it can have been sent, monotonic nanoseconds of this relay; ``None``: unknown
        :returns: ``None``: the robot is at no other relay
        :raises Unavailable: the home can't be reached
        """


class NoOrderForwarding:
    """The only relay has all robots (:class:`OrderForwarding`)."""

    async def send(
        self, principal: Principal, address: str, order: Order, robot: RobotRecord, earliest_sent: int | None
    ) -> TaskOutcome | None:
        """There is no other relay."""
        return None


class _OrderToHome:
    """An order for robots of one relay, and who waits for their outcomes.

    :param order: with all its robots
    """

    def __init__(
        self, relay: RelayInfo, order: Order, client: ForwardedClient, earliest_sent: int | None
    ) -> None:
        self.relay = relay
        self.order = order
        self.client = client
        self.earliest_sent = earliest_sent
        self.sending: Deferred[None] | None = None
        self._waiting: dict[str, Deferred[TaskOutcome]] = {}

    @property
    def robots(self) -> list[str]:
        """Robots without an outcome."""
        return list(self._waiting)

    def outcome(self, robot: str) -> Deferred[TaskOutcome]:
        """The outcome of a robot. When all who wait have cancelled, the order ends."""
        waiting = self._waiting[robot] = Deferred(lambda _: self._left(robot))
        return waiting

    def answered(self, line: bytes) -> None:
        """A line of the home's answer."""
        found = _object(line)
        robot = found.get("robot")
        waiting = self._waiting.pop(robot, None) if isinstance(robot, str) and "ok" in found else None
        if waiting is not None:
            waiting.callback(
                TaskOutcome(
                    bool(found["ok"]),
                    str(found.get("message", "")),
                    found.get("values"),
                    bool(found.get("pending")),
                )
            )

    def ended(self, status: int, answer: bytes) -> None:
        """The answer is complete.

        :param answer: its body, unless the status is 200
        """
        refusal = _object(answer).get("detail") if status != OK else None
        for robot in self.robots:
            waiting = self._waiting.pop(robot)
            if isinstance(refusal, str):
                waiting.callback(TaskOutcome(False, refusal))
            else:
                where = self.relay.address
                waiting.errback(
                    Unavailable(f"the relay that the robot is connected to gave no result ({where})")
                )

    def failed(self, failure: Failure) -> None:
        """No answer comes any more."""
        for robot in self.robots:
            self._waiting.pop(robot).errback(failure)

    def _left(self, robot: str) -> None:
        del self._waiting[robot]
        if not self._waiting and self.sending is not None:
            self.sending.cancel()


class ClusterOrders:
    """See :class:`OrderForwarding`.

    Robots of an order whose turn comes at the same time are sent together. A home that needs to know the age of the
    order refuses it first, with a freshness token. The order is then sent with that token, and with the time from
    when it can have been sent until the token was here: at least that much older than the token it is.

    :param reactor: Twisted's
    :param clock_ns: monotonic nanoseconds
    """

    def __init__(
        self, reactor: Any, homes: RobotHomes, forwarder: Forwarder, clock_ns: Callable[[], int] = now_ns
    ) -> None:
        self._reactor = reactor
        self._clock_ns = clock_ns
        self._homes = homes
        self._forwarder = forwarder
        self._turns = DeferredSemaphore(AT_ONCE)
        self._gathered: dict[tuple[str, ForwardedClient, int], _OrderToHome] = {}
        """Orders that are sent in a moment, by relay, client and identity of the order."""

    async def send(
        self, principal: Principal, address: str, order: Order, robot: RobotRecord, earliest_sent: int | None
    ) -> TaskOutcome | None:
        """See :meth:`OrderForwarding.send`."""
        relay = self._homes.elsewhere(robot.id)
        if relay is None:
            return None
        client = ForwardedClient.of(principal, address)
        key = relay.id, client, id(order)
        sent = self._gathered.get(key)
        if sent is None or len(sent.robots) >= MOST_ROBOTS:
            sent = self._gathered[key] = _OrderToHome(relay, order, client, earliest_sent)
            self._reactor.callLater(0, self._begin, key, sent)
        return await sent.outcome(robot.name)

    def _begin(self, key: tuple[str, ForwardedClient, int], sent: _OrderToHome) -> None:
        if self._gathered.get(key) is sent:
            del self._gathered[key]
        if sent.robots:
            sent.sending = Deferred.fromCoroutine(self._send(sent))
            sent.sending.addErrback(sent.failed)

    async def _send(self, sent: _OrderToHome) -> None:
        await self._turns.acquire()
        try:
            answer = await self._ask(sent, sent.client)
            if answer.status == PRECONDITION_REQUIRED and answer.freshness and sent.earliest_sent is not None:
                # The token was made before this moment.
                older = self._clock_ns() - sent.earliest_sent
                client = msgspec.structs.replace(sent.client, older_ns=older)
                answer = await self._ask(sent, client, answer.freshness)
        finally:
            self._turns.release()
        sent.ended(answer.status, answer.body)

    def _ask(self, sent: _OrderToHome, client: ForwardedClient, token: str = "") -> Awaitable[RelayAnswer]:
        body = body_of(sent.order, sent.robots)
        watch_seconds = STOP_WATCH_SECONDS if sent.order.do == "stop" else WATCH_SECONDS
        return self._forwarder.ask_lines(PATH, body, sent.relay, client, token, sent.answered, watch_seconds)


def _object(line: bytes) -> dict[str, Any]:
    try:
        found = jsontext.decode_any(line)
    except (SwitchboardError, msgspec.DecodeError):
        return {}
    return found if isinstance(found, dict) else {}
