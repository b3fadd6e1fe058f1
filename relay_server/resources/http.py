"""Below ``/api/v1/robots/<robot>``: ``topics``, ``services``, ``actions`` and ``params`` (SPEC section 1.13)."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

import msgspec
from klein import Klein
from msgspec import UNSET
from twisted.internet.defer import DeferredList
from twisted.internet.task import LoopingCall
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException

from relay_protocol import jsontext
from relay_protocol.errors import Invalid
from relay_protocol.rights import Operation
from relay_server.channels.robot_link import resolve
from relay_server.common.clock import Clock, as_twisted
from relay_server.common.database import BoundedThreadPool
from relay_server.common.freshness_tokens import HEADER, FreshnessTokens
from relay_server.common.push_producer import NewsFlow
from relay_server.http.api import STREAMED, Api, body_of, is_empty
from relay_server.http.freshness_header import dated_in_form
from relay_server.http.idempotency import Idempotency, StoredReply
from relay_server.http.idempotent_requests import IdempotentRequests, send
from relay_server.http.media_types import EVENTS, MediaType, of_any_form
from relay_server.http.method_not_allowed import not_taken
from relay_server.http.negotiation import ContentNegotiation
from relay_server.http.openapi.operation import described
from relay_server.http.rdf.encode import member_graph
from relay_server.http.request_params import WAIT, field, known_tags, number_in, query_of, wait_preferred
from relay_server.http.time_limit import allow
from relay_server.http_sessions.loopback_client import MaybeDone
from relay_server.http_sessions.pool import SessionPool
from relay_server.resources import cameras_http, goals_http, nodes_http, operations
from relay_server.resources.cameras import CameraService
from relay_server.resources.etags import weak
from relay_server.resources.goals import GoalService
from relay_server.resources.goals_http import GoalSubmission
from relay_server.resources.nodes import NodeService
from relay_server.resources.operations import LEAST_TIMEOUT, THROTTLE_MS, TIMEOUT, Call
from relay_server.resources.page import PageQuery, see_known
from relay_server.resources.service import RequestOrigin, RobotResourceService, TopicQuery
from relay_server.resources.topic_stream import TopicStream
from relay_server.sessions.manager import SessionManager
from relay_server.sessions.service_calls import URGENT

PARTS = ("topics", "services", "actions", "params")
"""The addresses below a robot's that are served here."""

QUIET_SECONDS = 5.0
"""How often a stream says that it goes on."""

NO_MATCH = (
    "'If-Match' does not apply to a topic: a message takes the place of no other, so there is nothing to compare. "
    "Send it without"
)


