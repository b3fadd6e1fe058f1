"""``/relay/…`` services and topics about modules and processes."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any

import msgspec

from relay_protocol import link
from relay_protocol.errors import Invalid, Refused
from relay_server.modules.schemas import LogQuery, ModuleStatus, ProcessStatus
from relay_server.modules.service import ModuleService, ModuleUser, user_of
from relay_server.relay_node.arguments import text, whole_number
from relay_server.sessions.context import ClientContext

MODULES = "/relay/modules"
PROCESSES = "/relay/processes"

NO_ORDER = {"action": "", "by": "", "at": 0.0}
"""Of a module without a pending order."""

NO_REFUSAL = {**NO_ORDER, "why": ""}
"""Of a module without a refused order."""


class ModuleRosServices:
    """The services and topics about modules, for one client at a time."""

    def __init__(self, service: ModuleService) -> None:
        self._service = service

    def handlers(self) -> dict[str, Callable[[ClientContext, Any], Coroutine[Any, Any, Any]]]:
        """Services by name."""
        actions: tuple[link.ModuleAction, ...] = ("start", "stop", "restart")
        orders = {f"/relay/{action}_module": partial(self.order, action) for action in actions}
        return {**orders, "/relay/module_log": self.log}

    def topics(self) -> dict[str, Callable[[ClientContext], dict[str, Any]]]:
        """Makers of messages by topic."""
        return {MODULES: self.modules, PROCESSES: self.processes}

    async def order(self, action: link.ModuleAction, client: ClientContext, args: Any) -> Any:
        """``/relay/start_module``, ``/relay/stop_module`` and ``/relay/restart_module``"""
        name = text(args, "module")
        done = await self._service.order(_user(client), name, action)
        words = f"{done.why}; '{action}' of {name} is pending, and carried out when it answers or is back"
        return {"success": True, "message": words if done.pending else f"{action} of {name} is accepted"}

    async def log(self, client: ClientContext, args: Any) -> Any:
        """``/relay/module_log``: lines behind the offset ``after`` or in front of ``before``; else the newest ones."""
        fields = {
            "after": whole_number(args, "after", 1, 0) or None,
            "limit": whole_number(args, "limit", 2, 100),
            "before": whole_number(args, "before", 3, 0) or None,
            "level": text(args, "level", 4, "") or "debug",
        }
        try:
            query = msgspec.convert(fields, LogQuery)
        except msgspec.ValidationError as error:
            raise Invalid(str(error)) from None
        return msgspec.to_builtins(await self._service.read_log(_user(client), text(args, "module"), query))

    def modules(self, client: ClientContext) -> dict[str, Any]:
        """``/relay/modules``: those that the client may manage."""
        found = self._service.latest_modules(_user(client))
        modules = [_plain(each) for each in found.modules]
        return {
            "robot": found.robot,
            "online": found.online,
            "current": found.current,
            "reported_at": found.reported_at or 0.0,
            "modules": modules,
        }

    def processes(self, client: ClientContext) -> dict[str, Any]:
        """``/relay/processes``: measured while it is subscribed; the last ones while the robot is offline."""
        try:
            found = self._service.latest_processes(_user(client))
        except Refused as error:
            return {"at": 0.0, "processes": [], "more": 0, "error": str(error)}
        rows = [_row(each) for each in found.processes]
        online = client.robot.control_link is not None
        stale = "" if online else f"robot {client.robot.name} is offline; these were measured before"
        return {"at": found.at, "processes": rows, "more": found.more, "error": stale}


def _user(client: ClientContext) -> ModuleUser:
    return user_of(client.robot, client.permit, client.address)


def _plain(module: ModuleStatus) -> dict[str, Any]:
    """A module as a ROS message, which knows no null."""
    fields = msgspec.to_builtins(module)
    orders = {"pending": fields["pending"] or NO_ORDER, "refused": fields["refused"] or NO_REFUSAL}
    return {**fields, **orders, "pid": module.pid or 0}


def _row(process: ProcessStatus) -> dict[str, Any]:
    fields = msgspec.structs.asdict(process)
    return {**fields, "cpu": process.cpu or 0.0, "cpu_number": process.cpu_number or 0}
