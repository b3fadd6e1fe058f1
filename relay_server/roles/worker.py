"""The process that reads documents of Roles and answers queries: ``python -m relay_server.roles.worker``.

Oxigraph can't be interrupted, and hostile queries overflow its stack or take all memory. So each document and each
query of a client runs in a forked child with limits of time, memory and descriptors; its end disturbs nothing else.

Requests come on standard input, results go to standard output: u32 length, MessagePack.
"""

from __future__ import annotations

import gc
import os
import resource
import selectors
import signal
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from relay_protocol.errors import Invalid
from relay_server.roles.documents import InvalidRole, load
from relay_server.roles.sparql import MAX_LOOKED_AT, RoleGraphs

SECONDS = 5.0
"""A child is killed after this time."""

MEMORY = 512 * 1024 * 1024
"""Bytes that a child may have beyond what the process has."""

HEAD = struct.Struct(">I")


class WorkerRequest(msgspec.Struct):
    """
    :param do: ``load`` reads a document; ``put`` and ``drop`` change the graph; ``roles_of`` resolves,
        unless that takes long, and ``all_roles_of`` does so in a child;
        ``bindings``, ``elements`` and ``missing`` read one Role; ``resources_of`` reads all; ``query`` asks
    :param names: Roles that may be used; ``None`` for all
    :param text: an IRI, a query, or a document in N-Triples
    :param items: IRIs
    :param media: of a document, or of the results of SELECT
    :param graph_media: of the results of CONSTRUCT
    """

    id: int
    do: str
    realm: str = ""
    name: str = ""
    names: list[str] | None = None
    text: str = ""
    items: list[str] = []
    body: bytes = b""
    media: str = ""
    graph_media: str = ""
    seconds: float = SECONDS


class WorkerResult(msgspec.Struct):
    """
    :param error: why there is no result; empty if there is one
    :param problems: of a document that lacks something
    """

    id: int
    value: Any = None
    error: str = ""
    problems: list[str] = []


class _Child(NamedTuple):
    id: int
    pid: int
    pipe: int
    received: list[bytes]
    seconds: float


class Worker:
    """Carries out requests until its input ends."""

    def __init__(self, source: int, target: int) -> None:
        self._source, self._target = source, target
        self._graphs: dict[str, RoleGraphs] = {}
        self._selector = selectors.DefaultSelector()
        self._input = b""
        self._decoder = msgspec.msgpack.Decoder(WorkerRequest)

    def run(self) -> None:
        """Carry out requests."""
        self._selector.register(self._source, selectors.EVENT_READ, None)
        while True:
            for key, _ in self._selector.select():
                if key.data is not None:
                    self._read_child(key.data)
                elif not self._read_requests():
                    return

    def _read_requests(self) -> bool:
        data = os.read(self._source, 1 << 20)
        self._input += data
        while len(self._input) >= HEAD.size:
            (length,) = HEAD.unpack_from(self._input)
            if len(self._input) < HEAD.size + length:
                break
            body, self._input = self._input[HEAD.size : HEAD.size + length], self._input[HEAD.size + length :]
            self._begin(self._decoder.decode(body))
        return bool(data)

    def _begin(self, request: WorkerRequest) -> None:
        graphs = self._graphs.setdefault(request.realm, RoleGraphs()) if request.realm else RoleGraphs()
        if request.do == "all_roles_of":
            self._fork(request, lambda: graphs.roles_of(request.text, request.names))
        elif request.do == "load":
            self._fork(request, lambda: [each._asdict() for each in load(request.body, request.media)])
        elif request.do == "query":
            self._fork(
                request,
                lambda: graphs.query(request.text, request.names, request.media, request.graph_media),
            )
        elif request.do == "put":
            self._send(_carried_out(request.id, lambda: graphs.put(request.name, request.text)))
        elif request.do == "drop":
            self._send(_carried_out(request.id, lambda: graphs.drop(request.name)))
        elif request.do == "bindings":
            self._send(_carried_out(request.id, lambda: graphs.bindings(request.text, request.name)))
        elif request.do == "elements":
            self._send(_carried_out(request.id, lambda: graphs.elements(request.name)))
        elif request.do == "resources_of":
            self._send(_carried_out(request.id, lambda: graphs.resources_of(request.items, request.names)))
        elif request.do == "missing":
            self._send(_carried_out(request.id, lambda: graphs.missing(request.name)))
        else:
            self._send(
                _carried_out(request.id, lambda: graphs.roles_of(request.text, request.names, MAX_LOOKED_AT))
            )

    def _fork(self, request: WorkerRequest, work: Callable[[], Any]) -> None:
        reading, writing = os.pipe()
        pid = os.fork()
        if pid == 0:
            _run_child(request, writing, work)
        os.close(writing)
        child = _Child(request.id, pid, reading, [], request.seconds)
        self._selector.register(reading, selectors.EVENT_READ, child)

    def _read_child(self, child: _Child) -> None:
        data = os.read(child.pipe, 1 << 20)
        if data:
            child.received.append(data)
            return
        self._selector.unregister(child.pipe)
        os.close(child.pipe)
        status = os.waitstatus_to_exitcode(os.waitpid(child.pid, 0)[1])
        if status == 0:
            self._send(b"".join(child.received))
        else:
            self._send(_encoded(WorkerResult(child.id, error=_death(status, child.seconds))))

    def _send(self, body: bytes) -> None:
        body = HEAD.pack(len(body)) + body
        while body:
            body = body[os.write(self._target, body) :]


def _run_child(request: WorkerRequest, pipe: int, work: Callable[[], Any]) -> None:
    """Never returns."""
    try:
        _limit(request.seconds)
        if request.do == "query":
            # SERVICE would open a connection; there are no descriptors for it.
            resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))
        body = _carried_out(request.id, work)
        while body:
            body = body[os.write(pipe, body) :]
        os._exit(0)
    except BaseException:  # the process's own loop must not run twice
        os._exit(1)


def _limit(seconds: float) -> None:
    gc.freeze()
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _carried_out(number: int, work: Callable[[], Any]) -> bytes:
    try:
        return _encoded(WorkerResult(number, work()))
    except InvalidRole as error:
        return _encoded(WorkerResult(number, error=str(error), problems=error.problems))
    except Invalid as error:
        return _encoded(WorkerResult(number, error=str(error)))
    except (SyntaxError, ValueError, OSError, MemoryError) as error:
        return _encoded(WorkerResult(number, error=f"it was not carried out: {str(error)[:200]}"))


def _encoded(result: WorkerResult) -> bytes:
    return msgspec.msgpack.encode(result)


def _death(status: int, seconds: float) -> str:
    if status == -signal.SIGALRM:
        return f"it took longer than {seconds:g} s and was ended; ask for less"
    return "it was ended: it is nested too deeply, or needs too much memory"


def main() -> None:
    """Run until standard input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Worker(0, 1).run()


if __name__ == "__main__":
    main()
