"""``/relay/…`` services about elements of Roles. Values are JSON text, as elements have any type."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

import msgspec

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, MalformedMessage
from relay_server.relay_node.arguments import get_argument, text
from relay_server.roles.commands import RoleCommands, RoleUser, Switch
from relay_server.roles.runs import RoleRuns
from relay_server.roles.schemas import ElementCall, NewElementValue, RoleRunState
from relay_server.sessions.context import ClientContext


class RoleRosServices:
    """The services about elements of Roles, for one client at a time."""

    def __init__(self, commands: RoleCommands, runs: RoleRuns) -> None:
        self._commands = commands
        self._runs = runs

    def handlers(self) -> dict[str, Callable[[ClientContext, Any], Coroutine[Any, Any, Any]]]:
        """Services by name."""
        return {
            "/relay/get_element": self.get,
            "/relay/set_element": self.set,
            "/relay/call_element": self.call,
            "/relay/start_element": self.start,
            "/relay/stop_element": self.stop,
            "/relay/start_role": self.start_role,
            "/relay/stop_role": self.stop_role,
        }

    async def get(self, client: ClientContext, args: Any) -> Any:
        """``/relay/get_element``"""
        found = await self._commands.get(_user(client), *_element(args))
        return {"success": True, "message": found.resource, "value": jsontext.encode(found.value).decode()}

    async def set(self, client: ClientContext, args: Any) -> Any:
        """``/relay/set_element``"""
        user, new = _user(client), NewElementValue(_json(args, "value", 2), text(args, "type", 3, ""))
        done = await self._commands.set(user, *_element(args), new)
        return {"success": True, "message": f"{done.resource} is set"}

    async def call(self, client: ClientContext, args: Any) -> Any:
        """``/relay/call_element``"""
        user, timeout = _user(client), get_argument(args, "timeout", 3, 10.0)
        fields = {"args": _json(args, "args", 2, "{}"), "timeout": timeout}
        try:
            call = msgspec.convert(fields, ElementCall)
        except msgspec.ValidationError as error:
            raise Invalid(f"this is no call: {error}") from None
        done = await self._commands.call(user, *_element(args), call)
        values = jsontext.encode(done.values).decode()
        return {"success": True, "message": f"{done.resource} has answered", "values": values}

    async def start(self, client: ClientContext, args: Any) -> Any:
        """``/relay/start_element``"""
        return await self._switch(client, args, "start")

    async def stop(self, client: ClientContext, args: Any) -> Any:
        """``/relay/stop_element``"""
        return await self._switch(client, args, "stop")

    async def start_role(self, client: ClientContext, args: Any) -> Any:
        """``/relay/start_role``"""
        return _run(await self._runs.start(_user(client), text(args, "role")))

    async def stop_role(self, client: ClientContext, args: Any) -> Any:
        """``/relay/stop_role``"""
        return _run(await self._runs.stop(_user(client), text(args, "role")))

    async def _switch(self, client: ClientContext, args: Any, command: Switch) -> Any:
        done = await self._commands.switch(_user(client), *_element(args), command)
        words = f"{command} of {done.resource}" + (f": {done.state}" if done.state else "")
        return {"success": True, "message": words, "state": done.state}


def _run(state: RoleRunState) -> dict[str, Any]:
    failed = [
        f"{each.element}: {each.why}" for each in state.parts if each.state in ("failed", "refused", "")
    ]
    return {"success": not failed, "message": "; ".join(failed) or state.why, "state": state.state}


def _user(client: ClientContext) -> RoleUser:
    return RoleUser(client.permit.principal, client.address, client.earliest_sent)


def _element(args: Any) -> tuple[str, str]:
    """:raises Invalid: Role or element is missing"""
    return text(args, "role"), text(args, "element", 1)


def _json(args: Any, field: str, position: int, default: str | None = None) -> Any:
    """:raises Invalid: it is left out, or no JSON"""
    try:
        return jsontext.decode_any(text(args, field, position, default).encode())
    except MalformedMessage as error:
        raise Invalid(f"'{field}' must be JSON text: {error}") from None
