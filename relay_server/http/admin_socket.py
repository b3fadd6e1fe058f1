"""The local socket: HTTP over a unix socket that only the relay's own user can open (mode 0600)."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any, Literal, Protocol

import msgspec
from klein import Klein
from twisted.internet.defer import CancelledError, Deferred
from twisted.web.server import Request

from relay_db.names import full_name_of
from relay_protocol import jsontext
from relay_protocol.errors import Invalid, SwitchboardError
from relay_server.cluster.admin import ClusterAdmin
from relay_server.cluster.relays import RelayInfo
from relay_server.common.concurrency import shield
from relay_server.common.data_dir import SENT_HEADER, parse_sent
from relay_server.control.gateway import StopAllResult
from relay_server.control.stop_fields import reason_in, stop_id_in
from relay_server.fleet.http import is_stop
from relay_server.http.problems import problem_of
from relay_server.modules.schemas import LogQuery
from relay_server.modules.service import ModuleService
from relay_server.pipes.schemas import NewPipe, PipeList
from relay_server.pipes.service import PipeService, local_pipe_user, merge_pipes
from relay_server.roles.local import LocalRoles
from relay_server.roles.schemas import ElementCall, NewElementValue


class StopService(Protocol):
    """Stops and resumes robots; see :class:`relay_server.control.gateway.ControlGateway`."""

    async def stop_locally(self, robot: str | None, why: str, by: str, stop_id: str) -> StopAllResult:
        """Stop a robot, or all."""

    async def resume_locally(self, robot: str, why: str, by: str, earliest_sent: int) -> None:
        """Let one move again."""


class StopBody(msgspec.Struct):
    """Body of ``POST /stop`` and ``POST /resume``; without ``robot`` all are stopped.

    :param by: the operator at the machine
    :param why: the reason, if any
    :param stop_id: of a stop, made by the client
    """

    by: str
    robot: str | None = None
    why: msgspec.Raw = msgspec.Raw(b"")
    stop_id: msgspec.Raw = msgspec.Raw(b"")

    @property
    def full(self) -> str | None:
        """The robot's name for the whole relay, however it was written."""
        return None if self.robot is None else full_name_of(self.robot)


_order_decoder = msgspec.json.Decoder(StopBody)


class ModulesBody(msgspec.Struct):
    """Body of ``POST /modules``: an order to a robot's modules, or a question about them.

    :param by: the operator at the machine
    :param do: ``list``, ``start``, ``stop``, ``restart``, ``log`` or ``processes``
    :param query: of ``log``
    """

    by: str
    robot: str
    do: Literal["list", "start", "stop", "restart", "log", "processes"]
    module: str = ""
    query: LogQuery = LogQuery()


_modules_decoder = msgspec.json.Decoder(ModulesBody)


class PipesBody(msgspec.Struct):
    """Body of ``POST /pipes``: an order about pipes, or a question about them.

    :param by: the operator at the machine
    :param pipe: full name; empty to list all
    :param new: of ``add``
    :param owner: full name of the owner of a new pipe
    """

    by: str
    do: Literal["list", "show", "add", "start", "stop", "remove"]
    pipe: str = ""
    new: NewPipe | None = None
    owner: str = ""


_pipes_decoder = msgspec.json.Decoder(PipesBody)


_pipe_list_decoder = msgspec.json.Decoder(PipeList)


class RolesBody(msgspec.Struct):
    """Body of ``POST /roles``: a command on an element of a Role; without an element, on the Role.

    :param user: full name of the user by whose rights it is carried out
    :param value: of ``set``
    :param args: of ``call``
    """

    user: str
    do: Literal["get", "set", "call", "start", "stop", "state"]
    role: str
    element: str = ""
    value: Any = None
    args: Any = {}


_roles_decoder = msgspec.json.Decoder(RolesBody)


