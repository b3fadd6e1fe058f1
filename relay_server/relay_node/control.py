"""``/relay/…`` services about control: from arguments to :class:`relay_server.control.service.ControlService`."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

from relay_protocol.errors import Invalid, Refused, SwitchboardError
from relay_server.control import view
from relay_server.control.actor import actor_of
from relay_server.control.service import ControlService
from relay_server.control.types import ControlReply
from relay_server.relay_node.arguments import get_argument, stop_arguments, text, whole_number
from relay_server.sessions.context import ClientContext


class ControlRosServices:
    """The services about control, for one client at a time."""

    def __init__(self, control: ControlService) -> None:
        self._control = control

    def handlers(self) -> dict[str, Callable[[ClientContext, Any], Coroutine[Any, Any, Any]]]:
        """By name."""
        return {
            "/relay/take_control": _errors_as_replies(self.take_control),
            "/relay/release_control": _errors_as_replies(self.release_control),
            "/relay/grant_control": _errors_as_replies(self.grant_control),
            "/relay/refuse_control": _errors_as_replies(self.refuse_control),
            "/relay/stop": _errors_as_replies(self.stop, done=False, stopped=None),
            "/relay/resume": _errors_as_replies(self.resume),
            "/relay/suppress": _errors_as_replies(self.suppress),
            "/relay/inhibit": _errors_as_replies(self.inhibit),
        }

    async def take_control(self, client: ClientContext, args: Any) -> Any:
        """``/relay/take_control``"""
        return (await self._control.take(client, _why(args)))._asdict()

    async def release_control(self, client: ClientContext, args: Any) -> Any:
        """``/relay/release_control``"""
        return self._control.release(client, _why(args))._asdict()

    async def grant_control(self, client: ClientContext, args: Any) -> Any:
        """``/relay/grant_control``"""
        return self._control.grant(client, _why(args), whole_number(args, "client", 1, 0))._asdict()

    async def refuse_control(self, client: ClientContext, args: Any) -> Any:
        """``/relay/refuse_control``"""
        return self._control.refuse(client, _why(args), whole_number(args, "client", 1, 0))._asdict()

    async def stop(self, client: ClientContext, args: Any) -> Any:
        """``/relay/stop``: any right on the robot is enough, which every session has.

        ``done``: the robot has done all of it. If it has not, ``success`` is true when it stops as soon as it is back,
        and false when a part of the stop failed or nothing is known. ``stopped`` is null only when nothing is known.
        """
        why, stop_id = stop_arguments(args)
        try:
            result = await self._control.stop(client.robot, actor_of(client), why, stop_id)
        finally:
            # A client that has this answer may resume at once.
            client.port.ping()
        return result.values(client.robot.name)

    async def resume(self, client: ClientContext, args: Any) -> Any:
        """``/relay/resume``: one that may have been sent before the latest stop is refused."""
        actor, why, earliest_sent = actor_of(client), _why(args), client.earliest_sent
        await self._control.resume(client.robot, client.permit, actor, why, earliest_sent, client)
        return ControlReply(True, f"robot {client.robot.name} may move again")._asdict()

    async def suppress(self, client: ClientContext, args: Any) -> Any:
        """``/relay/suppress``"""
        topic, ms = text(args, "resource"), whole_number(args, "ms", 1, 100)
        actor, sources = actor_of(client), [client.number]
        topic = await self._control.suppress(client.robot, client.permit, actor, sources, topic, ms)
        return ControlReply(
            True, f"{topic} obeys you for {ms} ms" if ms else f"{topic} is not suppressed"
        )._asdict()

    async def inhibit(self, client: ClientContext, args: Any) -> Any:
        """``/relay/inhibit``"""
        topic, ms = text(args, "resource"), whole_number(args, "ms", 1, 1000)
        hold = get_argument(args, "hold", 2, False)
        if not isinstance(hold, bool):
            raise Invalid("'hold' must be true or false")
        actor = actor_of(client)
        topic, inhibited = self._control.inhibit(client.robot, client.permit, actor, topic, ms, hold, client)
        await inhibited
        return ControlReply(
            True, f"{topic} is inhibited for {ms} ms" if ms else f"{topic} is not inhibited"
        )._asdict()


def control_state(client: ClientContext) -> dict[str, Any]:
    """``/relay/control``: the state of control, for one client."""
    reader = view.ControlReader(client.permit.rules, lambda each: each is client)
    return dict(view.control(client.controller, reader, client.number))


def _errors_as_replies(
    service: Callable[[ClientContext, Any], Coroutine[Any, Any, Any]], **fields: Any
) -> Callable[[ClientContext, Any], Coroutine[Any, Any, Any]]:
    """Wrap a service: a request that fails is answered without success; one that is refused or invalid fails the call.

    :param fields: further fields of the answer to a request that fails
    """

    async def answered(client: ClientContext, args: Any) -> Any:
        try:
            return await service(client, args)
        except (Refused, Invalid):
            raise
        except SwitchboardError as error:
            return {**ControlReply(False, str(error))._asdict(), **fields}

    return answered


def _why(args: Any) -> str:
    return text(args, "why", default="")
