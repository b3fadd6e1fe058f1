"""The relay's side of the process that reads Roles and answers queries."""

from __future__ import annotations

import itertools
import os
import sys
from typing import Any

import msgspec
from twisted.internet.defer import Deferred
from twisted.internet.error import ProcessExitedAlready
from twisted.internet.protocol import ProcessProtocol
from twisted.logger import Logger

from relay_protocol.errors import Invalid, Unavailable
from relay_server.common.clock import Timer, cancel
from relay_server.roles.documents import InvalidRole
from relay_server.roles.worker import HEAD, SECONDS, WorkerRequest, WorkerResult

MAX_PENDING = 32
"""Most requests without a result."""

CHILDREN = 2
"""Documents and queries that are worked on at the same time."""

GRACE_SECONDS = 10.0
"""A process that takes so much longer than the limit of its requests is killed and begun again."""

_FORKED = frozenset({"load", "query", "all_roles_of"})


class RoleProcess:
    """Sends requests to the process, which is begun with the first of them, and again after its death.

    :param reactor: Twisted's
    :ivar generation: grows with each start of the process, whose graphs are empty then
    """

    log = Logger()

    def __init__(self, reactor: Any) -> None:
        self.generation = 0
        self._reactor = reactor
        self._protocol: _WorkerProtocol | None = None
        self._numbers = itertools.count(1)
        self._pending: dict[int, tuple[Deferred[Any], Timer | None]] = {}
        self._waiting: list[WorkerRequest] = []
        self._children: set[int] = set()
        self._closed = False

    async def ask(self, do: str, *, seconds: float = SECONDS, **fields: Any) -> Any:
        """The result of a request; see :class:`relay_server.roles.worker.WorkerRequest`.

        :raises Invalid: it can't be carried out; the text says why
        :raises Unavailable: too many requests wait, or the process has died
        """
        if self._closed:
            raise Unavailable("the relay is shutting down; try again later")
        if len(self._pending) >= MAX_PENDING and do in _FORKED:
            raise Unavailable(
                "too many documents of Roles and queries are in progress; try again in a moment"
            )
        request = WorkerRequest(next(self._numbers), do, seconds=seconds, **fields)
        result: Deferred[Any] = Deferred()
        self._pending[request.id] = (result, None)
        if do in _FORKED and len(self._children) >= CHILDREN:
            self._waiting.append(request)
        else:
            self._send(request)
        return await result

    def start_process(self) -> None:
        """Begin the process, if it does not run."""
        if self._protocol is not None:
            return
        self.generation += 1
        self._protocol = _WorkerProtocol(self._received, self._ended)
        arguments = [sys.executable, "-m", "relay_server.roles.worker"]
        self._reactor.spawnProcess(
            self._protocol, sys.executable, arguments, os.environ, childFDs={0: "w", 1: "r", 2: 2}
        )

    def close(self) -> Deferred[None]:
        """End the process; fires when it has ended."""
        self._closed = True
        return self._protocol.close() if self._protocol is not None else _fired()

    def _send(self, request: WorkerRequest) -> None:
        self.start_process()
        assert self._protocol is not None
        if request.do in _FORKED:
            self._children.add(request.id)
        timer = self._reactor.callLater(request.seconds + GRACE_SECONDS, self._late)
        self._pending[request.id] = (self._pending[request.id][0], timer)
        body = msgspec.msgpack.encode(request)
        self._protocol.send(HEAD.pack(len(body)) + body)

    def _late(self) -> None:
        self.log.error("the process of Roles does not answer; it is begun again")
        if self._protocol is not None:
            self._protocol.kill()

    def _received(self, result: WorkerResult) -> None:
        self._children.discard(result.id)
        waiting, timer = self._pending.pop(result.id, (None, None))
        cancel(timer)
        while self._waiting and len(self._children) < CHILDREN:
            self._send(self._waiting.pop(0))
        if waiting is None or waiting.called:
            return
        if result.problems:
            waiting.errback(InvalidRole(result.problems))
        elif result.error:
            waiting.errback(Invalid(result.error))
        else:
            waiting.callback(result.value)

    def _ended(self) -> None:
        self._protocol = None
        pending, self._pending, self._waiting = self._pending, {}, []
        self._children.clear()
        for waiting, timer in pending.values():
            cancel(timer)
            if not waiting.called:
                waiting.errback(Unavailable("the process of Roles has ended; try again"))


def _fired() -> Deferred[None]:
    done: Deferred[None] = Deferred()
    done.callback(None)
    return done


class _WorkerProtocol(ProcessProtocol):
    def __init__(self, on_result: Any, on_end: Any) -> None:
        self._on_result, self._on_end = on_result, on_end
        self._received = b""
        self._decoder = msgspec.msgpack.Decoder(WorkerResult)
        self._done: Deferred[None] = Deferred()

    def outReceived(self, data: bytes) -> None:
        self._received += data
        while len(self._received) >= HEAD.size:
            (length,) = HEAD.unpack_from(self._received)
            end = HEAD.size + length
            if len(self._received) < end:
                return
            body, self._received = self._received[HEAD.size : end], self._received[end:]
            self._on_result(self._decoder.decode(body))

    def processEnded(self, reason: Any) -> None:
        self._on_end()
        self._done.callback(None)

    def send(self, data: bytes) -> None:
        """Write to the process."""
        transport: Any = self.transport
        transport.write(data)

    def kill(self) -> None:
        """Kill the process."""
        transport: Any = self.transport
        try:
            transport.signalProcess("KILL")
        except ProcessExitedAlready:
            return

    def close(self) -> Deferred[None]:
        """End the process; fires when it has ended."""
        self.kill()
        return self._done
