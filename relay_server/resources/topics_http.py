"""Topics of robots over HTTP: the newest message, all of them as a stream, and publishing (SPEC 1.13)."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import UNSET, Meta, UnsetType
from twisted.internet.defer import DeferredList
from twisted.internet.task import LoopingCall
from twisted.web.server import Request

from relay_protocol import jsontext
from relay_protocol.errors import Invalid
from relay_protocol.rights import Operation
from relay_server.common.clock import Clock, as_twisted
from relay_server.common.tcp import NewsFlow
from relay_server.http.endpoint import (
    ApiRequest,
    Endpoint,
    Freshness,
    IdempotencyKey,
    Representation,
    Streamed,
    endpoint,
)
from relay_server.http.idempotency import Idempotency
from relay_server.http.media_types import EVENTS, FORMS, JSON, MediaType
from relay_server.http.request_fields import WAIT, WARNING
from relay_server.resources import representations
from relay_server.resources.collections_http import (
    MOVING,
    ROBOT_PATH,
    GraphCollection,
    member_endpoint,
    page_endpoint,
    read_only,
)
from relay_server.resources.page import TypedPageQuery
from relay_server.resources.representations import MessageBody, caller_at
from relay_server.resources.schemas import TopicMessage, TopicPage
from relay_server.resources.service import MessageConditions, RobotResourceService
from relay_server.resources.topic_stream import TopicStream

QUIET_SECONDS = 5.0
"""Seconds between keepalives of a stream."""

NO_MATCH = (
    "'If-Match' does not apply to a topic: a message replaces no other, so there is nothing to compare. "
    "Remove the header"
)


class TopicQuery(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Query for a message of a topic.

    :param wait: seconds to wait for one, 2 by default; with `If-None-Match` for another one than the client has, and 0
        answers at once
    :param max_age: largest age in seconds
    :param throttle_ms: of a stream: least time between two messages
    :param next: wait for a message that comes after the request; when none came in time, the newest one
    :param whole: of a stream: each event has topic, type and time, as the answer without a stream
    """

    wait: Annotated[float, Meta(ge=0, le=WAIT)] | UnsetType = UNSET
    max_age: Annotated[float, Meta(ge=0, le=1e9)] | UnsetType = UNSET
    throttle_ms: Annotated[float, Meta(ge=0, le=60_000.0)] | UnsetType = UNSET
    next: bool = False
    whole: bool = False


