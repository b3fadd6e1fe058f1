"""All kinds of streams count against one limit per user."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.video_clients import known, path
from tests.worlds.waiting import PATIENCE, wait_for

STREAMS = {
    "robots": ("/api/v1/robots/stream", "text/event-stream"),
    "events": ("/api/v1/events", "text/event-stream"),
    "directory": ("/api/v1/directory", "text/event-stream"),
    "topic": ("/api/v1/robots/rover/topics/odom", "text/event-stream"),
    "pictures": (path("stream"), "*/*"),
}
WEBSOCKETS = {"pages": "/api/v1/robots/stream", "camera": path("ws")}


class World:
    """A relay that allows one stream per user."""

    def __init__(self, folder: Any) -> None:
        self.relay = Relay(folder, "--streams-per-user", "1")
        self.robot = Robot(self.relay, "rover", camera=True)
        self.token = self.relay.user("viewer")
        self.relay.cli("right", "grant", "viewer", "rover", "viewer")
        self.robot.wait_online()
        known(self.relay, self.token)

    @contextmanager
    def opened(self, address: str, accept: str) -> Iterator[httpx.Response]:
        """An open stream, which the relay has ended on leaving the block."""
        headers = {"Authorization": f"Bearer {self.token}", "Accept": accept}
        url = f"http://127.0.0.1:{self.relay.http_port}{address}"
        with httpx.stream("GET", url, headers=headers, timeout=PATIENCE) as answer:
            yield answer

    def status(self, address: str, accept: str) -> int:
        """The status of a further stream."""
        with self.opened(address, accept) as answer:
            if answer.status_code != 200:
                assert "close one of them first" in answer.read().decode()
            return answer.status_code

    def handshake(self, address: str) -> str:
        """The result of a further websocket handshake."""
        try:
            headers = {"Authorization": f"Bearer {self.token}"}
            with connect(
                f"ws://127.0.0.1:{self.relay.http_port}{address}", additional_headers=headers
            ) as websocket:
                websocket.recv(PATIENCE)
        except InvalidStatus as error:
            return str(error.response.status_code)
        except ConnectionClosed as error:
            return str(error)
        return "open"

    def stop(self) -> None:
        self.robot.stop()
        self.relay.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """One for all tests."""
    made = World(tmp_path_factory.mktemp("streams"))
    try:
        yield made
    finally:
        made.stop()


@pytest.mark.parametrize("kind", [*STREAMS, *WEBSOCKETS])
def test_a_stream_of_each_kind_counts(world: World, kind: str) -> None:
    """It is refused with 429 while another one is open, and opens when that one has ended."""
    if kind in STREAMS:
        address, accept = STREAMS[kind]

        def tried() -> Any:
            return world.status(address, accept)

        refused, opened = 429, 200
    else:

        def tried() -> Any:
            return world.handshake(WEBSOCKETS[kind])

        refused, opened = "429", "open"
    other = STREAMS["events" if kind == "robots" else "robots"]
    # A stream ends shortly after its client has left.
    wait_for("it opens", lambda: tried() == opened)
    with first_opened(world, *other):
        assert tried() == refused
    wait_for("it opens again", lambda: tried() == opened)


@contextmanager
def first_opened(world: World, address: str, accept: str) -> Iterator[None]:
    """The only open stream."""
    with ExitStack() as stack:

        def opens() -> bool:
            answer = stack.enter_context(world.opened(address, accept))
            return answer.status_code == 200

        wait_for("the stream before has ended", opens)
        yield
