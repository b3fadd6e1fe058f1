"""A frozen PostgreSQL server: each request is answered in time with a reason, and everything continues
afterwards.
"""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pgserver
import psutil
import psycopg
import pytest
from websockets.exceptions import InvalidStatus

from tests.worlds.processes import running
from tests.worlds.relay_process import Relay
from tests.worlds.waiting import PATIENCE, freeze, wait_for

ANSWER_SECONDS = 2
REQUESTS = {
    "a new event": ("POST", "/api/v1/events", {"kind": "test.frozen"}),
    "events": ("GET", "/api/v1/events", None),
    "robots": ("GET", "/api/v1/robots", None),
    "a robot": ("GET", "/api/v1/robots/rover", None),
    "the directory": ("GET", "/api/v1/directory", None),
    "a new entry": ("POST", "/api/v1/directory", {"kind": "service", "name": "x", "address": "tcp://x:1"}),
    "the realm": ("GET", "/api/v1/realm/users", None),
    "a new user": ("POST", "/api/v1/realm/users", {"name": "newcomer"}),
    "rules of alerts": ("GET", "/api/v1/alerts/rules", None),
    "a token": ("POST", "/oauth/token", None),
    "health": ("GET", "/healthz", None),
    "who controls": ("GET", "/api/v1/robots/rover/control", None),
    "recordings": ("GET", "/api/v1/robots/rover/recordings", None),
    "a topic": ("GET", "/api/v1/robots/rover/topics/odom", None),
    "a camera": ("GET", "/robots/rover/video/snapshot?topic=/camera/image_raw", None),
}


class Frozen:
    """A relay on a PostgreSQL server that can be frozen and continued."""

    def __init__(self, folder: Path) -> None:
        # Outside pytest's folder, which other users cannot enter: under root the server runs as another
        # user.
        self._folder = Path(tempfile.mkdtemp(prefix="pg-of-frozen-"))
        self._server = pgserver.get_server(self._folder / "data", cleanup_mode="stop")
        with psycopg.connect(self._server.get_uri(), autocommit=True) as connection:
            connection.execute('CREATE DATABASE "relay"')
        url = self._server.get_uri().replace("/postgres?", "/relay?")
        self.relay = Relay(folder, "--answer-seconds", str(ANSWER_SECONDS), database=url)
        self.token = self.relay.user("root", admin=True)

    def ask(self, method: str, path: str, body: Any) -> httpx.Response:
        """A request on a new connection."""
        headers = {"Authorization": f"Bearer {self.token}"}
        data = {"grant_type": "password", "username": "root", "password": "wrong horse"}
        sent = {"data": data} if path == "/oauth/token" else {"json": body} if body else {}
        url = f"http://127.0.0.1:{self.relay.http_port}{path}"
        return httpx.request(method, url, headers=headers, timeout=PATIENCE, **sent)

    @contextmanager
    def standing_still(self) -> Iterator[None]:
        """All processes of the server are stopped."""
        postmaster = psutil.Process(int((self._folder / "data" / "postmaster.pid").read_text().split()[0]))
        stopped = [postmaster, *postmaster.children(recursive=True)]
        for each in stopped:
            freeze(each.pid)
        try:
            yield
        finally:
            for each in stopped:
                os.kill(each.pid, signal.SIGCONT)

    def end(self) -> None:
        self._server.cleanup()
        shutil.rmtree(self._folder, ignore_errors=True)


@pytest.fixture(scope="module")
def frozen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Frozen]:
    """One for all tests."""
    made = Frozen(tmp_path_factory.mktemp("frozen"))
    try:
        with running(made.relay):
            yield made
    finally:
        made.end()


def test_requests_are_answered_while_the_database_is_frozen(frozen: Frozen) -> None:
    """Afterwards each request is served at once, despite hundreds meanwhile; no event is stored twice."""
    with frozen.standing_still(), ThreadPoolExecutor(64) as pool:
        asked = {what: pool.submit(frozen.ask, *request) for what, request in REQUESTS.items()}
        flood = [pool.submit(frozen.ask, *REQUESTS["robots"]) for _ in range(300)]
        with pytest.raises(InvalidStatus) as refused:
            frozen.relay.connect("rover", frozen.token)
        answers = {what: each.result() for what, each in asked.items()}
        flooded = {each.result().status_code for each in flood}
    for what, answer in answers.items():
        # The relay may answer from its caches.
        assert answer.status_code in (200, 404, 503), (what, answer.text)
        if answer.status_code == 503:
            assert answer.headers["content-type"] == "application/problem+json"
            assert answer.json()["detail"]
    assert answers["a new event"].status_code == 503
    assert answers["health"].status_code == 503
    assert refused.value.response.status_code == 503
    assert flooded <= {200, 503}
    wait_for("the database answers", lambda: frozen.ask("GET", "/healthz", None).status_code == 200)
    assert frozen.ask(*REQUESTS["a new event"]).status_code == 201
    for what in ("events", "robots", "the directory", "the realm"):
        assert frozen.ask(*REQUESTS[what]).status_code == 200, what
    assert "Traceback" not in frozen.relay.log


def test_a_wait_that_is_asked_for_is_no_part_of_the_limit(frozen: Frozen) -> None:
    """Streams outlive it."""
    url = f"http://127.0.0.1:{frozen.relay.http_port}/api/v1/robots/stream"
    headers = {"Authorization": f"Bearer {frozen.token}"}
    with httpx.stream("GET", url, headers=headers, timeout=PATIENCE) as answer:
        assert answer.status_code == 200
        events = answer.iter_text()
        begun = time.monotonic()
        while time.monotonic() < begun + 2 * ANSWER_SECONDS:
            assert next(events)
