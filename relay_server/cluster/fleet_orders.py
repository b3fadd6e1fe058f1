"""Orders to many robots, for those whose home is another relay: each is sent there as an order to one robot."""

from __future__ import annotations

from typing import Any, Protocol

import msgspec
from twisted.internet.defer import DeferredSemaphore

from relay_db.queries import RobotRecord
from relay_protocol import jsontext
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.access import Principal
from relay_server.cluster.forwarding import ForwardedClient, Forwarder
from relay_server.cluster.homes import RobotHomes
from relay_server.cluster.relays import RelayInfo
from relay_server.fleet.order import Order, TaskOutcome, body_of

PATH = "/api/v1/fleet"

AT_ONCE = 64
"""Orders that are sent at a time."""


class OrderForwarding(Protocol):
    """Sends an order to the home of a robot."""

    async def send(
        self, principal: Principal, address: str, order: Order, robot: RobotRecord
    ) -> TaskOutcome | None:
        """Have the home carry out an order on one robot.

        :param address: network address of the client
        :returns: ``None``: the robot is at no other relay
        :raises Unavailable: the home can't be reached
        """


class NoOrderForwarding:
    """The only relay has all robots (:class:`OrderForwarding`)."""

    async def send(
        self, principal: Principal, address: str, order: Order, robot: RobotRecord
    ) -> TaskOutcome | None:
        """There is no other relay."""
        return None


class ClusterOrders:
    """See :class:`OrderForwarding`. Orders go without their age, so the home refuses those that need one."""

    def __init__(self, homes: RobotHomes, forwarder: Forwarder) -> None:
        self._homes = homes
        self._forwarder = forwarder
        self._turns = DeferredSemaphore(AT_ONCE)

    async def send(
        self, principal: Principal, address: str, order: Order, robot: RobotRecord
    ) -> TaskOutcome | None:
        """See :meth:`OrderForwarding.send`."""
        relay = self._homes.elsewhere(robot.id)
        if relay is None:
            return None
        client = ForwardedClient.of(principal, address)
        await self._turns.acquire()
        try:
            body = body_of(order, robot.name)
            status, answer = await self._forwarder.ask("POST", PATH, body, relay, client)
        finally:
            self._turns.release()
        return outcome_of(status, answer, relay)


def outcome_of(status: int, answer: bytes, relay: RelayInfo) -> TaskOutcome:
    """The outcome in the home's answer: lines of JSON, or problem details.

    :raises Unavailable: there is none in it
    """
    for line in answer.splitlines():
        found = _object(line)
        if status == 200 and "ok" in found and "robot" in found:
            return TaskOutcome(
                bool(found["ok"]),
                str(found.get("message", "")),
                found.get("values"),
                bool(found.get("pending")),
            )
        if status != 200 and isinstance(found.get("detail"), str):
            return TaskOutcome(False, found["detail"])
    raise Unavailable(f"the relay that the robot is connected to gave no result ({relay.address})")


def _object(line: bytes) -> dict[str, Any]:
    try:
        found = jsontext.decode_any(line)
    except (SwitchboardError, msgspec.DecodeError):
        return {}
    return found if isinstance(found, dict) else {}
