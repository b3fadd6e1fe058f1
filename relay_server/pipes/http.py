"""``/api/v1/pipes``: topics that are carried from robot to robot."""

from __future__ import annotations

from contextlib import suppress

import msgspec

from relay_protocol.errors import NotFound, SwitchboardError
from relay_server.cluster.relays import RelayInfo
from relay_server.http.endpoint import ApiRequest, Created, IdempotencyKey, endpoint
from relay_server.pipes.schemas import NewPipe, PipeList, PipeStatus
from relay_server.pipes.service import PipeService, merge_pipes, pipe_user, robot_of_target

BASE_PATH = "/api/v1/pipes"


_decoder = msgspec.json.Decoder(PipeList)


class PipeEndpoints:
    """Pipes of the caller's realm."""

    def __init__(self, service: PipeService) -> None:
        self._service = service

    async def relay_of(self, request: ApiRequest, pipe: str = "", action: str = "") -> RelayInfo | None:
        """The other relay that a pipe runs at: the home of its target robot."""
        if pipe:
            with suppress(SwitchboardError):
                return await self._service.relay_of(pipe_user(request.principal, request.address), pipe)
        elif request.http.method == b"POST" and request.forwarding is not None:
            with suppress(SwitchboardError, msgspec.MsgspecError):
                new = msgspec.json.decode(request.content(), type=NewPipe)
                robot = robot_of_target(new)
                return await request.forwarding.relay_of(request.principal, robot, from_memory=False)
        return None

    @endpoint(
        "GET",
        BASE_PATH,
        tag="pipes",
        summary="The caller's pipes; for an administrator, all of the realm",
        returns="pipes",
    )
    async def pipes(self, request: ApiRequest) -> PipeList:
        own = await self._service.pipes(pipe_user(request.principal, request.address))
        others = [_decoder.decode(each) for each in await request.answers_of_other_relays()]
        return merge_pipes(own, others)

    @endpoint(
        "POST",
        BASE_PATH,
        tag="pipes",
        summary="Add a pipe",
        more="It belongs to the caller, runs by the caller's rights, and ends when they end.",
        returns="the pipe",
        key=IdempotencyKey.REFUSED,
        errors=(404, 409),
    )
    async def add(self, request: ApiRequest, body: NewPipe) -> Created[PipeStatus]:
        user = pipe_user(request.principal, request.address)
        return Created(await self._service.add(user, body), location=f"{BASE_PATH}/{body.name}")

    @endpoint("GET", f"{BASE_PATH}/{{pipe}}", tag="pipes", summary="One pipe", returns="the pipe")
    async def pipe(self, request: ApiRequest, pipe: str) -> PipeStatus:
        return await self._service.pipe(pipe_user(request.principal, request.address), pipe)

    @endpoint(
        "DELETE",
        f"{BASE_PATH}/{{pipe}}",
        tag="pipes",
        summary="Stop and remove a pipe",
        returns="removed",
    )
    async def remove(self, request: ApiRequest, pipe: str) -> None:
        await self._service.remove(pipe_user(request.principal, request.address), pipe)

    @endpoint(
        "POST",
        f"{BASE_PATH}/{{pipe}}/{{action}}",
        tag="pipes",
        summary="Start or stop a pipe",
        more="`action` is `start` or `stop`. Only its owner may start a pipe.",
        returns="the pipe",
        names={"action": "`start` or `stop`"},
        errors=(409,),
    )
    async def order(self, request: ApiRequest, pipe: str, action: str) -> PipeStatus:
        user = pipe_user(request.principal, request.address)
        if action == "start":
            return await self._service.start_pipe(user, pipe)
        if action == "stop":
            return await self._service.stop_pipe(user, pipe)
        raise NotFound(f"'{action[:20]}' is not 'start' or 'stop'")
