"""``/api/v1/robots/<robot>/recordings``: recordings of a robot, and their files."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from relay_server.common.clock import Clock
from relay_server.http.download import FILE, PARAMETERS, download
from relay_server.http.endpoint import ApiRequest, Created, IdempotencyKey, Streamed, endpoint
from relay_server.http.idempotency import Idempotency
from relay_server.recordings.recordings import RecordingRequest
from relay_server.recordings.service import (
    PAGE,
    PAGE_MOST,
    Recordable,
    RecordingInfo,
    RecordingPage,
    RecordingService,
    merge_pages,
)

BASE_PATH = "/api/v1/robots/{robot}/recordings"

_decoder = msgspec.json.Decoder(RecordingPage)


class RecordingParameters(msgspec.Struct, frozen=True):
    """A page of recordings.

    :param limit: most recordings of an answer
    :param before: `next` of the previous page
    """

    limit: Annotated[int, Meta(ge=1, le=PAGE_MOST)] = PAGE
    before: str = ""


class RecordingEndpoints:
    """Recordings of robots.

    :param remembered: answers to requests with an idempotency key
    """

    def __init__(self, clock: Clock, service: RecordingService, remembered: Idempotency) -> None:
        self.remembered = remembered
        self._clock = clock
        self._service = service

    @endpoint(
        "GET",
        BASE_PATH,
        tag="recordings",
        summary="Recordings of a robot, the latest first",
        more="Of all relays of a cluster that answer in time.",
        returns="recordings",
    )
    async def list(self, request: ApiRequest, robot: str, query: RecordingParameters) -> RecordingPage:
        page = await self._service.all(request.principal, robot, request.address, query.limit, query.before)
        others = [_decoder.decode(each) for each in await request.answers_of_other_relays()]
        return merge_pages([page, *others], query.limit) if others else page

    @endpoint(
        "POST",
        BASE_PATH,
        tag="recordings",
        summary="Begin a recording",
        returns="the recording",
        key=IdempotencyKey.REMEMBERED,
    )
    async def start(self, request: ApiRequest, robot: str, body: RecordingRequest) -> Created[RecordingInfo]:
        begun = await self._service.start(request.principal, robot, body, request.address)
        return Created(begun, location=f"/api/v1/robots/{robot}/recordings/{begun['id']}")

    @start.replay
    async def may_start(self, request: ApiRequest, robot: str, body: RecordingRequest) -> None:
        await self._service.may_start(request.principal, robot, body, request.address)

    @endpoint(
        "GET",
        f"{BASE_PATH}/new",
        tag="recordings",
        summary="Topics and cameras that could be recorded now",
        returns="topics and cameras",
    )
    async def possible(self, request: ApiRequest, robot: str) -> Recordable:
        return await self._service.possible(request.principal, robot, request.address)

    @endpoint(
        "GET",
        f"{BASE_PATH}/{{id}}",
        tag="recordings",
        summary="One recording",
        returns="the recording",
        any_relay=True,
    )
    async def one(self, request: ApiRequest, robot: str, id: str) -> RecordingInfo:
        return await self._service.one(request.principal, robot, id, request.address)

    @endpoint(
        "DELETE",
        f"{BASE_PATH}/{{id}}",
        tag="recordings",
        summary="Delete a recording",
        more="For the user who began it, and for owners of the robot.",
        returns="deleted",
        any_relay=True,
    )
    async def delete(self, request: ApiRequest, robot: str, id: str) -> None:
        await self._service.delete(request.principal, robot, id, request.address)

    @endpoint(
        "POST",
        f"{BASE_PATH}/{{id}}/stop",
        tag="recordings",
        summary="Finish a recording",
        more="For the user who began it, and for owners of the robot.",
        returns="the recording",
        never_limited=True,
        any_relay=True,
    )
    async def stop(self, request: ApiRequest, robot: str, id: str) -> RecordingInfo:
        return await self._service.stop(request.principal, robot, id, request.address)

    @endpoint(
        "GET",
        f"{BASE_PATH}/{{id}}/file",
        tag="recordings",
        summary="The file of a recording (MCAP)",
        returns={200: "the file", 206: "a part of it"},
        forms=(FILE,),
        parameters=PARAMETERS,
        headers={"ETag": "entity tag of the content"},
        errors=(416,),
        any_relay=True,
        lasts="The file may be very large; it is sent as fast as the client reads.",
    )
    async def file(self, request: ApiRequest, robot: str, id: str) -> Streamed:
        file = await self._service.download(request.principal, robot, id, request.address)
        return await download(self._clock, request, file)
