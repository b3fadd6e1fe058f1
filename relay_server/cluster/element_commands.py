"""Commands on elements of Roles whose robot is at another relay: each is sent there as a request of the HTTP API."""

from __future__ import annotations

from typing import Protocol
from urllib.parse import quote

import msgspec

from relay_protocol.errors import NotFound, Refused, SwitchboardError, Unavailable
from relay_server.access import Access, Principal
from relay_server.cluster.forwarding import ForwardedClient, Forwarder
from relay_server.cluster.homes import RobotHomes

_ERRORS: dict[int, type[SwitchboardError]] = {403: Refused, 404: NotFound}


class _Problem(msgspec.Struct):
    """Problem details (RFC 9457)."""

    detail: str = ""


class ElementForwarding(Protocol):
    """Sends a command to the relay that a robot is connected to."""

    async def send(
        self, principal: Principal, address: str, robot: str, method: str, path: str, body: bytes
    ) -> bytes | None:
        """Have the robot's home carry out a command.

        :param address: network address of the client
        :param path: below ``/api/v1/``, escaped
        :param body: JSON, or empty
        :returns: the body of the answer; ``None``: the robot is at no other relay
        :raises SwitchboardError: the home refuses, or can't be reached
        """


class NoElementForwarding:
    """The only relay has all robots (:class:`ElementForwarding`)."""

    async def send(
        self, principal: Principal, address: str, robot: str, method: str, path: str, body: bytes
    ) -> bytes | None:
        """There is no other relay."""
        return None


class ClusterElements:
    """See :class:`ElementForwarding`. Commands go without their age, so the home refuses those that need one."""

    def __init__(self, homes: RobotHomes, access: Access, forwarder: Forwarder) -> None:
        self._homes = homes
        self._access = access
        self._forwarder = forwarder

    async def send(
        self, principal: Principal, address: str, robot: str, method: str, path: str, body: bytes
    ) -> bytes | None:
        """See :meth:`ElementForwarding.send`."""
        found = await self._access.permit_by_name(principal, robot)
        if found is None:
            # The rules of this relay say so.
            return None
        record, permit = found
        self._access.release(permit)
        relay = self._homes.elsewhere(record.id)
        if relay is None:
            return None
        client = ForwardedClient.of(principal, address)
        status, answer = await self._forwarder.ask(method, f"/api/v1/{path}", body, relay, client)
        if status in (200, 202):
            return answer
        raise _error_of(status, answer)


def _error_of(status: int, answer: bytes) -> SwitchboardError:
    try:
        detail = msgspec.json.decode(answer, type=_Problem).detail
    except msgspec.MsgspecError:
        detail = ""
    kind = _ERRORS.get(status, Unavailable)
    return kind(detail or f"the relay that the robot is connected to answered {status}")


def element_path(role: str, element: str, command: str = "") -> str:
    """The path of an element below ``/api/v1/``, or of a command on it."""
    return _path("roles", role, "elements", element, *([command] if command else []))


def module_path(robot: str, module: str, command: str) -> str:
    """The path of a command on a module below ``/api/v1/``."""
    return _path("robots", robot, "modules", module, command)


def _path(*parts: str) -> str:
    return "/".join(quote(each, safe="") for each in parts)
