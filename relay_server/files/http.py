"""``/api/v1/robots/<robot>/files``: files that robots have uploaded."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from typing import Annotated

import msgspec
from msgspec import Meta
from werkzeug.http import parse_content_range_header

from relay_protocol.errors import Invalid
from relay_server.common.clock import Clock
from relay_server.files.schemas import FileInfo, FilePage, UploadInfo
from relay_server.files.service import PAGE, PAGE_MOST, FileService, UploadPart
from relay_server.http.download import FILE, PARAMETERS, download
from relay_server.http.endpoint import Accepted, ApiRequest, Created, Streamed, endpoint
from relay_server.http.openapi.operation import header

BASE_PATH = "/api/v1/robots/{robot}/files"
MOST_BYTES = 2**62
"""Largest size of a file that is stored in the database."""

_HASH = Annotated[str, Meta(pattern=r"^[0-9a-f]{64}\Z")]


class FileListQuery(msgspec.Struct, frozen=True):
    """A page of files.

    :param limit: most files of an answer
    :param after: `next` of the previous page
    :param prefix: of the names
    """

    limit: Annotated[int, Meta(ge=1, le=PAGE_MOST)] = PAGE
    after: str = ""
    prefix: str = ""


class FileQuery(msgspec.Struct, frozen=True):
    """One of several files of the same name.

    :param sha256: of the content
    """

    sha256: _HASH | None = None


class FileUploadQuery(msgspec.Struct, frozen=True):
    """A file that is uploaded.

    :param sha256: of the whole file; may be left out with a request that carries all of it
    :param modified: when the file was changed last, Unix seconds; now by default
    """

    sha256: _HASH | None = None
    modified: Annotated[float, Meta(ge=0, le=1e11)] | None = None


class FileEndpoints:
    """Files of robots."""

    def __init__(self, clock: Clock, service: FileService, wall: Callable[[], float] = time.time) -> None:
        self._clock = clock
        self._service = service
        self._wall = wall

    @endpoint("GET", BASE_PATH, tag="files", summary="Files of a robot, by name", returns="files")
    async def list(self, request: ApiRequest, robot: str, query: FileListQuery) -> FilePage:
        return await self._service.page(
            request.principal,
            robot,
            request.address,
            limit=query.limit,
            after=query.after,
            prefix=query.prefix,
        )

    @endpoint(
        "GET",
        f"{BASE_PATH}/{{name:path}}",
        tag="files",
        summary="Download a file",
        more="Of several files of this name, the one that was stored last.",
        returns={200: "the file", 206: "a part of it"},
        forms=(FILE,),
        parameters=PARAMETERS,
        headers={"ETag": "entity tag of the content"},
        errors=(416,),
        any_relay=True,
        lasts="The file may be very large; it is sent as fast as the client reads.",
    )
    async def file(self, request: ApiRequest, robot: str, name: str, query: FileQuery) -> Streamed:
        file = await self._service.download(request.principal, robot, name, request.address, query.sha256)
        return await download(self._clock, request, file)

    @endpoint(
        "PUT",
        f"{BASE_PATH}/{{name:path}}",
        tag="files",
        summary="Upload a file, or a part of it",
        more="For owners of the robot. The body has at most 8 MiB. A larger file comes in parts, in order, each with "
        "its place in `Content-Range`; bytes that are there are skipped. `bytes */` and the size, without a body, "
        "asks where to go on. A file is stored when it is complete and its SHA-256 is right; it replaces no other of "
        "its name.",
        returns={201: "stored durably", 202: "the relay has `received` bytes; the next part begins there"},
        reads=(FILE,),
        raw_body=bytes,
        raw_optional=True,
        parameters=(header("Content-Range", "the place of the part in the file"),),
        errors=(409, 422),
        shielded=True,
    )
    async def put(
        self, request: ApiRequest, robot: str, name: str, query: FileUploadQuery
    ) -> Created[FileInfo] | Accepted[UploadInfo]:
        part = _part_of(request, query, self._wall())
        taken = await self._service.upload(request.principal, robot, name, request.address, part)
        return Created(taken) if isinstance(taken, FileInfo) else Accepted(taken)

    @endpoint(
        "DELETE",
        f"{BASE_PATH}/{{name:path}}",
        tag="files",
        summary="Delete all files of a name",
        more="Also those that are being uploaded. For owners of the robot. A file that its robot still has may be "
        "uploaded again.",
        returns="deleted",
    )
    async def delete(self, request: ApiRequest, robot: str, name: str, query: FileQuery) -> None:
        await self._service.delete(request.principal, robot, name, request.address, query.sha256)


def _part_of(request: ApiRequest, query: FileUploadQuery, now: float) -> UploadPart:
    """The part of a file that a request carries.

    :raises Invalid: its place or its hash is missing, or can't be
    """
    data, field = request.content(), request.header("content-range")
    modified = now if query.modified is None else query.modified
    if field is None:
        return UploadPart(query.sha256 or hashlib.sha256(data).hexdigest(), len(data), modified, 0, data)
    place = parse_content_range_header(field)
    size = None if place is None else place.length
    if place is None or place.units != "bytes" or size is None or not (place.stop or 0) <= size <= MOST_BYTES:
        raise Invalid("'Content-Range' must be such as 'bytes 0-1023/5000' or 'bytes */5000'")
    if query.sha256 is None:
        raise Invalid("with 'Content-Range' the query must have 'sha256', that of the whole file")
    if (place.stop or 0) - (place.start or 0) != len(data):
        raise Invalid(f"'Content-Range' names other bytes than the {len(data)} of the body")
    return UploadPart(query.sha256, size, modified, place.start, data)
