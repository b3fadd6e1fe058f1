"""Parameters of a robot's nodes, by the relay's own services for them (``/rosapi/…``)."""

from __future__ import annotations

from typing import Any

from relay_protocol.errors import NotFound
from relay_server.common.errors import NotDone
from relay_server.in_process_sessions.pool import PooledSession


async def names(pooled: PooledSession) -> list[str]:
    """All there are, as ``<node>:<parameter>``."""
    found: list[str] = (await _ask(pooled, "get_param_names"))["names"]
    return found


async def value(pooled: PooledSession, name: str) -> bytes:
    """JSON of one.

    :raises NotFound: there is none
    """
    answer = await _ask(pooled, "get_param", name=name)
    if not answer["successful"]:
        raise NotFound(str(answer["reason"]) or f"there is no parameter {name}")
    return str(answer["value"]).encode()


async def set_value(pooled: PooledSession, name: str, json: bytes) -> None:
    """Set a parameter.

    :param json: any JSON
    :raises NotDone: its node refuses, with the reason
    """
    _check(await _ask(pooled, "set_param", name=name, value=json.decode()))


async def remove(pooled: PooledSession, name: str) -> None:
    """Delete a parameter.

    :raises NotDone: its node refuses, with the reason
    """
    _check(await _ask(pooled, "delete_param", name=name))


async def _ask(pooled: PooledSession, service: str, **args: Any) -> Any:
    return await pooled.port.call_own(f"/rosapi/{service}", args)


def _check(answer: Any) -> None:
    if not answer["successful"]:
        raise NotDone(str(answer["reason"]))
