"""``/api/v1/roles/<role>/run``: Roles that are started and stopped, and their live state."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial

from twisted.web.server import Request

from relay_protocol import jsontext
from relay_protocol.errors import NotFound, SwitchboardError
from relay_server.access import Principal
from relay_server.cluster.relays import RelayInfo
from relay_server.common.clock import Clock
from relay_server.http.endpoint import ApiRequest, IdempotencyKey, Streamed, endpoint
from relay_server.http.media_types import EVENTS, JSON
from relay_server.http.streaming import Signal, StreamingResponse, follow, sent
from relay_server.roles.commands import RoleUser
from relay_server.roles.runs import RoleRuns
from relay_server.roles.schemas import RoleRunState

BASE_PATH = "/api/v1/roles/{role}/run"

_SECONDS = 60.0
"""For modules of many robots."""


class RoleRunEndpoints:
    """Roles of the caller's realm that are started."""

    def __init__(self, clock: Clock, runs: RoleRuns) -> None:
        self._clock = clock
        self._runs = runs

    async def relay_of(self, request: ApiRequest, role: str, action: str = "") -> RelayInfo | None:
        """The home of all robots of the Role, if it is one."""
        if request.forwarding is None:
            return None
        relay_of_robot = partial(request.forwarding.relay_of, request.principal, from_memory=False)
        with suppress(SwitchboardError):
            return await self._runs.relay_of(request.principal, role, relay_of_robot)
        # The handler says what is wrong.
        return None

    @endpoint(
        "GET",
        BASE_PATH,
        tag="roles",
        summary="Whether a Role is started, and the state of its parts",
        more="With `Accept: text/event-stream` again after every change.",
        returns="the state",
        forms=(JSON, EVENTS),
        errors=(404,),
    )
    async def state(self, request: ApiRequest, role: str) -> RoleRunState | Streamed:
        state = await self._runs.state(request.principal, role)
        return state if request.form is JSON else self._stream(request, role)

    @endpoint(
        "POST",
        f"{BASE_PATH}/{{action}}",
        tag="roles",
        summary="Start or stop a Role",
        more="`action` is `start` or `stop`. Modules are started first, then devices, then pipes; a stop has the "
        "reverse order. A part that fails is in the answer with the reason, and keeps no other from it.",
        returns="the state",
        names={"action": "`start` or `stop`"},
        key=IdempotencyKey.REFUSED,
        errors=(404, 409),
        seconds=_SECONDS,
    )
    async def order(self, request: ApiRequest, role: str, action: str) -> RoleRunState:
        user = RoleUser(request.principal, request.address)
        if action == "start":
            return await self._runs.start(user, role)
        if action == "stop":
            return await self._runs.stop(user, role)
        raise NotFound(f"'{action[:20]}' is not 'start' or 'stop'")

    def _stream(self, request: ApiRequest, role: str) -> Streamed:
        feed = _RunFeed(self._runs, role)

        async def run(http: Request) -> None:
            async with StreamingResponse(self._clock, http) as out:
                await follow(self._clock, request, out, feed)

        return Streamed(EVENTS.media, run, close=feed.close)


class _RunFeed:
    """The state of a Role after each change."""

    def __init__(self, runs: RoleRuns, role: str) -> None:
        self.follower = Signal()
        self._runs = runs
        self._role = role
        self._sent = b""
        self._end: Callable[[], None] | None = None

    def mark(self) -> bytes:
        return b":\n\n"

    def close(self) -> None:
        if self._end is not None:
            self._end()
            self._end = None

    async def news(self, principal: Principal) -> tuple[bytes, bool]:
        if self._end is None:
            self._end = self._runs.on_tick(self.follower.wake)
        body = jsontext.encode(await self._runs.state(principal, self._role))
        if body == self._sent:
            return b"", False
        self._sent = body
        return sent("run", body), False
