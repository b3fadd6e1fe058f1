"""``/relay/…`` services about pipes."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

import msgspec

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, MalformedMessage
from relay_server.pipes.schemas import NewPipe, PipeStatus
from relay_server.pipes.service import PipeService, PipeUser, pipe_user
from relay_server.relay_node.arguments import text
from relay_server.sessions.context import ClientContext


class PipeRosServices:
    """The services about pipes, of all robots, for one client at a time."""

    def __init__(self, service: PipeService) -> None:
        self._service = service

    def handlers(self) -> dict[str, Callable[[ClientContext, Any], Coroutine[Any, Any, Any]]]:
        """Services by name."""
        return {
            "/relay/pipes": self.pipes,
            "/relay/add_pipe": self.add,
            "/relay/start_pipe": self.start,
            "/relay/stop_pipe": self.stop,
            "/relay/remove_pipe": self.remove,
        }

    async def pipes(self, client: ClientContext, args: Any) -> Any:
        """``/relay/pipes``"""
        found = await self._service.pipes(_user(client))
        return {"pipes": [_plain(each) for each in found.pipes]}

    async def add(self, client: ClientContext, args: Any) -> Any:
        """``/relay/add_pipe``: ``pipe`` is JSON, as the body of ``POST /api/v1/pipes``."""
        try:
            new = jsontext.decode(_new_pipe, text(args, "pipe").encode())
        except MalformedMessage as error:
            raise Invalid(f"'pipe' is no pipe: {error}") from None
        return _result(await self._service.add(_user(client), new))

    async def start(self, client: ClientContext, args: Any) -> Any:
        """``/relay/start_pipe``"""
        return _result(await self._service.start_pipe(_user(client), text(args, "pipe")))

    async def stop(self, client: ClientContext, args: Any) -> Any:
        """``/relay/stop_pipe``"""
        return _result(await self._service.stop_pipe(_user(client), text(args, "pipe")))

    async def remove(self, client: ClientContext, args: Any) -> Any:
        """``/relay/remove_pipe``"""
        name = text(args, "pipe")
        await self._service.remove(_user(client), name)
        return {"success": True, "message": f"pipe {name} is removed", "state": ""}


_new_pipe = msgspec.json.Decoder(NewPipe)


def _user(client: ClientContext) -> PipeUser:
    return pipe_user(client.permit.principal, client.address)


def _result(pipe: PipeStatus) -> dict[str, Any]:
    words = f"pipe {pipe.name} is {pipe.state}" + (f": {pipe.why}" if pipe.why else "")
    return {"success": pipe.state != "refused", "message": words, "state": pipe.state}


def _plain(pipe: PipeStatus) -> dict[str, Any]:
    """A pipe as a ROS message, which knows no null."""
    return {
        "name": pipe.name,
        "owner": pipe.owner,
        "source_robot": pipe.source.robot,
        "source_topic": pipe.source.topic,
        "source_service": pipe.source.service,
        "source_action": pipe.source.action,
        "source_program": pipe.source.program,
        "source_port": pipe.source.port,
        "source_function": pipe.source.function,
        "target_robot": pipe.target.robot,
        "target_topic": pipe.target.topic,
        "target_service": pipe.target.service,
        "target_action": pipe.target.action,
        "target_program": pipe.target.program,
        "target_port": pipe.target.port,
        "target_function": pipe.target.function,
        "rate": pipe.rate,
        "state": pipe.state,
        "why": pipe.why,
        "moves": pipe.moves,
        "messages": pipe.messages,
        "drops": pipe.drops,
        "encoded": pipe.encoded,
        "latency_ms": pipe.latency_ms or 0.0,
    }
