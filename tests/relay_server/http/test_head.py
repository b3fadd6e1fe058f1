"""HEAD of each endpoint that can stream: the head comes, the answer ends, and nothing of the stream is left."""

from __future__ import annotations

import http.client
from collections.abc import AsyncIterator
from pathlib import Path

import pytest_twisted
from twisted.internet import reactor
from twisted.internet.threads import deferToThread

from relay_db import queries
from relay_server.auth import passwords
from relay_server.config import ListenAddress, RelaySettings
from relay_server.http.endpoint import endpoints_of
from relay_server.http.media_types import EVENTS
from relay_server.http.openapi.http import ENDPOINTS
from relay_server.relay import Relay
from tests.worlds.empty_database import write_empty_database

STREAMS = sorted(
    each.options.path
    for group in ENDPOINTS
    for each in endpoints_of(group)
    if each.options.method == "GET" and EVENTS in each.options.forms
)
"""Addresses of which a GET can be a stream."""

TOKEN = "administrator"
ROLE = "Switch-Light-Lamp"
DOCUMENT = """
@prefix fierro: <fierro:> .
fierro:Switch-Light-Lamp a fierro:role ;
  fierro:subject fierro:Switch ; fierro:action fierro:Light ; fierro:directObject fierro:Lamp .
"""


@pytest_twisted.async_yield_fixture
async def relay(tmp_path: Path) -> AsyncIterator[Relay]:
    """A relay with an administrator, a robot and a Role, that allows one stream."""
    write_empty_database(tmp_path / "relay.db")
    nowhere = ListenAddress("127.0.0.1", 0)
    url = f"sqlite:///{tmp_path}/relay.db"
    made = Relay(reactor, RelaySettings(tmp_path, url, nowhere, nowhere, requests=0.0, streams=1))
    with made.services.core.database.database.begin() as session:
        user = queries.add_user(session, "root", None, admin=True)
        queries.create_token(
            session, user.id, passwords.token_hash(TOKEN), kind="access", expires=None, now=1.0
        )
        queries.add_robot(session, "rover")
    await made.start()
    yield made
    await made.stop()


def heads(port: int, paths: list[str]) -> dict[str, int]:
    """Statuses of HEAD, all on one connection: each answer ends before the next request."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    sent = {"Authorization": f"Bearer {TOKEN}", "Content-Type": "text/turtle"}
    connection.request("PUT", f"/api/v1/roles/{ROLE}", DOCUMENT, sent)
    assert b'"role"' in connection.getresponse().read()
    found = {}
    for path in paths:
        address = path.replace("{robot}", "rover").replace("{name:path}", "chatter").replace("{role}", ROLE)
        wanted = {"Authorization": f"Bearer {TOKEN}", "Accept": "text/event-stream"}
        connection.request("HEAD", address, headers=wanted)
        answer = connection.getresponse()
        assert answer.read() == b""
        found[path] = answer.status
    connection.close()
    return found


@pytest_twisted.ensureDeferred
async def test_head_of_a_stream_ends_and_leaves_nothing(relay: Relay) -> None:
    """Each twice, though only one stream is allowed at a time."""
    assert len(STREAMS) > 7
    found = await deferToThread(heads, relay.http_port, STREAMS * 2)
    missing = {each for each, status in found.items() if status == 404}
    assert missing == {"/api/v1/robots/{robot}/goals/{id}"}
    assert set(found.values()) == {200, 404}
    assert not relay.services.core.access._permits


@pytest_twisted.ensureDeferred
async def test_head_of_a_stream_of_a_robot_that_is_not_there_is_refused(relay: Relay) -> None:
    """As a GET is."""
    paths = ["/api/v1/robots/none/topics/chatter", "/api/v1/robots/none/modules"]
    assert set((await deferToThread(heads, relay.http_port, paths)).values()) == {404}