class AdminSocket:
    """For the command line: ``GET /status``; ``POST`` of the others.

    :param status: returns the state of the relay
    :param refresh: applies changes in the database at once
    :param order: carries out an order to many robots, and answers by itself
    """

    app = Klein()

    def __init__(
        self,
        status: Callable[[], dict[str, Any]],
        refresh: Callable[[], Awaitable[None]],
        order: Callable[[Request], Awaitable[object]],
        stopping: StopService,
        modules: ModuleService,
        pipes: PipeService,
        roles: LocalRoles,
        *,
        cluster: ClusterAdmin,
    ) -> None:
        self._status = status
        self._refresh = refresh
        self._order = order
        self._gateway = stopping
        self._module_service = modules
        self._pipe_service = pipes
        self._local_roles = roles
        self._cluster = cluster

    @app.route("/status", methods=["GET"])
    def status(self, request: Request) -> bytes:
        request.setHeader(b"content-type", b"application/json")
        return jsontext.encode(self._status())

    @app.route("/refresh", methods=["POST"])
    def refresh(self, request: Request) -> Deferred[bytes]:
        return Deferred.fromCoroutine(self._apply_changes(request))

    async def _apply_changes(self, request: Request) -> bytes:
        await self._refresh()
        request.setResponseCode(204)
        return b""

    @app.route("/drain", methods=["POST"])
    def drain(self, request: Request) -> Deferred[bytes]:
        return Deferred.fromCoroutine(self._respond(request, self._cluster.drain()))

    @app.route("/cluster", methods=["POST"])
    def cluster(self, request: Request) -> Deferred[bytes]:
        return Deferred.fromCoroutine(self._respond(request, self._cluster.status()))

    @app.route("/stop", methods=["POST"])
    def stop(self, request: Request) -> Deferred[bytes]:
        return Deferred.fromCoroutine(self._respond(request, self._stop(request)))

    async def _stop(self, request: Request) -> Any:
        order = jsontext.decode(_order_decoder, request.content.read())
        why, stop_id = reason_in(order.why), stop_id_in(order.stop_id)
        return (await self._gateway.stop_locally(order.full, why, order.by, stop_id))._asdict()

    @app.route("/resume", methods=["POST"])
    def resume(self, request: Request) -> Deferred[bytes]:
        return Deferred.fromCoroutine(self._respond(request, self._resume(request)))

    async def _resume(self, request: Request) -> Any:
        order = jsontext.decode(_order_decoder, request.content.read())
        # Without a time, the order counts as older than any stop.
        earliest_sent = parse_sent(request.getHeader(SENT_HEADER)) or 0
        await self._gateway.resume_locally(order.full or "", reason_in(order.why), order.by, earliest_sent)
        return {}

    @app.route("/modules", methods=["POST"])
    def modules(self, request: Request) -> Deferred[bytes]:
        return Deferred.fromCoroutine(self._respond(request, self._modules(request)))

    async def _modules(self, request: Request) -> Any:
        body, service = request.content.read(), self._module_service
        order = jsontext.decode(_modules_decoder, body)
        user = await service.local_user(full_name_of(order.robot), order.by)
        forwarded = await self._forwarded(request, body, self._cluster.relay_of(user.robot.robot_id))
        if forwarded is not None:
            return forwarded
        if order.do == "list":
            return await service.modules(user)
        if order.do == "processes":
            return await service.processes(user)
        if order.do == "log":
            return await service.read_log(user, order.module, order.query)
        return await service.order(user, order.module, order.do)

    @app.route("/pipes", methods=["POST"])
    def pipes(self, request: Request) -> Deferred[bytes]:
        return Deferred.fromCoroutine(self._respond(request, self._pipes(request)))

    async def _pipes(self, request: Request) -> Any:
        body, service = request.content.read(), self._pipe_service
        order = jsontext.decode(_pipes_decoder, body)
        user = local_pipe_user(order.by)
        if order.do == "list":
            return merge_pipes(await service.pipes(user), await self._pipes_elsewhere(request, body))
        if order.pipe:
            relay = await service.relay_of(user, order.pipe)
        else:
            relay = None if order.new is None else await service.relay_of_new(user, order.new, order.owner)
        forwarded = await self._forwarded(request, body, relay)
        if forwarded is not None:
            return forwarded
        if order.do == "show":
            return await service.pipe(user, order.pipe)
        if order.do == "start":
            return await service.start_pipe(user, order.pipe)
        if order.do == "stop":
            return await service.stop_pipe(user, order.pipe)
        if order.do == "remove":
            await service.remove(user, order.pipe)
            return {}
        if order.new is None:
            raise Invalid("'new' is missing: the pipe to add")
        return await service.add(user, order.new, order.owner)

    @app.route("/roles", methods=["POST"])
    def roles(self, request: Request) -> Deferred[bytes]:
        return Deferred.fromCoroutine(self._respond(request, self._roles(request)))

    async def _roles(self, request: Request) -> Any:
        order, sent = jsontext.decode(_roles_decoder, request.content.read()), request.getHeader(SENT_HEADER)
        user = await self._local_roles.user(full_name_of(order.user), parse_sent(sent))
        commands, runs = self._local_roles.commands, self._local_roles.runs
        if order.do == "state":
            return await runs.state(user.principal, order.role)
        if not order.element and order.do in ("start", "stop"):
            return await (runs.start if order.do == "start" else runs.stop)(user, order.role)
        element = order.role, order.element
        if order.do == "get":
            return await commands.get(user, *element)
        if order.do == "set":
            return await commands.set(user, *element, NewElementValue(order.value))
        if order.do == "call":
            return await commands.call(user, *element, ElementCall(order.args))
        return await commands.switch(user, *element, "start" if order.do == "start" else "stop")

    async def _forwarded(self, request: Request, body: bytes, relay: RelayInfo | None) -> msgspec.Raw | None:
        """The answer of the relay that a robot is connected to; ``None``: this one answers.

        :raises Unavailable: that relay can't be reached
        """
        if relay is None or _from_relay(request):
            return None
        status, answer = await self._cluster.forward(request.path.decode(), body, relay)
        request.setResponseCode(status)
        return msgspec.Raw(answer)

    async def _pipes_elsewhere(self, request: Request, body: bytes) -> list[PipeList]:
        """The lists of the other relays, which know the states of pipes that run there."""
        if _from_relay(request):
            return []
        answers = await self._cluster.forward_to_all(request.path.decode(), body)
        return [_pipe_list_decoder.decode(each) for each in answers]

    async def _respond(self, request: Request, work: Awaitable[Any]) -> bytes:
        try:
            answer = jsontext.encode(await work)
        except SwitchboardError as error:
            return problem_of(request, error)
        request.setHeader(b"content-type", b"application/json")
        return answer

    @app.route("/fleet", methods=["POST"])
    def fleet(self, request: Request) -> Deferred[bytes]:
        lasts = is_stop(request.content.read())
        request.content.seek(0)
        running = Deferred.fromCoroutine(self._carry_out(request))
        # Ctrl-C at the command line has klein end any other order.
        return shield(running) if lasts else running

    async def _carry_out(self, request: Request) -> bytes:
        try:
            await self._order(request)
        except SwitchboardError as error:
            return problem_of(request, error)
        except CancelledError:
            if not request._disconnected:
                raise
        return b""


def _from_relay(request: Request) -> bool:
    """Whether another relay has forwarded a request of its own local socket."""
    return getattr(request, "forwarded_client", None) is not None
