"""Commands on elements of Roles: get, set, call, start, stop. Each goes to the resource that the element is bound to.

The rules are those of the resource: rights, control, freshness and limits are judged there, by the user's own rights.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from contextlib import AbstractAsyncContextManager
from typing import Any, Literal, NamedTuple, TypeVar

import msgspec

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, MalformedMessage, NotFound, SwitchboardError, Unavailable
from relay_protocol.nonfinite import NUMBERS, marks_to_null
from relay_server.access import Principal
from relay_server.audit_log import AuditLog, AuditLogEntry
from relay_server.cluster.element_commands import ElementForwarding, element_path, module_path
from relay_server.cluster.relays import RelayInfo
from relay_server.common.errors import NotDone
from relay_server.icpi.programs import ProgramRegistry, function_of, port_of
from relay_server.in_process_sessions.pool import RobotCaller
from relay_server.modules.admission import admitted_user
from relay_server.modules.service import ModuleService, ModuleUser
from relay_server.pipes.service import PipeService, pipe_user
from relay_server.resources.goals import GoalService
from relay_server.resources.service import MessageConditions, RobotResourceService
from relay_server.roles.bindings import (
    Binding,
    Command,
    ElementNotCommandable,
    choose,
    message_with,
    value_at,
)
from relay_server.roles.schemas import ElementCall, ElementDone, ElementValue, NewElementValue
from relay_server.roles.service import RoleService
from relay_server.sessions.manager import SessionManager

BOOL = "std_msgs/msg/Bool"
SET_BOOL = "std_srvs/srv/SetBool"
TRIGGER = "std_srvs/srv/Trigger"

SWITCH_SECONDS = 10.0
"""Time limit of a device's answer to a switch."""

DEVICE_SET = "/set"
"""A device takes commands on the topic of this name below that of its state."""

Switch = Literal["start", "stop"]
T = TypeVar("T")


class RoleUser(NamedTuple):
    """The sender of a command.

    :param earliest_sent: earliest time at which it was sent, the relay's monotonic nanoseconds; ``None``: not known
    """

    principal: Principal
    address: str
    earliest_sent: int | None = None

    def at(self, robot: str) -> RobotCaller:
        """The same for a robot."""
        return RobotCaller(self.principal, robot, self.address)


