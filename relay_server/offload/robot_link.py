"""The relay's end of function links, which robots dial beside their control link."""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Coroutine
from typing import Any

import msgspec
from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_db import queries
from relay_db.queries import RobotKeyRecord
from relay_protocol import jsontext, limits, link
from relay_protocol.errors import MalformedMessage, Refused, SwitchboardError, Unavailable
from relay_protocol.frames import SampleFrame
from relay_protocol.function_link import (
    MAX_DEADLINE,
    CallFunction,
    CancelFunction,
    FetchResult,
    FunctionReply,
    FunctionRequest,
    decode_request,
)
from relay_protocol.functions import FAULTS
from relay_protocol.limits import FUNCTION_BYTES
from relay_protocol.realms import full_name
from relay_server.common.clock import Clock, PeriodicTimer, PeriodicTimers
from relay_server.common.database import AsyncDatabase
from relay_server.offload.jobs import Job, JobOwner
from relay_server.offload.service import FunctionService
from relay_server.robots.connection import ON_EVERY_LINK, LinkHandler, RobotConnection

MAX_REQUESTS = 64
"""Most requests of one link without an answer."""

MAX_LINKS = 4
"""Most links of one robot."""

MAX_REPLY_BYTES = 4 * FUNCTION_BYTES
"""Most bytes of results that wait for a slow link."""

CHECK_SECONDS = 2.0
"""Seconds between checks whether the robots' keys are still accepted."""


class FunctionLinks:
    """All function links.

    :param patterns: functions that robots may run (shell wildcards)
    """

    log = Logger()

    def __init__(
        self, clock: Clock, service: FunctionService, database: AsyncDatabase, patterns: tuple[str, ...]
    ) -> None:
        self.service = service
        self._database = database
        self._patterns = patterns
        self._links: set[FunctionLinkHandler] = set()
        self._timers = PeriodicTimers(clock)
        self._checking = PeriodicTimer(self._check_soon, CHECK_SECONDS)

    def handler(self, connection: RobotConnection, robot: RobotKeyRecord, key: str) -> FunctionLinkHandler:
        """The handler of a link whose robot has proved its identity.

        :param key: fingerprint of the robot's key
        :raises Unavailable: the robot has too many links
        """
        if sum(each.robot.id == robot.robot_id for each in self._links) >= MAX_LINKS:
            raise Unavailable(f"this robot has {MAX_LINKS} function links, the most there may be; close one")
        owner = JobOwner("robot", robot.robot_id, full_name(robot.robot, robot.realm), robot.realm)
        handler = FunctionLinkHandler(self, connection, owner, key)
        if not self._links:
            self._timers.start(self._checking)
        self._links.add(handler)
        return handler

    def lost(self, handler: FunctionLinkHandler) -> None:
        """A link has ended."""
        self._links.discard(handler)
        if not self._links:
            self._checking.stop()

    def require(self, function: str) -> None:
        """:raises Refused: robots may not run this function"""
        if not any(fnmatch.fnmatchcase(function, each) for each in self._patterns):
            raise Refused(f"robots may not run function '{function[:63]}' on this relay (--offload-robots)")

    def _check_soon(self) -> None:
        Deferred.fromCoroutine(self._check()).addErrback(
            lambda failure: self.log.warn(
                "keys of function links can't be checked: {why}",
                why=failure.getErrorMessage(),
                limited="keys",
            )
        )

    async def _check(self) -> None:
        links = list(self._links)
        live = await self._database.read(queries.live_keys, {(each.robot.id, each.key) for each in links})
        for each in links:
            if (each.robot.id, each.key) not in live:
                each.connection.close("the robot's key is not accepted any more")


