"""Requests with an ``Idempotency-Key`` (SPEC section 1.13): what they ask for is done once."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

import msgspec
from twisted.internet.defer import Deferred
from twisted.web.server import Request

from relay_protocol.errors import Invalid
from relay_protocol.rights import Operation
from relay_server.access import Principal
from relay_server.channels.robot_link import resolve
from relay_server.http.idempotency import KEY_HEADER, Idempotency, StoredReply, Target, key_in
from relay_server.http.openapi.operation import header
from relay_server.resources.goals import GoalOwner
from relay_server.resources.service import RequestOrigin, RobotResourceService
from relay_server.sessions.service_calls import URGENT

Work = Callable[[], Coroutine[Deferred[Any], Any, StoredReply]]
May = Callable[[], Coroutine[Deferred[Any], Any, None]]


KEYED = header(KEY_HEADER, "a key of the sender's: the same again is not done again")


class IdempotentRequests:
    """What requests with a key were answered."""

    def __init__(self, memory: Idempotency, desk: RobotResourceService) -> None:
        self._memory = memory
        self._desk = desk

    async def reply(
        self, request: Request, asker: RequestOrigin, operation: Operation, name: str, work: Work
    ) -> StoredReply:
        """Do what a request asks for, unless it was done already.

        :param operation: that it is, on the resource of that name
        :raises SwitchboardError: as ``work``, or the key can't be, or stands for something else
        """
        if operation is Operation.CALL and resolve(name) in URGENT:
            # Who stops a robot with a key that he has used before means it.
            return await work()

        async def may() -> None:
            await self._desk.may(asker, operation, name)

        return await once(self._memory, request, asker.principal, asker.robot, work, may)


async def once(
    memory: Idempotency,
    request: Request,
    principal: Principal,
    robot: str,
    work: Work,
    may: May,
) -> StoredReply:
    """Do what a request asks for, unless it was done already.

    :param robot: whose address it is sent to, or empty
    :param may: raises what keeps the asker from being given the answer of an earlier request
    :raises SwitchboardError: as ``work``, or the key can't be, or stands for something else
    """
    key = key_in(request.requestHeaders.getRawHeaders(KEY_HEADER, []))
    if key is None:
        return await work()
    address = request.path.decode("ascii", "replace")
    request.content.seek(0)
    body = request.content.read()
    return await memory.once(Target(GoalOwner.of(principal), robot, address, key), body, work, may)


def see_no_key(request: Request) -> None:
    """See that a request has none, where the same again would be done again.

    :raises Invalid: it has one
    """
    if request.requestHeaders.hasHeader(KEY_HEADER):
        raise Invalid(
            f"'{KEY_HEADER}' is not understood at this address, and the same again would be done again: leave it "
            "out, and where no answer came look first whether it was done"
        )


def send(request: Request, reply: StoredReply) -> Any:
    """A reply, as the API answers with it."""
    request.setResponseCode(reply.status)
    if reply.location:
        request.setHeader("location", reply.location)
    return msgspec.Raw(reply.body) if reply.body else None
