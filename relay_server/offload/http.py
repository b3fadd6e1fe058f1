"""``/api/v1/functions``: functions that run on workers, and ``/api/v1/jobs``: their calls."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import Meta
from twisted.internet.defer import CancelledError

from relay_protocol import jsontext
from relay_protocol.errors import MalformedMessage
from relay_protocol.functions import FAULTS, CallFailed, to_json
from relay_protocol.limits import NAME
from relay_server.cluster.relays import RelayInfo
from relay_server.http.endpoint import Accepted, Answered, ApiRequest, Document, Endpoint, endpoint
from relay_server.http.idempotency import KEY_HEADER, key_in
from relay_server.http.media_types import JSON, MSGPACK, MediaType, sent
from relay_server.http.openapi.operation import header, raw
from relay_server.http.request_fields import wait_preferred
from relay_server.offload.jobs import Job
from relay_server.offload.openapi import functions_document
from relay_server.offload.schemas import FunctionList, FunctionResult, JobList, JobStatus
from relay_server.offload.service import FunctionService, job_owner

FUNCTIONS_PATH = "/api/v1/functions"
JOBS_PATH = "/api/v1/jobs"

WAIT_SECONDS = 30.0
"""Time for which a call waits for its result without ``Prefer: wait``."""

_WAIT = header("Prefer", "`wait=` seconds to wait for the result (RFC 7240)")
_KEY = header(KEY_HEADER, "a key chosen by the client; a repeated call with the same key is carried out once")
_EMPTY = msgspec.msgpack.encode({})


MAX_SECONDS = 86_400.0
"""Longest time that a caller gives a call."""


class FunctionCall(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A call of a function, as JSON or MessagePack.

    :param arguments: by name, as the function's schema says. Bytes and arrays (`.npy`) are base64 in JSON; in
        MessagePack they are bytes
    :param version: of the function; without it the newest
    :param robot: for which it is called, so that it counts for this robot; the right `run` on it is needed. Without
        it, the right on any robot will do
    :param deadline: seconds from now, with waiting for a worker, after which the call fails
    """

    arguments: msgspec.Raw = raw(b"{}")
    version: Annotated[int, Meta(ge=1)] | None = None
    robot: Annotated[str, Meta(max_length=NAME)] = ""
    deadline: Annotated[float, Meta(gt=0, le=MAX_SECONDS)] | None = None


class FunctionFailed(CallFailed):
    """A call has ended without a result."""

    http_status = 422


