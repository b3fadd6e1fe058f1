"""The local socket: stops by the command line, on transports in memory."""

from __future__ import annotations

import json
from typing import Any, cast

import pytest
from twisted.internet.task import Clock
from twisted.web.server import Site

from relay_protocol.errors import Unavailable
from relay_server.cluster.admin import ClusterAdmin
from relay_server.common.data_dir import SENT_HEADER
from relay_server.control.gateway import StopAllResult
from relay_server.http.admin_socket import AdminSocket
from relay_server.modules.service import ModuleService
from relay_server.pipes.service import PipeService
from relay_server.roles.local import LocalRoles
from tests.worlds.http_client import Answer, Transport, parse


class Stopping:
    """Records calls.

    :ivar halted: the result to return
    """

    def __init__(self) -> None:
        self.asked: list[tuple[Any, ...]] = []
        self.halted: StopAllResult | Unavailable = StopAllResult([{"robot": "rover", "done": True}])

    async def stop_locally(self, robot: str | None, why: str, by: str, stop_id: str) -> StopAllResult:
        """Records the call."""
        self.asked.append((robot, why, by, *filter(None, [stop_id])))
        if isinstance(self.halted, Unavailable):
            raise self.halted
        return self.halted

    async def resume_locally(self, robot: str, why: str, by: str, earliest_sent: int) -> None:
        """Records the call."""
        self.asked.append((robot, why, by, earliest_sent))


async def nothing(*_: object) -> None:
    """Not called in these tests."""


@pytest.fixture
def stopping() -> Stopping:
    """The fake control service."""
    return Stopping()


def post(stopping: Stopping, path: str, body: bytes, sent: str = "") -> Answer:
    """Sends a request on a new connection."""
    admin = AdminSocket(
        dict,
        nothing,
        nothing,
        stopping,
        cast(ModuleService, None),
        cast(PipeService, None),
        cast(LocalRoles, None),
        cluster=ClusterAdmin(None),
    )
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
    """Unusable reasons are left out."""
    answer = post(stopping, "/stop", b'{"by": "root", "why": ' + why + b"}")
    assert (answer.status, answer.json["robots"]) == (200, [{"robot": "rover", "done": True}])
    assert stopping.asked == [(None, kept, "root")]


def test_robots_that_could_not_be_looked_up_are_reported(stopping: Stopping) -> None:
    """The stopped robots are listed too. If there are none, the order has failed."""
    stopping.halted = StopAllResult([{"robot": "rover", "done": True}], "the database does not answer")
    order = json.dumps({"by": "root"}).encode()
    assert post(stopping, "/stop", order).json["missed"] == "the database does not answer"
    stopping.halted = Unavailable("the database does not answer")
    answer = post(stopping, "/stop", order)
    assert (answer.status, answer.json["detail"]) == (503, "the database does not answer")


def test_single_robot_is_resumed(stopping: Stopping) -> None:
    """The order has its reason and its age; without a time it is older than any stop."""
    order = b'{"by": "root", "robot": "rover", "why": "clear"}'
    for sent in ("1234", "", "-5", "1e3", "9" * 50, "²"):
        assert post(stopping, "/resume", order, sent).status == 200
    assert stopping.asked == [("rover", "clear", "root", sent) for sent in (1234, 0, 0, 0, 0, 0)]
