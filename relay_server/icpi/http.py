"""``/api/v1/programs``: the caller's programs that are connected by ICPI."""

from __future__ import annotations

import msgspec

from relay_server.http.endpoint import ApiRequest, endpoint
from relay_server.icpi.programs import ProgramRegistry

PROGRAMS_PATH = "/api/v1/programs"


class ProgramInfo(msgspec.Struct, frozen=True):
    """A program, while it is connected and registered.

    :param ports: names, which get and set values
    :param functions: names, which can be called
    """

    name: str
    ports: list[str]
    functions: list[str]


class ProgramList(msgspec.Struct, frozen=True):
    """Programs of one user, by name."""

    programs: list[ProgramInfo]


class ProgramEndpoints:
    """Programs of the caller."""

    def __init__(self, programs: ProgramRegistry) -> None:
        self._programs = programs

    @endpoint(
        "GET",
        PROGRAMS_PATH,
        tag="pipes",
        summary="The caller's programs that are connected by ICPI",
        more="Their ports and functions can be ends of pipes, and elements of Roles.",
        returns="programs",
    )
    async def programs(self, request: ApiRequest) -> ProgramList:
        request.principal.require_full_scope()
        return ProgramList(
            [
                ProgramInfo(each.name, sorted(each.ports), sorted(each.functions))
                for each in self._programs.of(request.principal.user_id)
            ]
        )
