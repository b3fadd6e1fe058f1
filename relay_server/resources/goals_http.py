"""Goals over HTTP: ``POST …/actions/<name>``, and ``…/goals`` below a robot's address (SPEC section 1.13)."""

from __future__ import annotations

from collections.abc import Awaitable
from typing import Annotated, Any

import msgspec
from klein import Klein
from msgspec import Meta
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import NAME
from relay_protocol.rights import Operation
from relay_server.common.clock import Clock
from relay_server.common.freshness_tokens import HEADER, FreshnessTokens
from relay_server.common.push_producer import NewsFlow
from relay_server.common.tcp import enable_tcp_keepalive
from relay_server.http.api import STREAMED, Api, body_of
from relay_server.http.conditional import answers, told_facts
from relay_server.http.freshness_header import dated
from relay_server.http.idempotency import StoredReply
from relay_server.http.idempotent_requests import IdempotentRequests, send
from relay_server.http.openapi.operation import JSON, Response, described, header, query, raw
from relay_server.http.openapi.operation import ApiOperation as Described
from relay_server.http.openapi.schemas import GoalInfo, GoalPage
from relay_server.http.request_params import (
    KNOWN,
    LISTING,
    WAIT,
    known_tags,
    number_in,
    query_of,
    streams,
    wait_preferred,
)
from relay_server.http.time_limit import allow
from relay_server.resources.goals import GoalRequest, GoalService, HttpGoal
from relay_server.resources.page import PageQuery, see_known
from relay_server.resources.service import RequestOrigin

STREAM_SECONDS = 60.0
"""A stream ends after so long, for its reader to begin it anew: what holds connections open in between, as proxies do,
must not look at a goal for somebody who has gone."""

QUIET_SECONDS = 5.0
"""How often a stream says that it goes on, and it is found out whether its reader may still read."""

AGAIN_MS = 500
"""Readers begin a stream anew after so long."""

UNWATCHED_SECONDS = 3600.0


PREFER = header("Prefer", "`wait=` seconds for which its end is waited (RFC 7240)")
GOAL_HEADERS = {
    "ETag": "names this status",
    "Location": "its address",
    HEADER: "when this was answered; what moves the robot gives it back",
}
_TAGGED = {name: GOAL_HEADERS[name] for name in ("ETag", HEADER)}
_PATH = "/api/v1/robots/{robot}/goals"


class GoalBody(msgspec.Struct, forbid_unknown_fields=True):
    """A goal for an action.

    :param unwatched: seconds for which nobody has to look at it
    """

    goal: msgspec.Raw = raw(b"{}")
    type: Annotated[str, Meta(max_length=NAME)] = ""
    unwatched: Annotated[float, Meta(gt=0, le=UNWATCHED_SECONDS)] = GoalRequest(b"").unwatched


class GoalSubmission:
    """Goals that are given to actions."""

    def __init__(self, desk: GoalService, once: IdempotentRequests) -> None:
        self._desk = desk
        self._once = once

    async def give(self, request: Request, asker: RequestOrigin, name: str, moment: int | None) -> Any:
        """Give a goal, and wait for its end as long as is preferred.

        :param moment: the relay's monotonic nanoseconds before which it can't have been asked for
        :raises Invalid: what is preferred can't be read; no goal is given then
        :raises SwitchboardError: it is refused, or can't begin
        """
        enable_tcp_keepalive(request.channel.transport)
        wish = body_of(request, GoalBody, ("goal",))
        ask = GoalRequest(bytes(wish.goal), wish.type, wish.unwatched)
        # Before the goal is given: what can't be read of a request keeps it from being done.
        seconds = wait_preferred(request) or 0.0

        async def work() -> StoredReply:
            goal = await self._desk.give(asker, name, ask, moment)
            location = f"/api/v1/robots/{asker.robot}/goals/{goal.id}"
            return StoredReply(202, (await self._desk.told(asker, goal)).body, location)

        reply = await self._once.reply(request, asker, Operation.CALL, name, work)
        # Only this request may look at the goal for its sender: the work above goes on without him.
        told = await self._desk.awaited(asker, reply.location.rpartition("/")[2], seconds)
        if told is None:
            return send(request, reply)
        request.setHeader("etag", told.etag)
        return send(request, reply._replace(status=200 if told.over else 202, body=told.body))


