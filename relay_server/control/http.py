"""A robot's ``control``, ``stop``, ``resume``, ``suppress``, ``inhibit`` and ``hold`` (SPEC 1.7)."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import Meta

from relay_protocol import jsontext
from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import NAME, STOP_ID_LENGTH, TEXT_LENGTH
from relay_server.common.errors import NotDone
from relay_server.common.tcp import enable_tcp_keepalive
from relay_server.control.gateway import ControlGateway
from relay_server.control.types import ControlReply
from relay_server.control.view import (
    ControlAnswer,
    ControlInfo,
    ControlTakeInfo,
    StopAnswer,
    StopInfo,
    StopProblem,
    StopServiceAnswer,
)
from relay_server.http.endpoint import Accepted, ApiRequest, Freshness, endpoint
from relay_server.http.openapi.operation import PROBLEM, Response, header
from relay_server.http.request_fields import APPLIED, wait_preferred
from relay_server.in_process_sessions.pool import LINGER_SECONDS
from relay_server.relay_node.arguments import stop_arguments

BASE_PATH = "/api/v1/robots/{robot}"

ReasonText = Annotated[str, Meta(max_length=TEXT_LENGTH)]
Resource = Annotated[str, Meta(min_length=1, max_length=NAME)]


class Why(msgspec.Struct):
    """Body of a request that takes only a reason."""

    why: ReasonText = ""


class StopRequestBody(msgspec.Struct):
    """Body of ``POST …/stop``.

    :param stop_id: made by the client for each press; the same id by several paths is one stop
    """

    why: ReasonText = ""
    stop_id: Annotated[str, Meta(max_length=STOP_ID_LENGTH)] = ""


class StopServiceBody(msgspec.Struct):
    """Body of a call of ``/relay/stop``.

    :param args: an object, or a list in the order of the fields
    """

    args: StopRequestBody = msgspec.field(default_factory=StopRequestBody)


class ControlReplyBody(msgspec.Struct):
    """Body of an answer to a request for control.

    :param client: number of the connection that requests control; 0: any
    """

    why: ReasonText = ""
    client: Annotated[int, Meta(ge=0, lt=1 << 32)] = 0


class Suppress(msgspec.Struct):
    """Body of ``POST …/suppress``; times in milliseconds."""

    resource: Resource
    ms: int = 100


class Inhibit(msgspec.Struct, forbid_unknown_fields=True):
    """Body of ``POST …/inhibit`` and ``…/hold``; times in milliseconds."""

    resource: Resource
    ms: int = 1000


NO_REASON = Why()
NO_REPLY = ControlReplyBody()


class StopProblemError(NotDone):
    """The robot is stopped; the error names the parts of the stop that failed, see :class:`StopProblem`."""

    def __init__(self, reason: str, stopped: StopInfo | None) -> None:
        super().__init__(reason)
        self.problem_fields = {"stopped": stopped}


class ControlEndpoints:
    """Control of robots."""

    def __init__(self, gateway: ControlGateway) -> None:
        self._gateway = gateway

    async def check_may_know(self, request: ApiRequest, robot: str) -> None:
        """:raises NotFound: the sender may not know of the robot"""
        await self._gateway.control(request.principal, robot, request.address)

    # --- control ------------------------------------------------------------------------------------------

    @endpoint(
        "GET",
        f"{BASE_PATH}/control",
        tag="control",
        summary="The controller of a robot",
        returns="the state of control",
        freshness=Freshness.GIVEN,
    )
    async def control(self, request: ApiRequest, robot: str) -> ControlInfo:
        return await self._gateway.control(request.principal, robot, request.address)

    @endpoint(
        "PUT",
        f"{BASE_PATH}/control",
        tag="control",
        summary="Take control of a robot, or request it from its controller",
        more="Control belongs to a session of the token at this robot: commands sent to topics with the same token "
        f"are the controller's. The session ends {LINGER_SECONDS:g} s after its latest request, and control with it. "
        "Repeat this request in time to keep control. 409 if another client already requests control, or if the "
        "request was not granted.",
        returns={200: "the caller has control", 202: "the controller was asked for control"},
        parameters=(header("Prefer", "`wait=` seconds to wait for the controller's answer (RFC 7240)"),),
        headers={APPLIED: "the wait that is applied"},
        freshness=Freshness.GIVEN,
        errors=(409,),
    )
    async def take(
        self, request: ApiRequest, robot: str, body: Why = NO_REASON
    ) -> ControlTakeInfo | Accepted[ControlTakeInfo]:
        # A client that disconnects during the wait must not get control.
        enable_tcp_keepalive(request.http.channel.transport)
        seconds = wait_preferred(request.http) or 0.0
        taken = await self._gateway.take(request.principal, robot, body.why, request.address, seconds)
        answer: ControlTakeInfo = {
            **_answer(taken.answer),
            "kept": LINGER_SECONDS,
            "control": taken.control,
        }
        return answer if taken.answer.success else Accepted(answer)

    @endpoint(
        "DELETE",
        f"{BASE_PATH}/control",
        tag="control",
        summary="Release the control taken by `PUT`, or withdraw that request",
        more="The caller's other connections are not affected. Never rate limited.",
        returns="the session neither has control nor requests it",
        freshness=Freshness.GIVEN,
        # Releasing control stops the robot.
        proved_from_memory=True,
        never_limited=True,
    )
    async def give_back(self, request: ApiRequest, robot: str) -> None:
        await self._gateway.release_own(request.principal, robot, request.address)

    @endpoint(
        "POST",
        f"{BASE_PATH}/control/release",
        tag="control",
        summary="Release control, or withdraw a request for it",
        more="For all connections of the caller.",
        returns="released",
        errors=(409,),
    )
    async def release(self, request: ApiRequest, robot: str, body: Why = NO_REASON) -> ControlAnswer:
        return _answer(await self._gateway.release(request.principal, robot, body.why, request.address))

    @endpoint(
        "POST",
        f"{BASE_PATH}/control/grant",
        tag="control",
        summary="Hand control over to the client that requests it",
        more="For all connections of the caller.",
        returns="handed over",
        errors=(409,),
    )
    async def grant(
        self, request: ApiRequest, robot: str, body: ControlReplyBody = NO_REPLY
    ) -> ControlAnswer:
        principal = request.principal
        return _answer(await self._gateway.grant(principal, robot, body.why, request.address, body.client))

    @endpoint(
        "POST",
        f"{BASE_PATH}/control/refuse",
        tag="control",
        summary="Refuse a request for control",
        more="For all connections of the caller.",
        returns="refused",
        errors=(409,),
    )
    async def refuse(
        self, request: ApiRequest, robot: str, body: ControlReplyBody = NO_REPLY
    ) -> ControlAnswer:
        principal = request.principal
        return _answer(await self._gateway.refuse(principal, robot, body.why, request.address, body.client))

    # --- stop and resume ----------------------------------------------------------------------------------

    @endpoint(
        "POST",
        f"{BASE_PATH}/stop",
        tag="control",
        summary="Stop a robot",
        more="For every user with a right on the robot. A stop is never refused for its reason or id, and never rate "
        "limited.",
        returns={200: "stopped", 202: "not reached yet; stopped as soon as it can be reached"},
        raw_body=StopRequestBody,
        raw_optional=True,
        freshness=Freshness.GIVEN,
        proved_from_memory=True,
        stored_if_unreachable=True,
        never_limited=True,
        # The robot is stopped even if the client leaves.
        shielded=True,
        problems={
            409: Response("stopped, except for the parts that the error names", StopProblem, media=(PROBLEM,))
        },
    )
    async def stop(self, request: ApiRequest, robot: str) -> StopAnswer | Accepted[StopAnswer]:
        reason, stop_id = stop_arguments(_fields(request.content()))
        outcome = await self._gateway.stop(request.principal, robot, reason, request.address, stop_id)
        if outcome.failed:
            raise StopProblemError(outcome.sentence(robot), outcome.stopped)
        answer: StopAnswer = {"stopped": outcome.stopped}
        return answer if outcome.done else Accepted(answer)

    @endpoint(
        "POST",
        f"{BASE_PATH}/services/relay/stop",
        tag="control",
        summary="Stop a robot by the service `/relay/stop`",
        more="By the rules of `POST …/stop`: never refused for its body, and never rate limited.",
        returns="the answer of the service",
        raw_body=StopServiceBody,
        raw_optional=True,
        freshness=Freshness.GIVEN,
        proved_from_memory=True,
        stored_if_unreachable=True,
        never_limited=True,
        shielded=True,
    )
    async def stop_by_service(self, request: ApiRequest, robot: str) -> StopServiceAnswer:
        reason, stop_id = stop_arguments(_fields(request.content()).get("args"))
        outcome = await self._gateway.stop(request.principal, robot, reason, request.address, stop_id)
        return {"values": outcome.values(robot)}

    @endpoint(
        "POST",
        f"{BASE_PATH}/resume",
        tag="control",
        summary="Resume a stopped robot",
        more="For the controller and for owners. 412 (`stopped_since`) if the robot may have been stopped after the "
        "answer that gave the freshness token; 428 without a token.",
        returns="resumed",
        freshness=Freshness.NEEDED,
        errors=(409,),
    )
    async def resume(self, request: ApiRequest, robot: str, body: Why = NO_REASON) -> StopAnswer:
        assert request.earliest_sent is not None
        await self._gateway.resume(request.principal, robot, body.why, request.address, request.earliest_sent)
        return {"stopped": None}

    # --- suppress, inhibit, hold --------------------------------------------------------------------------

    @endpoint(
        "POST",
        f"{BASE_PATH}/suppress",
        tag="control",
        summary="Suppress a topic: only the caller commands it for a time",
        returns="the request",
        freshness=Freshness.GIVEN,
        errors=(409,),
    )
    async def suppress(self, request: ApiRequest, robot: str, body: Suppress) -> Suppress:
        await self._gateway.suppress(request.principal, robot, body.resource, body.ms, request.address)
        return body

    @endpoint(
        "POST",
        f"{BASE_PATH}/inhibit",
        tag="control",
        summary="Inhibit a topic: forward no messages for a time",
        returns="the request",
        freshness=Freshness.GIVEN,
        errors=(409,),
    )
    async def inhibit(self, request: ApiRequest, robot: str, body: Inhibit) -> Inhibit:
        return await self._inhibited(request, robot, body, hold=False)

    @endpoint(
        "POST",
        f"{BASE_PATH}/hold",
        tag="control",
        summary="Hold a topic at its last value for a time",
        more="New messages are not delivered. The last value before the hold is sent instead.",
        returns="the request",
        freshness=Freshness.GIVEN,
        errors=(409,),
    )
    async def hold(self, request: ApiRequest, robot: str, body: Inhibit) -> Inhibit:
        return await self._inhibited(request, robot, body, hold=True)

    async def _inhibited(self, request: ApiRequest, robot: str, body: Inhibit, *, hold: bool) -> Inhibit:
        await self._gateway.inhibit(request.principal, robot, body.resource, body.ms, hold, request.address)
        return body


def _answer(reply: ControlReply) -> ControlAnswer:
    return {"success": reply.success, "message": reply.message}


def _fields(content: bytes) -> dict[str, Any]:
    """The body of a stop; empty if it is unreadable, since no stop is refused for its body."""
    try:
        body = jsontext.decode_any(content)
    except SwitchboardError:
        return {}
    return body if isinstance(body, dict) else {}