class TopicEndpoints(GraphCollection):
    """Topics of robots.

    :param remembered: answers to requests with an idempotency key
    """

    kind = "topics"

    def __init__(self, clock: Clock, service: RobotResourceService, remembered: Idempotency) -> None:
        super().__init__(service)
        self.remembered = remembered
        self._clock = clock

    async def read_body(
        self, request: ApiRequest, endpoint: Endpoint, form: MediaType, robot: str, name: str
    ) -> MessageBody:
        """A message in RDF."""
        return await representations.read_message(self._service, request, form, robot, name)

    @page_endpoint("topics")
    async def members(
        self, request: ApiRequest, robot: str, query: TypedPageQuery
    ) -> Representation[TopicPage]:
        return await self.page(request, robot, query)

    @member_endpoint(
        "topics",
        "The newest message of a topic",
        more="With `Accept: text/event-stream` every message as an event, until the reader disconnects. "
        "The event `status` (`level`, `msg`) says why messages are missing.",
        forms=(*FORMS, EVENTS),
        errors=(504,),
    )
    async def newest_message(
        self, request: ApiRequest, robot: str, name: str, query: TopicQuery
    ) -> Representation[TopicMessage] | Streamed:
        head = request.http.method == b"HEAD"
        if request.form is EVENTS:
            stream = self._stream(request, robot, name, query)
            if head:
                await self._service.check_may_subscribe(caller_at(request, robot), name)
            return stream
        if query.throttle_ms is not UNSET:
            raise Invalid("'throttle_ms' applies to streams: request text/event-stream, or remove it")
        if query.whole:
            raise Invalid("'whole' applies to streams: request text/event-stream, or remove it")
        if query.next and head:
            # Clients that poll ask for the head first, and do not wait for it.
            await self._service.check_may_subscribe(caller_at(request, robot), name)
            return Streamed(JSON.media, _send_nothing)
        wait = MessageConditions().wait if query.wait is UNSET else query.wait
        request.extend_time_limit(wait)
        max_age = None if query.max_age is UNSET else query.max_age
        wanted = MessageConditions(wait, max_age, request.form.bases(request.if_none_match), query.next)
        state = await read_only(self._service.newest_message(caller_at(request, robot), name, wanted))
        return representations.newest_message(self._service, request, robot, state)

    def _stream(self, request: ApiRequest, robot: str, name: str, query: TopicQuery) -> Streamed:
        for each in ("wait", "max_age", "next"):
            if getattr(query, each) not in (UNSET, False):
                raise Invalid(f"'{each}' cannot be used with a stream: remove it")
        throttle = 0.0 if query.throttle_ms is UNSET else query.throttle_ms

        async def run(http: Request) -> None:
            left = http.notifyFinish()
            left.addErrback(lambda failure: None)

            def send(body: bytes) -> None:
                _send(http, b"message", body)

            def send_status(level: str, text: str) -> None:
                _send(http, b"status", jsontext.encode({"level": level, "msg": text}))

            caller = caller_at(request, robot)
            # The newest message is sent at once.
            async with self._service.follow(
                caller, name, throttle, send, send_status, whole=query.whole
            ) as stream:
                http.write(b": this stream lasts until you disconnect\n\n")
                flow = NewsFlow(stream, self._clock, http.transport)
                http.registerProducer(flow, True)
                keepalive = LoopingCall(_keep_alive, http, stream)
                keepalive.clock = as_twisted(self._clock)
                keepalive.start(QUIET_SECONDS, now=False)
                try:
                    await DeferredList([left, stream.over], fireOnOneCallback=True, consumeErrors=True)
                finally:
                    keepalive.stop()
                    flow.end()
                    http.unregisterProducer()
            if stream.reason is not None and request.connected:
                _send(http, b"ended", jsontext.encode(str(stream.reason)))

        return Streamed(EVENTS.media, run, headers={"x-accel-buffering": "no"})

    @endpoint(
        "PUT",
        f"{ROBOT_PATH}/topics/{{name:path}}",
        tag="resources",
        summary="Publish a message",
        more="The message is sent as soon as it has a subscriber. `If-Match` does not apply: 400.",
        returns="sent",
        reads=FORMS,
        numbers=("value",),
        key=IdempotencyKey.REMEMBERED,
        freshness=Freshness.TAKEN,
        headers={
            WARNING: "that earlier messages of yours to the topic were dropped, as the robot's link is too slow"
        },
        errors=MOVING,
    )
    async def put(self, request: ApiRequest, robot: str, name: str, body: MessageBody) -> None:
        if request.header("if-match") is not None:
            raise Invalid(NO_MATCH)
        representations.check_own("topic", body.topic, name)
        warning = await self._service.publish(
            caller_at(request, robot), name, body.value, body.type, request.earliest_sent
        )
        if warning:
            request.http.setHeader(WARNING, warning)

    @put.replay
    async def may_put(self, request: ApiRequest, robot: str, name: str, body: MessageBody) -> None:
        await self._service.may(caller_at(request, robot), Operation.PUBLISH, name)

    @endpoint(
        "POST",
        f"{ROBOT_PATH}/topics/{{name:path}}",
        tag="resources",
        summary="Publish a message",
        more="The same as `PUT`.",
        returns="sent",
        reads=FORMS,
        numbers=("value",),
        key=IdempotencyKey.REMEMBERED,
        freshness=Freshness.TAKEN,
        headers={
            WARNING: "that earlier messages of yours to the topic were dropped, as the robot's link is too slow"
        },
        errors=MOVING,
    )
    async def post(self, request: ApiRequest, robot: str, name: str, body: MessageBody) -> None:
        await self.put(request, robot, name, body)

    @post.replay
    async def may_post(self, request: ApiRequest, robot: str, name: str, body: MessageBody) -> None:
        await self.may_put(request, robot, name, body)


async def _send_nothing(http: Request) -> None:
    """The body of an answer to HEAD."""


def _keep_alive(http: Request, stream: TopicStream) -> None:
    """Send a keepalive, and check whether the reader may still subscribe."""
    http.write(b":\n\n")
    # Last: it may end the stream, and then the request is finished.
    stream.check()


def _send(http: Request, event: bytes, body: bytes) -> None:
    http.write(b"event: " + event + b"\ndata: " + body + b"\n\n")
