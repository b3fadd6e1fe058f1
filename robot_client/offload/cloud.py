"""Calls functions on the relay's workers, over a link of its own that is dialled with the first call."""

from __future__ import annotations

import os
import threading
import time
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeout
from pathlib import Path
from typing import Any

import msgspec

from relay_protocol.errors import Invalid, SwitchboardError, Unavailable
from relay_protocol.function_link import (
    MAX_DEADLINE,
    MAX_WAIT,
    CallFunction,
    CancelFunction,
    FetchResult,
    FunctionReply,
)
from relay_protocol.functions import CallFailed, decode_value, encode_value
from relay_protocol.limits import FUNCTION_BYTES, NAME
from robot_client.link.enrolment import StateFolder
from robot_client.offload.device import state_folder
from robot_client.offload.function_link import FunctionConnection, Reply

CALL_SECONDS = 10.0
"""Default time for a call."""

RETRY_SECONDS = 2.0
"""After a failed attempt to reach the relay, calls fail at once for so long."""

_CLOSED = "the program has closed the link"

DONE = frozenset({"done", "failed", "cancelled", "refused"})


class Cloud:
    """The relay's workers, for one robot. Threads may share it.

    :param folder: the robot's state folder; without it, as ``SWITCHBOARD_ROBOT_STATE`` says
    """

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._process = os.getpid()
        self._lock = threading.Lock()
        self._connection: FunctionConnection | None = None
        self._dialled: Future[FunctionConnection] | None = None
        """The link while it is being dialled."""
        self._failed_at = -RETRY_SECONDS
        self._failure = ""

    def call(
        self,
        function: str,
        /,
        *,
        timeout: float = CALL_SECONDS,
        version: int | None = None,
        newest: bool | str = False,
        **arguments: Any,
    ) -> Any:
        """Run a function and wait for its result.

        :param timeout: seconds, for everything, also to reach the relay
        :param newest: while a call of this function is under way, the next one waits, and gives way to a newer one.
            So a slow uplink carries the newest frame. A text, such as a camera's name, keeps the calls of one camera
            apart from those of others
        :raises CallFailed: there is no result; the code says why. After ``lost`` and ``timeout`` it may have run
        :raises Unavailable: the relay or its workers can't be reached, or the call could not be sent in time; it did
            not run
        :raises Invalid: the timeout is out of range
        """
        _check_seconds("timeout", timeout)
        request = CallFunction(
            function=function, arguments=_encode(arguments), version=version, deadline=timeout
        )
        began = time.monotonic()
        connection = self._connected(timeout)
        stream = f"{function} {newest}" if newest else ""
        reply = connection.begin(msgspec.msgpack.encode(request), stream)
        try:
            return result_of(_wait(reply.future, timeout - (time.monotonic() - began), function))
        except CallFailed as error:
            if error.code != "timeout" or not connection.withdraw(reply):
                raise
        raise Unavailable(
            f"the call of function {function} could not be sent in {timeout:g} s: the link is too slow"
        )

    def submit(
        self,
        function: str,
        /,
        *,
        deadline: float | None = None,
        version: int | None = None,
        key: str = "",
        **arguments: Any,
    ) -> Handle:
        """Have a function run, and do not wait. The result is kept until it is fetched, for a day.

        :param deadline: seconds until which it must have ended; an hour by default
        :param key: a repeated submit with this key runs once
        :raises Unavailable: the relay can't be reached
        :raises Invalid: the deadline is out of range, or the key is too long
        """
        if deadline is not None:
            _check_seconds("deadline", deadline)
        if len(key) > NAME:
            raise Invalid(f"the key has {len(key)} characters; at most {NAME} are taken")
        request = CallFunction(
            function=function,
            arguments=_encode(arguments),
            version=version,
            deadline=deadline,
            keep=True,
            key=key,
        )
        return Handle(self, self._begin(request, CALL_SECONDS).future)

    def handle(self, job: str) -> Handle:
        """A job by its id, such as one of an earlier run of this program."""
        known: Future[FunctionReply] = Future()
        known.set_result(FunctionReply(job=job, state="queued"))
        return Handle(self, known)

    def ask(self, request: CancelFunction | FetchResult, timeout: float) -> FunctionReply:
        """Ask about a job.

        :raises CallFailed: no answer came in time, or the link was lost
        :raises Unavailable: the relay can't be reached
        """
        end = time.monotonic() + timeout
        reply = self._begin(request, timeout)
        return _wait(reply.future, end - time.monotonic(), "")

    def close(self) -> None:
        """Close the link. Calls that run fail."""
        with self._lock:
            connection, self._connection, self._dialled = self._connection, None, None
        if connection is not None:
            connection.close(_CLOSED)

    def _begin(self, request: CallFunction | CancelFunction | FetchResult, seconds: float) -> Reply:
        return self._connected(seconds).begin(msgspec.msgpack.encode(request))

    def _connected(self, seconds: float) -> FunctionConnection:
        """The link; it is dialled in a thread of its own, once for all callers, as a lookup of a name can take long."""
        if self._process != os.getpid():
            # The thread of the link has stayed in the process from which this one was forked.
            self._process, self._lock = os.getpid(), threading.Lock()
            self._connection = self._dialled = None
        with self._lock:
            if self._connection is not None and self._connection.open:
                return self._connection
            if time.monotonic() - self._failed_at < RETRY_SECONDS:
                raise Unavailable(self._failure)
            dialled = self._dialled
            if dialled is None:
                dialled = self._dialled = Future()
                threading.Thread(
                    target=self._dial, args=(dialled,), name="dial the relay", daemon=True
                ).start()
        try:
            return dialled.result(max(0.0, seconds))
        except FutureTimeout:
            raise Unavailable(f"the relay can't be reached in {seconds:g} s") from None
        except SwitchboardError as error:
            raise Unavailable(str(error)) from None

    def _dial(self, dialled: Future[FunctionConnection]) -> None:
        connection: FunctionConnection | None = None
        try:
            connection = self._connect()
        except Exception as error:
            failure = error
        with self._lock:
            wanted = self._dialled is dialled
            if wanted:
                self._dialled = None
            if wanted and connection is not None:
                self._connection = connection
            elif wanted:
                self._failed_at, self._failure = time.monotonic(), str(failure)
        if connection is None:
            dialled.set_exception(failure)
            return
        if not wanted:
            connection.close(_CLOSED)
        dialled.set_result(connection)

    def _connect(self) -> FunctionConnection:
        folder = self._folder or state_folder()
        if folder is None:
            raise Unavailable("set SWITCHBOARD_ROBOT_STATE to the robot's state folder")
        enrolment, identity = StateFolder(folder).load()
        return FunctionConnection(enrolment, identity)