class TopicResource:
    """Resources of one robot, for one request.

    :param part: one of :data:`PARTS`
    """

    app = Klein()

    def __init__(
        self,
        clock: Clock,
        desk: RobotResourceService,
        moments: FreshnessTokens,
        once: IdempotentRequests,
        giving: GoalSubmission,
        part: str,
        api: Api,
        robot: str,
    ) -> None:
        self._clock = clock
        self._desk = desk
        self._moments = moments
        self._once = once
        self._giving = giving
        self._part = part
        self._api = api
        self._robot = robot
        self._forms = ContentNegotiation(api, desk, robot, part)
        self._ways = {
            ("topics", "PUT"): self._publish,
            ("topics", "POST"): self._publish,
            ("services", "POST"): self._call,
            ("actions", "POST"): self._give,
            ("params", "PUT"): self._set,
            ("params", "DELETE"): self._remove,
        }

    @app.route("/", methods=["GET"])
    @described(*operations.MEMBERS)
    def members(self, request: Request) -> Any:
        return self._answer(request, self._members(request))

    async def _members(self, request: Request) -> Any:
        asker, form = await self._asker(request), self._forms.form(request)
        listing = PageQuery.of(query_of(request))
        if self._part == "params":
            page = await self._desk.params(asker, listing)
        else:
            page = await self._desk.members(asker, self._part, listing)
        return await self._forms.members(request, asker, page, form)

    @app.route("/<path:name>", methods=["GET"])
    @described(*operations.ONE)
    def one(self, request: Request, name: str) -> Any:
        ways = {"topics": self._state, "params": self._param}
        return self._answer(request, ways.get(self._part, self._member)(request, name))

    async def _member(self, request: Request, name: str) -> Any:
        asker, form = await self._asker(request), self._forms.form(request)
        told = await self._desk.member(asker, self._part, name)
        return await self._forms.told(request, asker, told, partial(member_graph, self._part), form)

    async def _param(self, request: Request, name: str) -> Any:
        asker, form = await self._asker(request), self._forms.form(request)
        return await self._forms.param(request, asker, await self._desk.param(asker, name), form)

    async def _state(self, request: Request, name: str) -> Any:
        asker, form = await self._asker(request), self._forms.form(request, EVENTS)
        if form is EVENTS:
            await self._stream(request, asker, name)
            return STREAMED
        state, known = await self._desk.state(asker, name, _wanted(request, form))
        if known:
            request.setHeader("etag", weak(form.tag(state.etag)))
            request.setResponseCode(304)
            return STREAMED
        return await self._forms.state(request, asker, state, form)

    async def _stream(self, request: Request, asker: RequestOrigin, name: str) -> None:
        query = query_of(request)
        see_known(query, "throttle_ms")
        throttle = number_in(query, "throttle_ms", 0.0, THROTTLE_MS) or 0.0
        self._api.streams(request, asker.principal)
        left = request.notifyFinish()
        left.addErrback(lambda failure: None)
        # What is there already comes at once.
        request.setHeader("content-type", "text/event-stream")
        request.setHeader("x-accel-buffering", "no")
        request.setHeader(HEADER, self._moments.now())

        def tell(body: bytes) -> None:
            _tell(request, b"message", body)

        async with self._desk.follow(asker, name, throttle, tell) as following:
            request.write(b": this stream goes on until you leave\n\n")
            flow = NewsFlow(following, self._clock, request.transport)
            request.registerProducer(flow, True)
            looking = LoopingCall(_look, request, following)
            looking.clock = as_twisted(self._clock)
            looking.start(QUIET_SECONDS, now=False)
            try:
                await DeferredList([left, following.over], fireOnOneCallback=True, consumeErrors=True)
            finally:
                looking.stop()
                flow.end()
                request.unregisterProducer()
        if following.reason is not None and not request._disconnected:
            _tell(request, b"ended", jsontext.encode(str(following.reason)))

    @app.route("/<path:name>", methods=["PUT", "POST", "DELETE"])
    @described(*operations.CHANGE)
    def change(self, request: Request, name: str) -> Any:
        way = self._ways.get((self._part, request.method.decode()))
        return self.other(request, name) if way is None else self._answer(request, way(request, name))

    @app.route("/")
    @app.route("/<path:name>")
    def other(self, request: Request, name: str = "") -> Any:
        """No method of these addresses."""
        takes = ["GET", *(method for part, method in self._ways if name and part == self._part)]
        return self._answer(request, not_taken(self._see(request, name), takes))

    async def _see(self, request: Request, name: str) -> None:
        """See that who asks may know of what is there.

        :raises NotFound: he may not, or there is nothing
        """
        asker = await self._asker(request)
        if not name:
            await self._desk.see(asker)
        elif self._part == "params":
            await _read(self._desk.param(asker, name))
        else:
            await self._desk.member(asker, self._part, name)

    async def _publish(self, request: Request, name: str) -> Any:
        asker, moment = await self._asker(request), self._moment(request)
        if field(request, "if-match") is not None:
            raise Invalid(NO_MATCH)
        body = await self._forms.message(request, asker, name)

        async def work() -> StoredReply:
            await self._desk.publish(asker, name, body.value, body.type, moment)
            return StoredReply(204)

        return send(request, await self._once.reply(request, asker, Operation.PUBLISH, name, work))

    async def _call(self, request: Request, name: str) -> Any:
        asker = await self._asker(request, passes=resolve(name) in URGENT)
        moment = self._moment(request)
        body = Call() if is_empty(request) else body_of(request, Call, ("args",))
        seconds = wait_preferred(request, LEAST_TIMEOUT) if body.timeout is UNSET else body.timeout
        timeout = TIMEOUT if seconds is None else seconds
        allow(request, timeout)

        async def work() -> StoredReply:
            values = await self._desk.call(asker, name, body.args, body.type, timeout, moment)
            return StoredReply(200, jsontext.encode({"values": msgspec.Raw(values)}))

        return send(request, await self._once.reply(request, asker, Operation.CALL, name, work))

    async def _give(self, request: Request, name: str) -> Any:
        return await self._giving.give(request, await self._asker(request), name, self._moment(request))

    async def _set(self, request: Request, name: str) -> Any:
        asker = await self._asker(request)
        value = await self._forms.value(request, asker, name)
        await self._desk.set_param(asker, name, value, of_any_form(field(request, "if-match")))

    async def _remove(self, request: Request, name: str) -> Any:
        match = of_any_form(field(request, "if-match"))
        await self._desk.remove_param(await self._asker(request), name, match)

    # --- requests and answers -----------------------------------------------------------------------------

    def _answer(self, request: Request, work: Awaitable[Any]) -> Any:
        if request.method in (b"GET", b"HEAD"):
            work = _read(work)
        return self._api.answer(request, dated_in_form(request, self._moments, work))

    async def _asker(self, request: Request, *, passes: bool = False) -> RequestOrigin:
        address = getattr(request.getClientAddress(), "host", "local")
        return RequestOrigin(await self._api.principal(request, passes=passes), self._robot, address)

    def _moment(self, request: Request) -> int | None:
        return self._moments.read(request.getHeader(HEADER))

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        answer: bytes = self._api.unrouted(request, failure)
        return answer