class FunctionEndpoints:
    """Functions and their jobs."""

    def __init__(self, service: FunctionService) -> None:
        self._service = service

    async def relay_of(self, request: ApiRequest, job: str = "", function: str = "") -> RelayInfo | None:
        """The other relay that works on a job."""
        if not job or request.forwarding is None:
            return None
        return request.forwarding.find(await self._service.relay_of(job))

    @endpoint(
        "GET",
        FUNCTIONS_PATH,
        tag="functions",
        summary="The functions that the caller may run, and the workers",
        returns="functions",
        seconds=60.0,
    )
    async def functions(self, request: ApiRequest) -> FunctionList:
        return await self._service.functions(request.principal)

    @endpoint(
        "GET",
        f"{FUNCTIONS_PATH}/openapi.json",
        tag="functions",
        summary="The functions that the caller may run as an OpenAPI document",
        more="Each function is a path, with the schemas of its arguments and of its result, so that generators of "
        "clients know them.",
        returns="OpenAPI 3.1",
        seconds=60.0,
    )
    async def openapi(self, request: ApiRequest) -> Document:
        found = await self._service.functions(request.principal)
        return Document(jsontext.encode(functions_document(FUNCTIONS_PATH, found.functions)), JSON.media)

    @endpoint(
        "POST",
        f"{FUNCTIONS_PATH}/{{function}}",
        tag="functions",
        summary="Call a function",
        more="The answer comes when the function has ended, at the latest after the time to wait; then it is the job. "
        "`Prefer: wait=0` or `respond-async` begins a job and does not wait. A body may have 24 MiB.",
        returns={200: "the result", 202: "the call goes on as a job"},
        reads=(JSON, MSGPACK),
        forms=(JSON, MSGPACK),
        parameters=(_WAIT, _KEY),
        headers={"Location": "address of the job, with 202"},
        errors=(404, 413, 422, 429),
        seconds=WAIT_SECONDS,
    )
    async def call(
        self, request: ApiRequest, function: str, body: FunctionCall
    ) -> Answered[FunctionResult] | Accepted[JobStatus] | Document:
        owner, payer = await self._service.user(request.principal, function, body.robot)
        seconds = wait_preferred(request.http)
        if seconds is None:
            seconds = 0.0 if _prefers_async(request) else WAIT_SECONDS
        job = await self._service.submit(
            owner,
            function,
            _arguments(request, body),
            version=body.version,
            deadline=body.deadline,
            payer=payer,
            keep=seconds <= 0,
            key=key_in(request.http.requestHeaders.getRawHeaders(KEY_HEADER, [])),
        )
        try:
            await self._service.wait(job, seconds)
        except CancelledError:
            # The client has disconnected and does not know the job.
            if not job.stored:
                self._service.cancel(job)
            raise
        if not job.over:
            await self._service.keep(job)
        return self._answer(request, job)

    async def admit_body(self, request: ApiRequest, function: str) -> None:
        """See :class:`relay_server.http.router.Router`."""
        await self._service.user(request.principal, function)

    async def read_body(
        self, request: ApiRequest, endpoint: Endpoint, form: MediaType, **path: Any
    ) -> FunctionCall:
        """Read a call in MessagePack."""
        try:
            return msgspec.msgpack.decode(request.content(), type=FunctionCall)
        except FAULTS as error:
            raise MalformedMessage(f"the body is no call of a function: {error}") from None

    @endpoint(
        "GET",
        JOBS_PATH,
        tag="functions",
        summary="The caller's jobs; for an administrator, all of the realm",
        returns="jobs",
    )
    async def jobs(self, request: ApiRequest) -> JobList:
        return await self._service.jobs(request.principal)

    @endpoint(
        "GET",
        f"{JOBS_PATH}/{{job}}",
        tag="functions",
        summary="The state of a job",
        returns="the job",
        parameters=(_WAIT,),
    )
    async def job(self, request: ApiRequest, job: str) -> JobStatus:
        return (await self._awaited(request, job)).status()

    @endpoint(
        "GET",
        f"{JOBS_PATH}/{{job}}/result",
        tag="functions",
        summary="The result of a job",
        more="It is kept for a day, and for ten minutes after it was fetched.",
        returns={200: "the result", 202: "the job has not ended"},
        forms=(JSON, MSGPACK),
        parameters=(_WAIT,),
        errors=(422,),
    )
    async def result(
        self, request: ApiRequest, job: str
    ) -> Answered[FunctionResult] | Accepted[JobStatus] | Document:
        return self._answer(request, await self._awaited(request, job))

    @endpoint(
        "DELETE",
        f"{JOBS_PATH}/{{job}}",
        tag="functions",
        summary="Cancel a job, or remove one that has ended",
        returns="done",
    )
    async def remove(self, request: ApiRequest, job: str) -> None:
        await self._service.remove(await self._find(request, job))

    async def _find(self, request: ApiRequest, job: str) -> Job:
        principal = request.principal
        found = await self._service.job(job_owner(principal), job, admin=principal.admin)
        await self._service.require_reach(principal, found)
        return found

    async def _awaited(self, request: ApiRequest, id: str) -> Job:
        """A job, after the time that the request waits for its end."""
        job = await self._find(request, id)
        await self._service.wait(job, wait_preferred(request.http) or 0.0)
        return job

    def _answer(
        self, request: ApiRequest, job: Job
    ) -> Answered[FunctionResult] | Accepted[JobStatus] | Document:
        """The result of a call, or the job if it has not ended."""
        outcome = job.outcome
        packed = request.form is MSGPACK
        if outcome is None:
            status = job.status()
            return _packed(status, 202) if packed else Accepted(status, headers=_location(job))
        if outcome.value is None:
            raise FunctionFailed(outcome.code, outcome.error)
        value = outcome.value if packed else to_json(outcome.value)
        self._service.fetched(job)
        result = FunctionResult(job=job.id, seconds=outcome.seconds, result=msgspec.Raw(value))
        return _packed(result, 200) if packed else Answered(result)


def _arguments(request: ApiRequest, body: FunctionCall) -> bytes:
    """The arguments as MessagePack."""
    given = bytes(body.arguments)
    if sent(request.http.getHeader("content-type"), (JSON, MSGPACK)) is MSGPACK:
        return _EMPTY if given == b"{}" else given
    try:
        return msgspec.msgpack.encode(msgspec.json.decode(given))
    except FAULTS as error:
        raise MalformedMessage(f"the arguments can't be read: {error}") from None


def _prefers_async(request: ApiRequest) -> bool:
    return "respond-async" in (request.header("prefer") or "").lower()


def _location(job: Job) -> dict[str, str]:
    return {"location": f"{JOBS_PATH}/{job.id}"}


def _packed(value: Any, status: int) -> Document:
    return Document(msgspec.msgpack.encode(value), MSGPACK.media, status=status)
