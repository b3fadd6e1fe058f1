"""``/relay/…`` services and actions about functions."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Annotated, Any

import msgspec
from twisted.internet.defer import CancelledError

from relay_protocol import json_cost, jsontext
from relay_protocol.errors import Invalid, MalformedMessage, SwitchboardError
from relay_protocol.function_link import MAX_DEADLINE
from relay_protocol.functions import FAULTS, to_json
from relay_server.channels.goals import GoalResult, GoalStatusCode, OwnGoal
from relay_server.offload.jobs import Job
from relay_server.offload.service import FunctionService, job_owner
from relay_server.relay_node.arguments import get_argument, text, whole_number
from relay_server.sessions.context import ClientContext, StartOwnGoal

MAX_TIMEOUT = 60.0


class FunctionRosServices:
    """The services about functions, of all robots, for one client at a time."""

    def __init__(self, service: FunctionService) -> None:
        self._service = service

    def handlers(self) -> dict[str, Callable[[ClientContext, Any], Coroutine[Any, Any, Any]]]:
        """Services by name."""
        return {
            "/relay/functions": self.functions,
            "/relay/call_function": self.call,
            "/relay/function_job": self.job,
        }

    def actions(self) -> dict[str, StartOwnGoal]:
        """Actions by name."""
        return {"/relay/run_function": self.run}

    async def functions(self, client: ClientContext, args: Any) -> Any:
        """``/relay/functions``"""
        found = await self._service.functions(client.permit.principal)
        return {
            "functions": [
                {
                    "name": each.name,
                    "version": each.version,
                    "text": each.text,
                    "arguments": msgspec.json.encode(each.arguments).decode(),
                    "result": msgspec.json.encode(each.result).decode(),
                }
                for each in found.functions
            ]
        }

    async def call(self, client: ClientContext, args: Any) -> Any:
        """``/relay/call_function``: ``arguments`` is JSON. It counts for the robot of the connection."""
        name, version = text(args, "function"), whole_number(args, "version", 2, 0)
        timeout = _seconds(args, "timeout", 3)
        arguments = _packed(text(args, "arguments", 1, ""))
        owner, payer = await self._service.user(client.permit.principal, name, client.robot.name)
        job = await self._service.submit(
            owner, name, arguments, version=version or None, payer=payer, keep=timeout <= 0
        )
        try:
            await self._service.wait(job, timeout)
        except CancelledError:
            # The client has left and does not know the job.
            if not job.stored:
                self._service.cancel(job)
            raise
        if not job.over:
            await self._service.keep(job)
        return _state(job)

    async def run(self, client: ClientContext, args: bytes, goal: OwnGoal) -> None:
        """``/relay/run_function``: a goal that ends with its job. It counts for the robot of the connection.

        :raises SwitchboardError: it can't begin
        """
        with client.quota.counted():
            json_cost.check(args)
            try:
                wanted = jsontext.decode(_GOAL, args or b"{}")
            except MalformedMessage as error:
                raise Invalid(f"a goal of /relay/run_function can't be read: {error}") from None
            arguments = _packed(wanted.arguments)
        owner, payer = await self._service.user(client.permit.principal, wanted.function, client.robot.name)
        job = await self._service.submit(
            owner,
            wanted.function,
            arguments,
            version=wanted.version or None,
            deadline=wanted.deadline or None,
            payer=payer,
        )
        execution = _Execution(self._service, job, goal)
        goal.executor = execution
        job.on_progress = execution.progressed
        job.wait().addCallback(execution.ended)

    async def job(self, client: ClientContext, args: Any) -> Any:
        """``/relay/function_job``"""
        principal = client.permit.principal
        job = await self._service.job(job_owner(principal), text(args, "job"), admin=principal.admin)
        await self._service.require_reach(principal, job)
        if get_argument(args, "cancel", 2, False) is True:
            await self._service.remove(job)
        await self._service.wait(job, _seconds(args, "wait", 1))
        return {**_state(job), "progress": job.progress}


class _FunctionGoal(msgspec.Struct, frozen=True):
    """The arguments of a goal.

    :param arguments: JSON text
    :param version: 0: the newest
    :param deadline: seconds; 0: as for a call without one
    """

    function: str
    arguments: str = ""
    version: Annotated[int, msgspec.Meta(ge=0)] = 0
    deadline: Annotated[float, msgspec.Meta(ge=0, le=MAX_DEADLINE)] = 0.0


_GOAL = msgspec.json.Decoder(_FunctionGoal)


class _Execution:
    """A job as the executor of a goal (:class:`relay_server.channels.goals.Executor`)."""

    def __init__(self, service: FunctionService, job: Job, goal: OwnGoal) -> None:
        self._service = service
        self._job = job
        self._goal = goal

    def cancel(self) -> None:
        """End the job."""
        self._service.cancel(self._job)

    def forget(self) -> None:
        """The job has been cancelled before."""

    def progressed(self) -> None:
        """The function has reported its progress."""
        job = self._job
        self._goal.feedback_received(
            jsontext.encode({"progress": job.progress, "text": job.text, "state": job.state})
        )

    def ended(self, _: None) -> None:
        """The job has ended: with a result, or a reason why there is none."""
        job = self._job
        if job.state == "cancelled":
            self._goal.end(GoalResult(GoalStatusCode.CANCELED, None, job.status().error))
        elif job.state == "failed":
            status = job.status()
            self._goal.end(GoalResult(GoalStatusCode.ABORTED, None, f"{status.code}: {status.error}"))
        else:
            self._goal.end(self._result())

    def _result(self) -> GoalResult:
        try:
            return GoalResult(GoalStatusCode.SUCCEEDED, jsontext.encode(_state(self._job)))
        except SwitchboardError as error:
            return GoalResult(GoalStatusCode.ABORTED, None, f"{error.code}: {error}")


def _packed(arguments: str) -> bytes:
    """Arguments of a function as MessagePack.

    :param arguments: JSON text; empty for none
    :raises Invalid: it can't be read
    """
    given = (arguments or "{}").encode()
    try:
        json_cost.check(given)
        return msgspec.msgpack.encode(jsontext.decode_any(given))
    except (MalformedMessage, *FAULTS) as error:
        raise Invalid(f"'arguments' can't be read: {error}") from None


def _seconds(args: Any, name: str, position: int) -> float:
    value = get_argument(args, name, position, 0)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= MAX_TIMEOUT:
        raise Invalid(f"'{name}' must be a number of seconds from 0 to {MAX_TIMEOUT:g}")
    return float(value)


def _state(job: Job) -> dict[str, Any]:
    status, outcome = job.status(), job.outcome
    value = b"" if outcome is None or outcome.value is None else to_json(outcome.value)
    return {
        "success": status.state not in ("failed", "cancelled"),
        "job": job.id,
        "state": status.state,
        "result": value.decode(),
        "code": status.code,
        "message": status.error,
    }