class RoleCommands:
    """
    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        roles: RoleService,
        resources: RobotResourceService,
        goals: GoalService,
        sessions: SessionManager,
        modules: ModuleService,
        pipes: PipeService,
        programs: ProgramRegistry,
        audit: AuditLog,
        wall: Callable[[], float],
        forwarding: ElementForwarding,
    ) -> None:
        self._forwarding = forwarding
        self._roles = roles
        self._resources = resources
        self._goals = goals
        self._sessions = sessions
        self._modules = modules
        self._pipes = pipes
        self._programs = programs
        self._audit = audit
        self._wall = wall

    # --- commands -----------------------------------------------------------------------------------------

    async def get(self, user: RoleUser, role: str, element: str) -> ElementValue:
        """The value of an element.

        :raises NotFound: there is no such Role, element, resource or field, or no right to see it
        :raises SwitchboardError: it can't be read
        """
        binding = await self._binding(user, role, element, "get")
        answer = await self._forwarded(user, binding, "GET", element_path(role, element))
        if answer is not None:
            return _decoded(answer, ElementValue)
        value = value_at(await self._read(user, binding), binding)
        return ElementValue(role, element, binding.text, value)

    async def set(self, user: RoleUser, role: str, element: str, new: NewElementValue) -> ElementDone:
        """Set the value of an element: publish a message, or set a parameter.

        :raises SwitchboardError: as :meth:`get`; it is refused
        """
        binding = await self._limited(user, role, element, "set")
        path, body = element_path(role, element), jsontext.encode(new)
        answer = await self._forwarded(user, binding, "PUT", path, body)
        if answer is not None:
            return _decoded(answer, ElementDone)
        if binding.kind == "params":
            if binding.pointer:
                raise Invalid(f"{binding.text}: a part of a parameter can't be set alone; set the parameter")
            await self._resources.set_param(
                user.at(binding.robot), binding.name, jsontext.encode(new.value), None
            )
        elif binding.kind == "ports":
            if binding.pointer:
                raise Invalid(f"{binding.text}: a part of a port can't be set alone; set the port")
            await self._ask_program(user, binding, "set", _json(new.value))
        else:
            await self._publish(user, binding, message_with(new.value, binding), new.type)
        return await self._done(user, role, element, "set", binding)

    async def call(self, user: RoleUser, role: str, element: str, call: ElementCall) -> ElementDone:
        """Call the service that an element is bound to, or have a goal executed by its action.

        :raises SwitchboardError: as :meth:`get`; it is refused, or the service failed
        """
        binding = await self._limited(user, role, element, "call")
        path, body = element_path(role, element, "call"), jsontext.encode(call)
        forwarded = await self._forwarded(user, binding, "POST", path, body)
        if forwarded is not None:
            return _decoded(forwarded, ElementDone)
        if binding.kind == "actions":
            answer = jsontext.decode_any(
                await self._goals.result(
                    user.at(binding.robot),
                    binding.name,
                    jsontext.encode(call.args),
                    call.timeout,
                    user.earliest_sent,
                )
            )
        elif binding.kind == "functions":
            answer = await self._ask_program(
                user, binding, "", *arguments_of(call.args), seconds=call.timeout
            )
        else:
            answer = await self._call(user, binding, call.args, call.timeout)
        return await self._done(user, role, element, "call", binding, values=value_at(answer, binding))

    async def switch(self, user: RoleUser, role: str, element: str, command: Switch) -> ElementDone:
        """Start or stop the module, pipe or device that an element is bound to. A stop has no limit of its own.

        The stop of an action cancels the user's goals.

        :raises SwitchboardError: as :meth:`get`; it is refused
        """
        find = self._limited if command == "start" else self._binding
        binding = await find(user, role, element, command)
        answer = await self._forwarded(user, binding, "POST", element_path(role, element, command))
        if answer is not None:
            return _decoded(answer, ElementDone)
        state = await self.switch_resource(user, binding, command)
        return await self._done(user, role, element, command, binding, state=state)

    async def switch_part(
        self, user: RoleUser, role: str, element: str, binding: Binding, command: Switch
    ) -> str:
        """As :meth:`switch_resource`, also for a robot that is at another relay.

        :param element: of the Role, which is bound to the resource; a module needs none
        """
        if binding.kind == "modules":
            path = module_path(binding.robot, binding.name, command)
        else:
            path = element_path(role, element, command)
        answer = await self._forwarded(user, binding, "POST", path)
        if answer is not None:
            return "" if binding.kind == "modules" else _decoded(answer, ElementDone).state
        return await self.switch_resource(user, binding, command)

    async def switch_resource(self, user: RoleUser, binding: Binding, command: Switch) -> str:
        """Start or stop a module, a pipe or a device; its state, as far as it is known.

        :raises SwitchboardError: it is refused, or fails
        """
        if binding.kind == "modules":
            async with self._module_user(user, binding.robot) as module_user:
                found = await self._modules.order(module_user, binding.name, command)
                return "pending" if found.pending else ""
        if binding.kind == "pipes":
            order = self._pipes.start_pipe if command == "start" else self._pipes.stop_pipe
            return (await order(pipe_user(user.principal, user.address), binding.name)).state
        if binding.kind == "programs":
            await self._ask_program(user, binding, command)
            return "on" if command == "start" else "off"
        if binding.kind == "actions":
            self._goals.cancel_all(user.at(binding.robot), binding.name)
            return ""
        await self._switch_device(user, binding, command)
        return "on" if command == "start" else "off"

    async def _forwarded(
        self, user: RoleUser, binding: Binding, method: str, path: str, body: bytes = b""
    ) -> bytes | None:
        """The answer of the relay that the robot of a resource is connected to; ``None``: this one."""
        if not binding.robot:
            return None
        return await self._forwarding.send(user.principal, user.address, binding.robot, method, path, body)

    async def relay_of(
        self,
        user: RoleUser,
        role: str,
        element: str,
        command: Command,
        relay_of_robot: Callable[[str], Awaitable[RelayInfo | None]],
    ) -> RelayInfo | None:
        """The other relay of the cluster that a command goes to; ``None``: this one.

        :param relay_of_robot: of a robot's name
        :raises SwitchboardError: as :meth:`get`
        """
        binding = await self._binding(user, role, element, command)
        if binding.kind == "pipes":
            return await self._pipes.relay_of(pipe_user(user.principal, user.address), binding.name)
        return await relay_of_robot(binding.robot) if binding.robot else None

    # --- resources ----------------------------------------------------------------------------------------

    async def _binding(self, user: RoleUser, role: str, element: str, command: Command) -> Binding:
        found = await self._roles.bindings(user.principal, role, element)
        return choose(element, command, found.own, found.mapped)

    async def _limited(self, user: RoleUser, role: str, element: str, command: Command) -> Binding:
        self._roles.count_change(user.principal)
        return await self._binding(user, role, element, command)

    async def _read(self, user: RoleUser, binding: Binding) -> Any:
        if binding.kind == "ports":
            return await self._ask_program(user, binding, "get")
        caller = user.at(binding.robot)
        if binding.kind == "topics":
            state = await self._resources.newest_message(caller, binding.name, MessageConditions())
            return jsontext.decode_any(state.value)
        if binding.kind == "params":
            return jsontext.decode_any((await self._resources.param(caller, binding.name)).value)
        if binding.kind == "pipes":
            pipe = await self._pipes.pipe(pipe_user(user.principal, user.address), binding.name)
            return msgspec.to_builtins(pipe)
        async with self._module_user(user, binding.robot) as module_user:
            return msgspec.to_builtins(await self._modules.module(module_user, binding.name))

    async def _publish(self, user: RoleUser, binding: Binding, message: Any, type_name: str = "") -> None:
        caller, topic = user.at(binding.robot), binding.name
        if not type_name and await self._type(caller, "topics", topic + DEVICE_SET):
            topic += DEVICE_SET
        body = msgspec.Raw(jsontext.encode(message))
        await self._resources.publish(caller, topic, body, type_name, user.earliest_sent)

    async def _call(self, user: RoleUser, binding: Binding, args: Any, seconds: float) -> Any:
        body = msgspec.Raw(jsontext.encode(args))
        caller = user.at(binding.robot)
        answer = await self._resources.call(caller, binding.name, body, "", seconds, user.earliest_sent)
        return jsontext.decode_any(answer)

    async def _ask_program(
        self, user: RoleUser, binding: Binding, function: str, *values: str, seconds: float = SWITCH_SECONDS
    ) -> Any:
        """Have a program of the user carry out a function, or ``get`` or ``set`` of a port; the value of its reply.

        :param function: empty for that of the binding
        :raises NotFound: the user has no such program, or it has no such port or function
        """
        user.principal.require_full_scope()
        name, _, part = binding.name.partition("/")
        program = self._programs.find(user.principal.user_id, name)
        if binding.kind == "ports":
            values = (port_of(program, part), *values)
        else:
            function = function_of(program, function or part)
        value = await program.request(function, values, "relay", seconds)
        try:
            return jsontext.decode_any(value.encode())
        except MalformedMessage:
            return value

    async def _switch_device(self, user: RoleUser, binding: Binding, command: Switch) -> None:
        """:raises ElementNotCommandable: it can't be switched"""
        on, caller = command == "start", user.at(binding.robot)
        found = await self._type(caller, binding.kind, binding.name)
        if binding.kind == "topics" and found in (BOOL, ""):
            await self._publish(user, binding, {"data": on}, "" if found else BOOL)
        elif found == SET_BOOL:
            _check_answer(binding, await self._call(user, binding, {"data": on}, SWITCH_SECONDS))
        elif found == TRIGGER and on:
            _check_answer(binding, await self._call(user, binding, {}, SWITCH_SECONDS))
        else:
            raise ElementNotCommandable(
                f"{binding.text} has the type {found or 'unknown'}, which can't be switched {'on' if on else 'off'}; "
                f"devices are topics of {BOOL} and services of {SET_BOOL}"
                + (f"; a service of {TRIGGER} can only be started" if found == TRIGGER else "")
            )

    async def _type(self, caller: RobotCaller, kind: str, name: str) -> str:
        """The type of a topic or service; empty if there is none that the user may see."""
        try:
            types = (await self._resources.member(caller, kind, name))["types"]
        except NotFound:
            return ""
        return types[0] if types else ""

    def _module_user(self, user: RoleUser, robot: str) -> AbstractAsyncContextManager[ModuleUser]:
        return admitted_user(self._sessions, user.principal, robot, user.address)

    async def _done(
        self, user: RoleUser, role: str, element: str, command: Command, binding: Binding, **more: Any
    ) -> ElementDone:
        self._audit.append(
            AuditLogEntry(
                self._wall(),
                f"user:{user.principal.full}",
                f"element.{command}",
                f"{role}/{element}@{user.principal.realm}",
                user.address,
                {"resource": binding.text},
                await self._robots_of(user, binding),
            )
        )
        return ElementDone(role, element, command, binding.text, **more)

    async def _robots_of(self, user: RoleUser, binding: Binding) -> tuple[int, ...]:
        """Numbers of the robots that an audit entry about a resource is about."""
        if not binding.robot:
            return ()
        try:
            async with self._sessions.admitted(user.principal, binding.robot, user.address) as admission:
                return (admission.robot.robot_id,)
        except SwitchboardError:
            # The right has ended meanwhile, or the database does not answer.
            return ()


def _decoded(answer: bytes, kind: type[T]) -> T:
    """:raises Unavailable: the answer of another relay can't be read"""
    try:
        return msgspec.convert(jsontext.decode_any(answer), kind)
    except (MalformedMessage, msgspec.MsgspecError):
        raise Unavailable("the answer of the relay that the robot is connected to can't be read") from None


def arguments_of(args: Any) -> list[str]:
    """Arguments of a program's function: JSON of each; a text as it is.

    :raises Invalid: they have names
    """
    if isinstance(args, dict) and not args:
        return []
    if not isinstance(args, list):
        raise Invalid("a function of a program takes 'args' as a list")
    return [each if isinstance(each, str) and each not in NUMBERS else _json(each) for each in args]


def _json(value: Any) -> str:
    """JSON for a program: NaN and infinity are ``null``."""
    return marks_to_null(jsontext.encode(value)).decode()


def _check_answer(binding: Binding, answer: Any) -> None:
    """:raises NotDone: the answer of a switch says that it failed"""
    if not answer.get("success"):
        raise NotDone(f"{binding.text} refused: {answer.get('message') or 'without a reason'}")
