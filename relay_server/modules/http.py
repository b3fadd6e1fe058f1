"""``/api/v1/robots/<robot>/modules`` and ``…/processes``: supervised processes of a robot, and all its processes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from typing import Annotated

import msgspec
from msgspec import Meta
from twisted.web.server import Request

from relay_protocol import jsontext
from relay_protocol.errors import Invalid
from relay_server.access import Principal
from relay_server.common.clock import Clock
from relay_server.http.endpoint import Accepted, ApiRequest, Streamed, endpoint
from relay_server.http.media_types import EVENTS, JSON
from relay_server.http.streaming import Signal, StreamingResponse, follow, sent
from relay_server.modules.admission import admitted_user
from relay_server.modules.schemas import (
    FASTEST_SECONDS,
    SLOWEST_SECONDS,
    LogQuery,
    ModuleList,
    ModuleLogPage,
    ModuleOrderResult,
    ModuleStatus,
    ProcessList,
)
from relay_server.modules.service import (
    PROCESSES,
    ModuleService,
    ModuleUser,
    action_of,
    user_of,
)
from relay_server.sessions.manager import SessionManager

HERE = "/api/v1/robots/{robot}"

STREAM_WAIT_SECONDS = 4.0
"""A stream of a log asks the robot again after so long without a line. Less than the seconds after which a stream
without events sends a sign of life."""


class ProcessQuery(msgspec.Struct, frozen=True):
    """How often processes are measured.

    :param every: seconds between two events of a stream
    """

    every: Annotated[float, Meta(ge=FASTEST_SECONDS, le=SLOWEST_SECONDS)] | None = None


class ModuleEndpoints:
    """Modules and processes of robots."""

    def __init__(self, clock: Clock, sessions: SessionManager, service: ModuleService) -> None:
        self._clock = clock
        self._sessions = sessions
        self._service = service

    @endpoint(
        "GET",
        f"{HERE}/modules",
        tag="modules",
        summary="The modules of a robot that the caller may manage",
        more="With `Accept: text/event-stream` again after every change.",
        returns="modules",
        forms=(JSON, EVENTS),
    )
    async def modules(self, request: ApiRequest, robot: str) -> ModuleList | Streamed:
        if request.form is EVENTS:
            return await self._stream(request, robot, lambda user: _ModulesFeed(self._service, user))
        async with self._user(request, robot) as user:
            return await self._service.modules(user)

    @endpoint(
        "GET",
        f"{HERE}/modules/{{module}}",
        tag="modules",
        summary="One module of a robot",
        returns="the module",
    )
    async def module(self, request: ApiRequest, robot: str, module: str) -> ModuleStatus:
        async with self._user(request, robot) as user:
            return await self._service.module(user, module)

    @endpoint(
        "POST",
        f"{HERE}/modules/{{module}}/{{action}}",
        tag="modules",
        summary="Start, stop or restart a module",
        more="`action` is `start`, `stop` or `restart`. An order to start or stop a module of a robot that is "
        "offline is pending, and carried out when the robot is back; the latest one counts.",
        returns="the robot has accepted the order, or it is pending",
        errors=(409,),
    )
    async def order(
        self, request: ApiRequest, robot: str, module: str, action: str
    ) -> Accepted[ModuleOrderResult]:
        async with self._user(request, robot) as user:
            return Accepted(await self._service.order(user, module, action_of(action)))

    @endpoint(
        "GET",
        f"{HERE}/modules/{{module}}/log",
        tag="modules",
        summary="The newest lines of a module's log",
        more="With `Accept: text/event-stream` the newest lines, or those from `after` on, and each line that is "
        "written from then on.",
        returns="lines",
        forms=(JSON, EVENTS),
        errors=(409,),
    )
    async def log(
        self, request: ApiRequest, robot: str, module: str, query: LogQuery
    ) -> ModuleLogPage | Streamed:
        if request.form is EVENTS:
            if query.wait or query.before is not None:
                raise Invalid("'wait' and 'before' do not go with a stream")
            return await self._stream(
                request, robot, lambda user: _LogFeed(self._service, user, module, query)
            )
        request.extend_time_limit(query.wait)
        async with self._user(request, robot) as user:
            return await self._service.read_log(user, module, query)

    @endpoint(
        "GET",
        f"{HERE}/processes",
        tag="modules",
        summary="All processes of a robot's daemon and modules, measured now",
        more="With `Accept: text/event-stream` again and again. `cpu` is null in the first measurement.",
        returns="processes",
        forms=(JSON, EVENTS),
    )
    async def processes(self, request: ApiRequest, robot: str, query: ProcessQuery) -> ProcessList | Streamed:
        if request.form is EVENTS:
            every = 1.0 if query.every is None else query.every
            return await self._stream(request, robot, lambda user: _ProcessFeed(self._service, user, every))
        if query.every is not None:
            raise Invalid("'every' is for a stream: ask for text/event-stream")
        async with self._user(request, robot) as user:
            return await self._service.processes(user)

    def _user(self, request: ApiRequest, robot: str) -> AbstractAsyncContextManager[ModuleUser]:
        return admitted_user(self._sessions, request.principal, robot, request.address)

    async def _stream(
        self, request: ApiRequest, robot: str, build: Callable[[ModuleUser], _Feed]
    ) -> Streamed:
        # The permit follows changes of rights while the stream lasts.
        admission = await self._sessions.admit(request.principal, robot, request.address)
        try:
            feed = build(user_of(admission.robot, admission.permit, request.address))
            # Once the stream has begun its status is sent, so refusals come first.
            feed.check()
        except BaseException:
            self._sessions.release(admission)
            raise

        async def run(http: Request) -> None:
            async with StreamingResponse(self._clock, http) as out:
                await follow(self._clock, request, out, feed)

        def close() -> None:
            feed.close()
            self._sessions.release(admission)

        return Streamed(EVENTS.media, run, close=close)


class _Feed(ABC):
    """A stream about one robot. Rights are judged again for each event."""

    resource = ""

    def __init__(self, service: ModuleService, user: ModuleUser) -> None:
        self.follower = Signal()
        self._service = service
        self._user = user
        self._end: Callable[[], None] | None = None

    def check(self) -> None:
        """:raises Refused: the client may not read this"""
        if self.resource:
            self._user.require(self.resource)

    def mark(self) -> bytes:
        return b":\n\n"

    def close(self) -> None:
        if self._end is not None:
            self._end()
            self._end = None

    @abstractmethod
    async def news(self, principal: Principal) -> tuple[bytes, bool]: ...


class _ModulesFeed(_Feed):
    _sent = b""

    async def news(self, principal: Principal) -> tuple[bytes, bool]:
        if self._end is None:
            self._end = self._service.on_change(self._user.robot, self.follower.wake)
        body = jsontext.encode(await self._service.modules(self._user))
        if body == self._sent:
            return b"", False
        self._sent = body
        return sent("modules", body), False


class _LogFeed(_Feed):
    def __init__(self, service: ModuleService, user: ModuleUser, module: str, query: LogQuery) -> None:
        super().__init__(service, user)
        self.resource = module
        self._query = query

    async def news(self, principal: Principal) -> tuple[bytes, bool]:
        page = await self._service.read_log(self._user, self.resource, self._query)
        self._query = msgspec.structs.replace(self._query, after=page.next, wait=STREAM_WAIT_SECONDS)
        return (sent("lines", jsontext.encode(page), page.next) if page.lines else b""), True


class _ProcessFeed(_Feed):
    resource = PROCESSES

    def __init__(self, service: ModuleService, user: ModuleUser, every: float) -> None:
        super().__init__(service, user)
        self._every = every
        self._latest: ProcessList | None = None

    async def news(self, principal: Principal) -> tuple[bytes, bool]:
        self.check()
        if self._end is None:
            self._end = self._service.watch_processes(self._user.robot, self._every, self._measured)
        latest, self._latest = self._latest, None
        return (b"" if latest is None else sent("processes", jsontext.encode(latest))), False

    def _measured(self, found: ProcessList) -> None:
        self._latest = found
        self.follower.wake()
