"""``/relay/…`` services about functions."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

import msgspec

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, MalformedMessage
from relay_protocol.functions import FAULTS, to_json
from relay_server.offload.jobs import Job
from relay_server.offload.service import FunctionService, job_owner
from relay_server.relay_node.arguments import get_argument, text, whole_number
from relay_server.sessions.context import ClientContext

MAX_TIMEOUT = 60.0


class FunctionRosServices:
    """The services about functions, of all robots, for one client at a time."""

    def __init__(self, service: FunctionService) -> None:
        self._service = service

    def handlers(self) -> dict[str, Callable[[ClientContext, Any], Coroutine[Any, Any, Any]]]:
        """Services by name."""
        return {
            "/relay/functions": self.functions,
            "/relay/call_function": self.call,
            "/relay/function_job": self.job,
        }

    async def functions(self, client: ClientContext, args: Any) -> Any:
        """``/relay/functions``"""
        found = await self._service.functions(client.permit.principal)
        return {
            "functions": [
                {
                    "name": each.name,
                    "version": each.version,
                    "text": each.text,
                    "arguments": msgspec.json.encode(each.arguments).decode(),
                    "result": msgspec.json.encode(each.result).decode(),
                }
                for each in found.functions
            ]
        }

    async def call(self, client: ClientContext, args: Any) -> Any:
        """``/relay/call_function``: ``arguments`` is JSON. It counts for the robot of the connection."""
        name, version = text(args, "function"), whole_number(args, "version", 2, 0)
        timeout = _seconds(args, "timeout", 3)
        try:
            given = jsontext.decode_any((text(args, "arguments", 1, "") or "{}").encode())
            arguments = msgspec.msgpack.encode(given)
        except (MalformedMessage, *FAULTS) as error:
            raise Invalid(f"'arguments' can't be read: {error}") from None
        owner, payer = await self._service.user(client.permit.principal, name, client.robot.name)
        job = await self._service.submit(
            owner, name, arguments, version=version or None, payer=payer, keep=timeout <= 0
        )
        await self._service.wait(job, timeout)
        if not job.over:
            await self._service.keep(job)
        return _state(job)

    async def job(self, client: ClientContext, args: Any) -> Any:
        """``/relay/function_job``"""
        principal = client.permit.principal
        job = await self._service.job(job_owner(principal), text(args, "job"), admin=principal.admin)
        await self._service.require_reach(principal, job)
        if get_argument(args, "cancel", 2, False) is True:
            await self._service.remove(job)
        await self._service.wait(job, _seconds(args, "wait", 1))
        return {**_state(job), "progress": job.progress}


def _seconds(args: Any, name: str, position: int) -> float:
    value = get_argument(args, name, position, 0)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= MAX_TIMEOUT:
        raise Invalid(f"'{name}' must be a number of seconds from 0 to {MAX_TIMEOUT:g}")
    return float(value)


def _state(job: Job) -> dict[str, Any]:
    status, outcome = job.status(), job.outcome
    value = b"" if outcome is None or outcome.value is None else to_json(outcome.value)
    return {
        "success": status.state not in ("failed", "cancelled"),
        "job": job.id,
        "state": status.state,
        "result": value.decode(),
        "code": status.code,
        "message": status.error,
    }
