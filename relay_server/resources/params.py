"""Parameters of a robot's nodes, by the relay's own services for them (``/rosapi/…``)."""

from __future__ import annotations

from typing import Any

import msgspec

from relay_protocol import jsontext
from relay_protocol.errors import NotFound, Refused
from relay_server.control.commands import NotDone
from relay_server.http_sessions.pool import PooledSession

SECONDS = 10.0
"""A node has so long to answer."""


async def names(guest: PooledSession) -> list[str]:
    """All there are, as ``<node>:<parameter>``."""
    found: list[str] = (await _ask(guest, "get_param_names"))["names"]
    return found


async def value(guest: PooledSession, name: str) -> bytes:
    """JSON of one.

    :raises NotFound: there is none
    """
    said = await _ask(guest, "get_param", name=name)
    if not said["successful"]:
        raise NotFound(str(said["reason"]) or f"there is no parameter {name}")
    return str(said["value"]).encode()


async def set_value(guest: PooledSession, name: str, json: bytes) -> None:
    """Set one.

    :param json: any JSON
    :raises NotDone: its node says why not
    """
    _see(await _ask(guest, "set_param", name=name, value=json.decode()))


async def remove(guest: PooledSession, name: str) -> None:
    """Delete one.

    :raises NotDone: its node says why not
    """
    _see(await _ask(guest, "delete_param", name=name))


async def _ask(guest: PooledSession, service: str, **args: Any) -> Any:
    answer = await guest.client.call(
        f"/rosapi/{service}", msgspec.Raw(jsontext.encode(args)), timeout=SECONDS
    )
    if not answer.result:
        raise Refused(str(answer.read))
    return answer.read


def _see(said: Any) -> None:
    if not said["successful"]:
        raise NotDone(str(said["reason"]))
