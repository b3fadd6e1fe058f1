"""Goals over HTTP: ``POST …/actions/<name>``, and ``…/goals`` below a robot's address (SPEC 1.13)."""

from __future__ import annotations

from functools import partial
from typing import Annotated

import msgspec
from msgspec import UNSET, Meta, UnsetType
from twisted.web.server import Request

from relay_protocol.errors import Invalid, SwitchboardError
from relay_protocol.limits import NAME
from relay_protocol.rights import Operation
from relay_server.common.clock import Clock
from relay_server.common.tcp import NewsFlow, enable_tcp_keepalive
from relay_server.http.endpoint import (
    Accepted,
    Answered,
    ApiRequest,
    Freshness,
    IdempotencyKey,
    Streamed,
    Tagged,
    endpoint,
)
from relay_server.http.idempotency import Idempotency, StoredReply, once
from relay_server.http.media_types import EVENTS, JSON
from relay_server.http.openapi.operation import header, raw
from relay_server.http.request_fields import WAIT, wait_preferred
from relay_server.resources.collections_http import ROBOT_PATH
from relay_server.resources.goals import GoalReply, GoalRequest, GoalService, HttpGoal
from relay_server.resources.page import TypedPageQuery
from relay_server.resources.representations import caller_at
from relay_server.resources.schemas import GoalInfo, GoalPage
from relay_server.resources.service import RobotResourceService

STREAM_SECONDS = 60.0
"""Seconds after which a stream ends and its reader has to reconnect. Otherwise a proxy could keep a goal polled for a
client that has disappeared."""

QUIET_SECONDS = 5.0
"""Seconds between keepalives of a stream, with which its reader is authenticated again."""

AGAIN_MS = 500
"""Milliseconds after which readers reconnect to a stream."""

MAX_POLL_TIMEOUT = 3600.0


