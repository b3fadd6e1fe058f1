"""The local socket: what the command line asks about stops, on transports in memory."""

from __future__ import annotations

import json
from typing import Any

import pytest
from twisted.internet.task import Clock
from twisted.web.server import Site

from relay_protocol.errors import Unavailable
from relay_server.control.service import StopAllResult
from relay_server.fleet.http import SENT_HEADER
from relay_server.http.admin_socket import AdminSocket
from tests.relay_server.edges.http_client import Answer, Transport, parse


class Stopping:
    """Keeps what it is asked.

    :ivar halted: what becomes of it
    """

    def __init__(self) -> None:
        self.asked: list[tuple[Any, ...]] = []
        self.halted: StopAllResult | Unavailable = StopAllResult([{"robot": "rover", "done": True}])

    async def stop_here(self, robot: str | None, why: str, by: str) -> StopAllResult:
        """Keep it."""
        self.asked.append((robot, why, by))
        if isinstance(self.halted, Unavailable):
            raise self.halted
        return self.halted

    async def resume_here(self, robot: str, why: str, by: str, sent: int) -> None:
        """Keep it."""
        self.asked.append((robot, why, by, sent))


async def nothing(*_: object) -> None:
    """Nobody asks for this here."""


@pytest.fixture
def stopping() -> Stopping:
    """Who stops robots."""
    return Stopping()


def post(stopping: Stopping, path: str, body: bytes, sent: str = "") -> Answer:
    """One request on a connection of its own."""
    admin = AdminSocket(dict, nothing, nothing, stopping)
    site = Site(admin.app.resource(), reactor=Clock())
    transport = Transport()
    transport.protocol = site.buildProtocol(None)
    transport.protocol.makeConnection(transport)
    head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nContent-Length: {len(body)}\r\n"
    head += f"{SENT_HEADER}: {sent}\r\n\r\n" if sent else "\r\n"
    transport.protocol.dataReceived(head.encode() + body)
    return parse(transport.value())


@pytest.mark.parametrize(
    ("why", "kept"),
    [(b'"smoke"', "smoke"), (b"null", ""), (b"7", ""), (b"[1e999]", ""), (b'"%s"' % (b"x" * 600), "x" * 500)],
)
def test_no_stop_is_refused_for_its_reason(stopping: Stopping, why: bytes, kept: str) -> None:
    """What can't be used of it is left out."""
    answer = post(stopping, "/stop", b'{"by": "root", "why": ' + why + b"}")
    assert (answer.status, answer.json["robots"]) == (200, [{"robot": "rover", "done": True}])
    assert stopping.asked == [(None, kept, "root")]


def test_what_could_not_be_looked_up_is_told(stopping: Stopping) -> None:
    """With what was stopped all the same; where that is nothing, the order has failed."""
    stopping.halted = StopAllResult([{"robot": "rover", "done": True}], "the database does not answer")
    order = json.dumps({"by": "root"}).encode()
    assert post(stopping, "/stop", order).json["missed"] == "the database does not answer"
    stopping.halted = Unavailable("the database does not answer")
    answer = post(stopping, "/stop", order)
    assert (answer.status, answer.json["detail"]) == (503, "the database does not answer")


def test_one_robot_is_resumed(stopping: Stopping) -> None:
    """With the reason, and as old as it is; where nobody says how old that is, older than anything."""
    order = b'{"by": "root", "robot": "rover", "why": "clear"}'
    for sent in ("1234", "", "-5", "1e3", "9" * 50, "²"):
        assert post(stopping, "/resume", order, sent).status == 200
    assert stopping.asked == [("rover", "clear", "root", sent) for sent in (1234, 0, 0, 0, 0, 0)]