class GoalResource:
    """The asker's goals at one robot, for one request."""

    app = Klein()

    def __init__(
        self, clock: Clock, desk: GoalService, moments: FreshnessTokens, api: Api, robot: str
    ) -> None:
        self._clock = clock
        self._desk = desk
        self._moments = moments
        self._api = api
        self._robot = robot

    @app.route("/", methods=["GET"])
    @described(
        Described(
            method="GET",
            path=_PATH,
            tag="goals",
            summary="A page of the caller's own goals",
            more="`name` and `type` are those of actions.",
            parameters=(*LISTING, KNOWN),
            answers=answers("a page", GoalPage, _TAGGED),
        )
    )
    def members(self, request: Request) -> Any:
        return self._answer(request, self._members(request))

    async def _members(self, request: Request) -> Any:
        asker = await self._asker(request)
        return told_facts(request, await self._desk.members(asker, PageQuery.of(query_of(request))))

    @app.route("/<id>", methods=["GET"])
    @described(
        Described(
            method="GET",
            path=f"{_PATH}/{{id}}",
            tag="goals",
            summary="How far a goal has come",
            more="With `Accept: text/event-stream` as events, for a minute.",
            parameters=(
                query("wait", "seconds for another status to come", Annotated[float, Meta(ge=0, le=WAIT)]),
                header("If-None-Match", "entity tags of what is known already"),
            ),
            answers={
                200: Response("its status", GoalInfo, media=(JSON, "text/event-stream"), headers=_TAGGED),
                304: Response("it is as it is known", headers=_TAGGED),
            },
        )
    )
    def one(self, request: Request, id: str) -> Any:
        return self._answer(request, self._one(request, id))

    async def _one(self, request: Request, id: str) -> Any:
        # Who has vanished must not look at a goal by a request that still waits.
        enable_tcp_keepalive(request.channel.transport)
        asker, query = await self._asker(request), query_of(request)
        if streams(request):
            see_known(query)
            await self._stream(request, asker, self._desk.find(asker, id))
            return STREAMED
        see_known(query, "wait")
        wait = number_in(query, "wait", 0.0, WAIT) or 0.0
        allow(request, wait)
        told = await self._desk.state(asker, id, wait, known_tags(request))
        if wait:
            # His token may have ended meanwhile.
            await self._api.principal(request)
        request.setHeader("etag", told.etag)
        if told.known:
            request.setResponseCode(304)
            return STREAMED
        return msgspec.Raw(told.body)

    async def _stream(self, request: Request, asker: RequestOrigin, goal: HttpGoal) -> None:
        self._api.streams(request, asker.principal)
        for name, value in (("content-type", "text/event-stream"), ("x-accel-buffering", "no")):
            request.setHeader(name, value)
        request.setHeader(HEADER, self._moments.now())
        reader = _GoalReader(request)
        flow = NewsFlow(reader, self._clock, request.transport)
        request.registerProducer(flow, True)
        request.write(b"retry: %d\n: for a minute; who goes on begins anew\n\n" % AGAIN_MS)
        began = proved = self._clock.seconds()
        try:
            with goal.looked_at():
                while not goal.over and (now := self._clock.seconds()) < began + STREAM_SECONDS:
                    if now >= proved + QUIET_SECONDS:
                        request.write(b":\n\n")
                        await self._api.principal(request, urgent=True)
                        proved = now
                    version = goal.version
                    reader.tell_feedback(goal.feedback_json)
                    await goal.changed(version, QUIET_SECONDS)
                if goal.over:
                    reader.tell_feedback(goal.feedback_json)
                    reader.tell(b"ended", (await self._desk.told(asker, goal)).body)
        except SwitchboardError:
            # His token is over, and with it what he may read; or nobody can say.
            return
        finally:
            flow.end()
            request.unregisterProducer()

    @app.route("/<id>", methods=["DELETE"])
    @described(
        Described(
            method="DELETE",
            path=f"{_PATH}/{{id}}",
            tag="goals",
            summary="Cancel a goal",
            answers={
                202: Response("it is to end, and its end still comes", GoalInfo, headers=_TAGGED),
                204: Response("it is over already"),
            },
        )
    )
    def cancel(self, request: Request, id: str) -> Any:
        return self._answer(request, self._cancel(request, id))

    async def _cancel(self, request: Request, id: str) -> Any:
        asker = await self._asker(request)
        goal = self._desk.cancel(asker, id)
        if goal is None:
            return None
        told = await self._desk.told(asker, goal)
        request.setHeader("etag", told.etag)
        return send(request, StoredReply(202, told.body))

    # --- requests and answers -----------------------------------------------------------------------------

    def _answer(self, request: Request, work: Awaitable[Any]) -> Any:
        return self._api.answer(request, dated(request, self._moments, work))

    async def _asker(self, request: Request) -> RequestOrigin:
        address = getattr(request.getClientAddress(), "host", "local")
        return RequestOrigin(await self._api.principal(request), self._robot, address)

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


class _GoalReader:
    """Who is told of a goal, event by event."""

    def __init__(self, request: Request) -> None:
        self._request = request
        self._paused = False
        self._newest: bytes | None = None

    def tell_feedback(self, feedback: bytes | None) -> None:
        """Tell how far it has come, where that is new and he takes it; the newest counts."""
        if feedback is not None and feedback is not self._newest and not self._paused:
            self._newest = feedback
            self.tell(b"feedback", feedback)

    def tell(self, event: bytes, body: bytes) -> None:
        """Tell something, JSON."""
        self._request.write(b"event: " + event + b"\ndata: " + body + b"\n\n")

    def pause(self) -> None:
        """He takes nothing now."""
        self._paused = True

    def resume(self) -> None:
        """He does again."""
        self._paused = False


def below(clock: Clock, desk: GoalService, moments: FreshnessTokens, api: Api, robot: str) -> IResource:
    """What serves the address of a robot's goals."""
    resource: IResource = GoalResource(clock, desk, moments, api, robot).app.resource()
    return resource