class GoalQuery(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Query for the status of a goal.

    :param wait: seconds to wait for another status
    """

    wait: Annotated[float, Meta(ge=0, le=WAIT)] | UnsetType = UNSET


class GoalBody(msgspec.Struct, forbid_unknown_fields=True):
    """A goal for an action.

    :param poll_timeout: seconds without a request for its status after which the goal is cancelled
    """

    goal: msgspec.Raw = raw(b"{}")
    type: Annotated[str, Meta(max_length=NAME)] = ""
    poll_timeout: Annotated[float, Meta(gt=0, le=MAX_POLL_TIMEOUT)] = GoalRequest(b"").poll_timeout


class GoalEndpoints:
    """Goals for actions of robots.

    :param resources: judges whether a remembered answer may be given again
    :param remembered: answers to requests with an idempotency key
    """

    def __init__(
        self, clock: Clock, goals: GoalService, resources: RobotResourceService, remembered: Idempotency
    ) -> None:
        self._clock = clock
        self._goals = goals
        self._resources = resources
        self._remembered = remembered

    @endpoint(
        "POST",
        f"{ROBOT_PATH}/actions/{{name:path}}",
        tag="goals",
        summary="Send an action goal",
        more="The goal is cancelled unless the caller keeps asking for its status.",
        returns={200: "the goal has ended", 202: "the goal is being executed"},
        numbers=("goal",),
        key=IdempotencyKey.HANDLED,
        freshness=Freshness.TAKEN,
        parameters=(header("Prefer", "`wait=` seconds to wait for its end (RFC 7240)"),),
        headers={"ETag": "entity tag of this status", "Location": "address of the goal"},
        errors=(409, 504),
    )
    async def give(
        self, request: ApiRequest, robot: str, name: str, body: GoalBody
    ) -> Answered[GoalInfo] | Accepted[GoalInfo]:
        enable_tcp_keepalive(request.http.channel.transport)
        caller = caller_at(request, robot)
        wanted = GoalRequest(bytes(body.goal), body.type, body.poll_timeout)
        # Before the goal is sent: a header that is not valid must prevent it.
        seconds = wait_preferred(request.http) or 0.0

        async def work() -> StoredReply:
            goal = await self._goals.give(caller, name, wanted, request.earliest_sent)
            location = f"/api/v1/robots/{robot}/goals/{goal.id}"
            return StoredReply(202, (await self._goals.status(caller, goal)).body, location)

        may = partial(self._resources.may, caller, Operation.CALL, name)
        reply = await once(self._remembered, request, robot, work, may)
        location = {"location": reply.location}
        # Only this request counts as polling by the owner: the work above continues without the client.
        status = await self._goals.awaited(caller, reply.location.rpartition("/")[2], seconds)
        if status is None:
            return Accepted(msgspec.Raw(reply.body), headers=location)
        kind = Answered if status.over else Accepted
        return kind(msgspec.Raw(status.body), status.etag, location)

    @endpoint(
        "GET",
        f"{ROBOT_PATH}/goals",
        tag="goals",
        summary="A page of the caller's own goals",
        more="`name` and `type` are those of actions.",
        returns="a page",
        freshness=Freshness.GIVEN,
    )
    async def members(self, request: ApiRequest, robot: str, query: TypedPageQuery) -> GoalPage:
        return await self._goals.members(caller_at(request, robot), query)

    @endpoint(
        "GET",
        f"{ROBOT_PATH}/goals/{{id}}",
        tag="goals",
        summary="The status of a goal",
        more="With `Accept: text/event-stream` its changes as events, for a minute.",
        returns="the status",
        forms=(JSON, EVENTS),
        freshness=Freshness.GIVEN,
    )
    async def one(
        self, request: ApiRequest, robot: str, id: str, query: GoalQuery
    ) -> Tagged[GoalInfo] | Streamed:
        # A waiting request of a vanished client must not count as polling.
        enable_tcp_keepalive(request.http.channel.transport)
        caller = caller_at(request, robot)
        if request.form is EVENTS:
            if query.wait is not UNSET:
                raise Invalid("'wait' cannot be used with a stream: remove it")
            return self._stream(request, robot, self._goals.find(caller, id))
        wait = 0.0 if query.wait is UNSET else query.wait
        request.extend_time_limit(wait)
        status = await self._goals.state(caller, id, wait, request.if_none_match)
        if wait:
            # The token may have ended meanwhile.
            await request.authenticate()
        return _tagged(status)

    def _stream(self, request: ApiRequest, robot: str, goal: HttpGoal) -> Streamed:
        async def run(http: Request) -> None:
            reader = _GoalReader(http)
            flow = NewsFlow(reader, self._clock, http.transport)
            http.registerProducer(flow, True)
            http.write(b"retry: %d\n: this stream lasts a minute; reconnect to continue\n\n" % AGAIN_MS)
            try:
                await self._follow(request, robot, goal, reader)
            except SwitchboardError:
                # The token has ended, or the database cannot say whether it has.
                return
            finally:
                flow.end()
                http.unregisterProducer()

        return Streamed(EVENTS.media, run, headers={"x-accel-buffering": "no"})

    async def _follow(self, request: ApiRequest, robot: str, goal: HttpGoal, reader: _GoalReader) -> None:
        """Send feedback as it comes, for :data:`STREAM_SECONDS`, and the end of the goal.

        :raises SwitchboardError: the caller may no longer read it
        """
        began = proved = self._clock.seconds()
        with goal.polled():
            while not goal.over and (now := self._clock.seconds()) < began + STREAM_SECONDS:
                if now >= proved + QUIET_SECONDS:
                    request.http.write(b":\n\n")
                    await request.authenticate(from_memory=True)
                    proved = now
                version = goal.version
                reader.send_feedback(goal.feedback_json)
                await goal.changed(version, QUIET_SECONDS)
            if goal.over:
                reader.send_feedback(goal.feedback_json)
                reader.send(b"ended", (await self._goals.status(caller_at(request, robot), goal)).body)

    @endpoint(
        "DELETE",
        f"{ROBOT_PATH}/goals/{{id}}",
        tag="goals",
        summary="Cancel a goal",
        returns={202: "being cancelled", 204: "it had already ended"},
        headers={"ETag": "entity tag of this status"},
        freshness=Freshness.GIVEN,
    )
    async def cancel(self, request: ApiRequest, robot: str, id: str) -> Accepted[GoalInfo] | None:
        caller = caller_at(request, robot)
        goal = self._goals.cancel(caller, id)
        if goal is None:
            return None
        status = await self._goals.status(caller, goal)
        return Accepted(msgspec.Raw(status.body), status.etag)

    @endpoint(
        "POST",
        f"{ROBOT_PATH}/goals/{{id}}/cancel",
        tag="goals",
        summary="Cancel a goal",
        more="The same as `DELETE` of the goal, for clients that send no `DELETE`. A body is ignored.",
        returns={202: "being cancelled", 204: "it had already ended"},
        headers={"ETag": "entity tag of this status"},
        freshness=Freshness.GIVEN,
    )
    async def cancel_by_post(self, request: ApiRequest, robot: str, id: str) -> Accepted[GoalInfo] | None:
        status: Accepted[GoalInfo] | None = await self.cancel(request, robot, id)
        return status


def _tagged(status: GoalReply) -> Tagged[GoalInfo]:
    return Tagged(msgspec.Raw(status.body), status.etag)


class _GoalReader:
    """Writes the events of a goal to one client."""

    def __init__(self, request: Request) -> None:
        self._request = request
        self._paused = False
        self._newest: bytes | None = None

    def send_feedback(self, feedback: bytes | None) -> None:
        """Send feedback that is new, unless the client accepts no bytes at present."""
        if feedback is not None and feedback is not self._newest and not self._paused:
            self._newest = feedback
            self.send(b"feedback", feedback)

    def send(self, event: bytes, body: bytes) -> None:
        """Send one event with a JSON body."""
        self._request.write(b"event: " + event + b"\ndata: " + body + b"\n\n")

    def pause(self) -> None:
        """The client accepts no bytes at present."""
        self._paused = True

    def resume(self) -> None:
        """The client accepts bytes again."""
        self._paused = False
