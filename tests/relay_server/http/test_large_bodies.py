"""Large bodies of requests are counted before their senders are authenticated."""

from __future__ import annotations

import errno
import os
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from relay_protocol.errors import Unavailable
from relay_protocol.limits import FUNCTION_BODY
from relay_server.http.endpoint import ApiRequest
from relay_server.http.limits import LargeBodyLimits
from tests.worlds.http_client import World


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path)


def begin(world: World, credentials: str) -> bytes:
    """Send the head of a large request; returns what is answered to it."""
    transport = world.connect()
    head = f"POST /api/v1/functions/move HTTP/1.1\r\nHost: x\r\n{credentials}Content-Length: {FUNCTION_BODY}\r\n\r\n"
    world.send(transport, head.encode())
    return transport.value()


@pytest.mark.parametrize("known", ["Authorization: Bearer ann\r\n", "Cookie: sb=ann\r\n"])
@pytest.mark.parametrize("unknown", ["", "Authorization: Bearer guessed\r\n", "Authorization: \xff\r\n"])
def test_unknown_senders_leave_room_for_large_bodies_of_known_ones(
    world: World, known: str, unknown: str
) -> None:
    assert begin(world, unknown) == b""
    refused = begin(world, unknown)
    assert b" 503 " in refused
    assert b"send a small request with your token before" in refused
    assert begin(world, known) == b""
    assert begin(world, known) == b""


class BrokenFile(BytesIO):
    """A file on a disk that fails.

    :param fails: the method that fails
    :param number: of the error
    """

    def __init__(self, fails: str, number: int) -> None:
        super().__init__()
        self._fails = fails
        self._number = number

    def write(self, data: Any) -> int:
        self._fail("write")
        return super().write(data)

    def seek(self, *to: int) -> int:
        self._fail("seek")
        return super().seek(*to)

    def read(self, *size: Any) -> bytes:
        self._fail("read")
        return super().read(*size)

    def _fail(self, method: str) -> None:
        if self._fails == method:
            raise OSError(self._number, os.strerror(self._number))


@pytest.mark.parametrize("fails", ["open", "write", "seek"])
@pytest.mark.parametrize(
    ("number", "answers"),
    [
        (errno.ENOSPC, (b" 507 ", b"the relay's disk is full; its administrator must make room")),
        (errno.EIO, (b" 503 ", b"on its disk; see its log")),
    ],
)
def test_a_failing_disk_is_no_fault_of_the_request(
    world: World, monkeypatch: pytest.MonkeyPatch, fails: str, number: int, answers: tuple[bytes, bytes]
) -> None:
    """Twisted holds a large body in a temporary file."""

    def open_file() -> BytesIO:
        if fails == "open":
            raise OSError(number, os.strerror(number))
        return BrokenFile(fails, number)

    monkeypatch.setattr("tempfile.TemporaryFile", open_file)
    transport = world.connect()
    body = b'{"kwargs":{"x":"' + b"x" * 200_000 + b'"}}'
    head = b"POST /api/v1/functions/move HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer ann\r\n"
    head += b"Content-Type: application/json\r\nContent-Length: %d\r\n\r\n" % len(body)
    world.send(transport, head + body)
    assert all(each in transport.value() for each in answers)


def test_a_body_that_cannot_be_read_again_is_no_fault_of_the_request() -> None:
    http: Any = SimpleNamespace(content=BrokenFile("read", errno.EIO))
    request = ApiRequest(http, None)  # type: ignore[arg-type]
    with pytest.raises(Unavailable, match="can't read this request from its disk: Input/output error"):
        request.content()


def test_a_body_in_chunks_is_not_held_on_the_disk(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.TemporaryFile", lambda: pytest.fail("a file"))
    transport = world.connect()
    head = b"POST /api/v1/session HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n"
    world.send(transport, head + b"2\r\n{}\r\n0\r\n\r\n")
    assert b" 400 " in transport.value()  # it has no media type


def test_large_bodies_count_for_their_network() -> None:
    bodies = LargeBodyLimits()
    first = bodies.enter("2001:db8::1", FUNCTION_BODY, known=True)
    assert bodies.enter("2001:db8::2", FUNCTION_BODY, known=True)
    assert bodies.enter("2001:db8::3", FUNCTION_BODY, known=True) is None
    assert first is not None
    first()
    assert bodies.enter("2001:db8::3", FUNCTION_BODY, known=True)
