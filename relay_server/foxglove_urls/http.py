"""``/api/v1/robots/<robot>/foxglove-urls``: URLs by which Foxglove and Lichtblick open a robot."""

from __future__ import annotations

from relay_server.foxglove_urls.schemas import FoxgloveUrls, MadeFoxgloveUrl, NewFoxgloveUrl
from relay_server.foxglove_urls.service import FoxgloveUrlService
from relay_server.http.endpoint import ApiRequest, Created, IdempotencyKey, endpoint

BASE_PATH = "/api/v1/robots/{robot}/foxglove-urls"


class FoxgloveUrlEndpoints:
    """The caller's Foxglove URLs of a robot."""

    def __init__(self, service: FoxgloveUrlService) -> None:
        self._service = service

    @endpoint(
        "GET",
        BASE_PATH,
        tag="foxglove",
        summary="The caller's Foxglove URLs of a robot, without their tokens",
        returns="URLs",
        errors=(404,),
    )
    async def urls(self, request: ApiRequest, robot: str) -> FoxgloveUrls:
        return await self._service.urls(request.principal, robot)

    @endpoint(
        "POST",
        BASE_PATH,
        tag="foxglove",
        summary="Make a Foxglove URL",
        more="It is shown only in this answer. It opens Foxglove websockets of this robot, and nothing else.",
        returns="the URL",
        key=IdempotencyKey.REFUSED,
        errors=(404, 409),
    )
    async def add(self, request: ApiRequest, robot: str, body: NewFoxgloveUrl) -> Created[MadeFoxgloveUrl]:
        made = await self._service.add(request.principal, request.address, robot, body, request.base)
        return Created(made)

    @endpoint(
        "DELETE",
        f"{BASE_PATH}/{{id}}",
        tag="foxglove",
        summary="Revoke a Foxglove URL, and cut what is connected by it",
        returns="revoked",
        errors=(404,),
    )
    async def revoke(self, request: ApiRequest, robot: str, id: str) -> None:
        await self._service.revoke(request.principal, request.address, robot, id)