class Handle:
    """A job that was submitted."""

    def __init__(self, client: Cloud, begun: Future[FunctionReply]) -> None:
        self._cloud = client
        self._begun = begun

    def id(self, timeout: float = CALL_SECONDS) -> str:
        """The id of the job, as soon as the relay has confirmed it.

        :raises CallFailed: the relay has refused it, or did not answer
        """
        reply = _wait(self._begun, timeout, "")
        if reply.state == "refused":
            raise CallFailed(reply.code, reply.error)
        return reply.job

    def status(self, wait: float = 0.0) -> FunctionReply:
        """The state of the job, after waiting for its end for so many seconds.

        :raises CallFailed: no answer
        :raises Unavailable: the relay can't be reached
        """
        wait = min(max(0.0, wait), MAX_WAIT)
        return self._cloud.ask(FetchResult(job=self.id(), wait=wait), wait + CALL_SECONDS)

    @property
    def state(self) -> str:
        """``queued``, ``running``, ``done``, ``failed`` or ``cancelled``."""
        return self.status().state

    def result(self, timeout: float = CALL_SECONDS) -> Any:
        """The result.

        :raises CallFailed: there is none; with the code ``timeout`` it goes on
        :raises Unavailable: the relay can't be reached
        """
        end = time.monotonic() + timeout
        while True:
            try:
                reply = self.status(max(0.0, end - time.monotonic()))
            except SwitchboardError as error:
                # The job goes on if only the question was lost; then it is asked again.
                if not self._may_ask_again(error) or time.monotonic() + RETRY_SECONDS >= end:
                    raise
                time.sleep(RETRY_SECONDS)
                continue
            if reply.state in DONE:
                return result_of(reply)
            if time.monotonic() >= end:
                raise CallFailed("timeout", f"the job has no result after {timeout:g} s; it goes on")

    def _may_ask_again(self, error: SwitchboardError) -> bool:
        begun = self._begun.done() and self._begun.exception() is None
        return begun and (
            isinstance(error, Unavailable) or (isinstance(error, CallFailed) and error.code == "lost")
        )

    def cancel(self) -> None:
        """End the job, or remove its result."""
        self._cloud.ask(CancelFunction(job=self.id()), CALL_SECONDS)


def result_of(reply: FunctionReply) -> Any:
    """The result in a reply.

    :raises CallFailed: there is none
    :raises Unavailable: no worker could be asked; it did not run
    """
    if reply.state == "refused" and reply.code == Unavailable.code:
        raise Unavailable(reply.error)
    if reply.value is None:
        raise CallFailed(reply.code or reply.state, reply.error or f"the call has ended as {reply.state}")
    return decode_value(reply.value)


def _check_seconds(name: str, seconds: float) -> None:
    if not 0 < seconds <= MAX_DEADLINE:
        raise Invalid(f"'{name}' must be more than 0 and at most {MAX_DEADLINE:g} s, not {seconds:g}")


def _encode(arguments: dict[str, Any]) -> bytes:
    body = encode_value(arguments)
    if len(body) > FUNCTION_BYTES:
        words = f"the arguments have {len(body)} bytes; at most {FUNCTION_BYTES} are taken"
        raise CallFailed("too_large", words)
    return body


def _wait(future: Future[FunctionReply], seconds: float, function: str) -> FunctionReply:
    try:
        return future.result(max(0.0, seconds))
    except FutureTimeout:
        words = (
            f"no answer of function {function} in time" if function else "the relay has not answered in time"
        )
        raise CallFailed("timeout", f"{words}; it may have run") from None


cloud = Cloud()
"""The workers of the relay of this robot."""