class FunctionLinkHandler(LinkHandler):
    """One function link."""

    log = Logger()

    def __init__(self, links: FunctionLinks, connection: RobotConnection, robot: JobOwner, key: str) -> None:
        self.connection = connection
        self.robot = robot
        self.key = key
        self._links = links
        self._service = links.service
        self._running: dict[int, Job | None] = {}
        """Requests without an answer, with the job if there is one."""

    def message(self, body: bytes) -> None:
        """Pings, and the end of the link."""
        if len(body) > limits.JSON_BODY:
            raise MalformedMessage(
                f"JSON of more than {limits.JSON_BODY} bytes is not taken on a function link"
            )
        message = jsontext.decode(link.robot_control_decoder, body)
        if isinstance(message, ON_EVERY_LINK):
            self.connection.common_message(message)
        else:
            raise MalformedMessage("this message does not go over a function link")

    def sample(self, frame: SampleFrame) -> None:
        """A request."""
        try:
            request: FunctionRequest = decode_request(frame.body)
        except FAULTS as error:
            raise MalformedMessage(f"this is no request of a function link: {error}") from None
        if frame.number in self._running or len(self._running) >= MAX_REQUESTS:
            words = f"{len(self._running)} requests of this link have no answer yet; wait for one"
            self._reply(frame.number, FunctionReply(state="refused", code="too_many_jobs", error=words))
            return
        self._running[frame.number] = None
        if isinstance(request, CallFunction):
            work = self._call(frame.number, request)
        elif isinstance(request, FetchResult):
            work = self._fetch(request)
        else:
            work = self._cancel(request)
        Deferred.fromCoroutine(self._answered(frame.number, work)).addErrback(self._failed, frame.number)

    def lost(self, reason: str) -> None:
        """Calls without a receiver of the answer are ended; kept jobs go on."""
        running, self._running = self._running, {}
        for job in running.values():
            if job is not None and not job.stored:
                self._service.cancel(job)
        self._links.lost(self)

    async def _answered(self, number: int, work: Coroutine[Deferred[Any], Any, FunctionReply]) -> None:
        try:
            reply = await work
        except SwitchboardError as error:
            reply = FunctionReply(state="refused", code=error.code, error=str(error))
        if self._running.pop(number, self) is not self:
            self._reply(number, reply)

    def _failed(self, failure: Any, number: int) -> None:
        self.log.failure("a request of robot {robot} failed", failure, robot=self.robot.name)
        self._running.pop(number, None)
        self._reply(number, FunctionReply(state="failed", code="lost", error="the relay failed; see its log"))

    async def _call(self, number: int, request: CallFunction) -> FunctionReply:
        self._links.require(request.function)
        job = await self._service.submit(
            self.robot,
            request.function,
            request.arguments,
            version=request.version,
            deadline=request.deadline,
            keep=request.keep,
            key=request.key or None,
        )
        if request.keep:
            return reply_of(job)
        if number not in self._running:
            # The link was lost while the call was admitted.
            self._service.cancel(job)
        self._running[number] = job
        job.on_progress = self._progress_sender(number, job)
        await self._service.wait(job, MAX_DEADLINE)
        return reply_of(job)

    def _progress_sender(self, number: int, job: Job) -> Callable[[], None]:
        def send() -> None:
            if number in self._running:
                self._reply(number, msgspec.structs.replace(reply_of(job), final=False))

        return send

    async def _fetch(self, request: FetchResult) -> FunctionReply:
        job = await self._service.job(self.robot, request.job)
        await self._service.wait(job, request.wait)
        self._service.fetched(job)
        return reply_of(job)

    async def _cancel(self, request: CancelFunction) -> FunctionReply:
        running = [each for each in self._running.values() if each is not None and each.id == request.job]
        job = running[0] if running else await self._service.job(self.robot, request.job)
        await self._service.remove(job)
        return reply_of(job)

    def _reply(self, number: int, reply: FunctionReply) -> None:
        body = msgspec.msgpack.encode(reply)
        if not reply.final:
            self.connection.send_progress(number, body)
            return
        if self.connection.reply_bytes + len(body) > MAX_REPLY_BYTES:
            words = f"{self.connection.reply_bytes} bytes of results wait for the robot's slow link; call with keep"
            late = FunctionReply(job=reply.job, state="failed", code="lost", error=words)
            body = msgspec.msgpack.encode(late)
        self.connection.send_reply(number, body)


def reply_of(job: Job) -> FunctionReply:
    """The state of a job for its robot."""
    outcome = job.outcome
    if outcome is None:
        return FunctionReply(job=job.id, state=job.state, progress=job.progress, text=job.text)
    return FunctionReply(
        job=job.id,
        state=job.state,
        code=outcome.code,
        error=outcome.error,
        value=outcome.value,
        seconds=outcome.seconds,
    )