def parts(
    clock: Clock,
    front: SessionManager,
    guests: SessionPool,
    keys: Idempotency,
    threads: BoundedThreadPool,
    moments: FreshnessTokens,
    clock_ns: Callable[[], int],
    wall: Callable[[], float],
) -> dict[str, Callable[[Api, str], IResource]]:
    """What serves the addresses below a robot's :data:`PARTS`, its goals, cameras and modules.

    :param guests: those who are there by HTTP, whatever they ask for
    :param keys: requests that were sent with a key
    :param threads: do what takes long
    :param clock_ns: monotonic nanoseconds
    :param wall: Unix time in seconds
    """
    desk = RobotResourceService(clock, guests, threads, clock_ns, wall)
    pursued = GoalService(clock, guests, desk, wall)
    once = IdempotentRequests(keys, desk)
    shared = clock, desk, moments, once, GoalSubmission(pursued, once)
    below = {part: partial(_below, *shared, part) for part in PARTS}
    return {
        **below,
        "goals": partial(goals_http.below, clock, pursued, moments),
        "cameras": partial(cameras_http.below, CameraService(front.cameras), moments, desk),
        "modules": partial(nodes_http.below, NodeService(guests), moments, desk),
    }


def _below(
    clock: Clock,
    desk: RobotResourceService,
    moments: FreshnessTokens,
    once: IdempotentRequests,
    giving: GoalSubmission,
    part: str,
    api: Api,
    robot: str,
) -> IResource:
    resources = TopicResource(clock, desk, moments, once, giving, part, api, robot)
    resource: IResource = resources.app.resource()
    return resource


async def _read(work: Awaitable[Any]) -> Any:
    """What comes of work by which nothing is done."""
    try:
        return await work
    except MaybeDone as error:
        raise error.reason from None


def _look(request: Request, following: TopicStream) -> None:
    """Keep a stream alive on which nothing is said, and find out whether it still is."""
    request.write(b":\n\n")
    # Last: it may end the stream, and then the request is finished.
    following.look()


def _tell(request: Request, event: bytes, body: bytes) -> None:
    request.write(b"event: " + event + b"\ndata: " + body + b"\n\n")


def _wanted(request: Request, form: MediaType) -> TopicQuery:
    query = query_of(request)
    see_known(query, "wait", "max_age")
    wait = number_in(query, "wait", 0.0, WAIT)
    allow(request, TopicQuery().wait if wait is None else wait)
    return TopicQuery(
        TopicQuery().wait if wait is None else wait,
        number_in(query, "max_age", 0.0, 1e9),
        form.bases(known_tags(request)),
    )
