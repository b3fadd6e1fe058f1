"""The time of a refusal discloses nothing of other realms or of resources without a right.

Times themselves say little on a busy machine. They depend on the number of database queries: a relay with all
kinds of resources is asked over a real socket for existing and for missing ones, and its queries are counted.
"""

from __future__ import annotations

import http.client
from collections import Counter
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from sqlalchemy import event
from twisted.internet import reactor
from twisted.internet.task import deferLater
from twisted.internet.threads import deferToThread

from relay_db import queries
from relay_db.queries import NewEntry
from relay_server.alerts import types as kinds
from relay_server.auth import passwords
from relay_server.common.freshness_tokens import HEADER
from relay_server.config import ListenAddress, RelaySettings
from relay_server.events.collector import EventCollector
from relay_server.http.openapi.document import document
from relay_server.http.openapi.http import operations
from relay_server.recordings.library import FOLDER, RecordingEntry, RecordingState, text_of
from relay_server.relay import Relay
from tests.worlds.empty_database import write_empty_database
from tests.worlds.http_requests import ROBOT_BODIES, Answer, ask

NOBODYS = "nobody"
UNKNOWN = {"root@lab1": ("secret",), "toad@lab1": ("secret", "hidden")}
"""Robots of which somebody may not know: those of another realm, and those of his own that he has no right on."""

HEX = "0123456789abcdef"
IDS = {"secret": HEX * 2, "hidden": HEX[::-1] * 2, NOBODYS: "0" * 32}
"""Of directory entries and recordings, by the robot they are about."""

UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
}

Asked = Counter[str]
"""Questions that were put to the database: named queries, and statements of SQL."""


class Lab:
    """A relay that counts its database queries, without any other activity.

    There are realms lab1 and lab2. In the first ``root`` administers, ``toad`` operates ``mobile`` and has no
    right on ``hidden``; in the second there is ``secret``. ``secret`` and ``hidden`` each have an entry in
    the service registry, a recording, and an open alert.
    """

    def __init__(self, folder: Path) -> None:
        nowhere = ListenAddress("127.0.0.1", 0)
        self._folder = folder
        write_empty_database(folder / "relay.db")
        self.relay = Relay(
            reactor,
            RelaySettings(
                folder, f"sqlite:///{folder}/relay.db", nowhere, nowhere, refresh=3600.0, requests=0.0
            ),
        )
        self.alerts = {NOBODYS: "0" * 16}
        self.moment = ""
        self._asked: list[str] = []
        self._under_way = 0

    async def opens(self, monkeypatch: pytest.MonkeyPatch) -> Lab:
        """Fills the database, and starts counting."""
        services = self.relay.services
        core, store = services.core, services.core.database
        robots = self._filled()
        for name in ("read", "write"):
            monkeypatch.setattr(store, name, self._counting(getattr(store, name)))
        # With many events of one user the log would drop some.
        monkeypatch.setattr(EventCollector, "_within_rate", lambda *_: True)
        await self.relay.start()
        for name in ("secret", "hidden"):
            robot = core.robots.robot(robots[name].id, name, robots[name].realm)
            services.alerts.hub.raise_alert(robot, kinds.STOP, "", "error", "stopped")
        self.alerts |= {each.robot: each.id for each in services.alerts.hub.store}
        await services.alerts.hub.flush()
        # Periodic queries of the relay itself do not count here.
        alerts, quota, leases = services.alerts.hub, services.events._quota, services.service_registry.leases
        purges = services.functions._purging, services.files._loop
        for each in (services.polling, services.purge, alerts._loop, quota._loop, leases.loop, *purges):
            each.stop()
        # Tokens stay cached, however slow the machine is.
        core.access.set_known_until(float("inf"))
        event.listen(store.database._engine, "before_cursor_execute", self._statement)
        own = await self._sent(ask, "toad@lab1", "GET", "/api/v1/robots/mobile/control")
        self.moment = own.headers[HEADER]
        return self

    def _filled(self) -> dict[str, queries.RobotRecord]:
        with self.relay.services.core.database.database.begin() as session:
            for realm in ("lab1", "lab2"):
                queries.add_realm(session, realm)
            users = {
                name: queries.add_user(session, name, None, admin=name == "root", realm=realm)
                for name, realm in (("root", "lab1"), ("toad", "lab1"), ("mole", "lab2"))
            }
            for user in users.values():
                hash = passwords.token_hash(user.full)
                queries.create_token(session, user.id, hash, kind="access", expires=None, now=1.0)
            places = {"mobile": "lab1", "hidden": "lab1", "secret": "lab2"}
            robots = {name: queries.add_robot(session, name, realm=realm) for name, realm in places.items()}
            queries.grant_right(session, robots["mobile"].id, "operator", user_id=users["toad"].id)
            (self._folder / FOLDER).mkdir()
            for name, user in (("secret", users["mole"]), ("hidden", users["root"])):
                robot, id = robots[name], IDS[name]
                new = NewEntry(user.realm, "service", name, "http://a/", "", robot.id, user.id, "{}", 86400.0)
                queries.register_entry(session, new, id, 4e9, of_user=10, of_realm=10)
                entry = RecordingEntry(id, robot.id, name, user.id, user.name, ("/mode",), (), 1.0, 1, 1.0)
                entry.realm, entry.state = user.realm, RecordingState.COMPLETE
                (self._folder / FOLDER / f"{id}.json").write_bytes(text_of(entry))
                (self._folder / FOLDER / f"{id}.mcap").write_bytes(b"")
        return robots

    def _counting(self, do: Callable[..., Any]) -> Callable[..., Any]:
        async def counted(query: Callable[..., Any], *args: Any, **named: Any) -> Any:
            self._asked.append(f"{do.__name__} {query.__qualname__}")
            self._under_way += 1
            try:
                return await do(query, *args, **named)
            finally:
                self._under_way -= 1

        return counted

    def _statement(self, connection: Any, cursor: Any, statement: str, *more: Any) -> None:
        self._asked.append(statement)

    async def _sent(self, sender: Callable[..., Answer], who: str, *args: Any, **named: Any) -> Answer:
        answer: Answer = await deferToThread(sender, self.relay.http_port, *args, token=who, **named)
        # No request waits for its events and audit entries, nor for the first look-up of a stream.
        while self._under_way or self.relay.services.events._writer.waiting:
            await self._turn()
        return answer

    async def _turn(self) -> None:
        await deferLater(reactor, 0.001)  # type: ignore[arg-type]  # to mypy it is a module

    async def asks(
        self, sender: Callable[..., Answer], fresh: bool, who: str, *args: Any, **named: Any
    ) -> tuple[Answer, Asked]:
        """Sends a user's request; returns the answer and its database queries.

        :param fresh: drop all caches first
        """
        if fresh:
            await self.relay.services.core.access.refresh()
        self._asked.clear()
        answer = await self._sent(sender, who, *args, **named)
        asked = Counter(self._asked)
        if isinstance(answer, Begun):
            answer.ends()
        # A stream continues until the relay sees that its reader has left.
        writer = self.relay.services.events._writer
        while (
            self._under_way
            or writer.waiting
            or self.relay.services.listeners._ports[0].factory.connection_limits._counts
        ):
            await self._turn()
        return answer, asked

    async def same(
        self, who: str, *requests: Callable[[str], tuple[Any, ...]], sender: Callable[..., Answer] = ask
    ) -> None:
        """Checks that hidden and missing resources cause the same queries.

        :param requests: each makes a method, an address, a body and headers of the name of a robot
        """
        for made in requests:
            nobodys = made(NOBODYS)
            # Warm up caches.
            await self.asks(sender, False, who, *nobodys[:3], headers=nobodys[3])
            for fresh in (True, False):
                answer, asked = await self.asks(sender, fresh, who, *nobodys[:3], headers=nobodys[3])
                for name in UNKNOWN[who]:
                    method, path, body, headers = made(name)
                    other = await self.asks(sender, fresh, who, method, path, body, headers=headers)
                    where = f"{who} {method} {path}"
                    assert other[0].status == answer.status != 500, where
                    assert other[1] == asked, where


@pytest_twisted.async_yield_fixture
async def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Lab]:
    """A relay for one test."""
    made = Lab(tmp_path)
    await made.opens(monkeypatch)
    yield made
    await made.relay.stop()


class Begun(Answer):
    """The first line of a streamed answer."""

    def __init__(self, connection: http.client.HTTPConnection) -> None:
        self._connection = connection
        self._response = connection.getresponse()
        self.status = self._response.status
        self.headers = self._response.headers
        self.body = self._response.readline()

    def ends(self) -> None:
        """Disconnects."""
        self._response.close()
        self._connection.close()


def stream(port: int, method: str, path: str, body: Any, *, headers: dict[str, str], token: str) -> Begun:
    """As :func:`http_requests.ask`, for endless answers; :meth:`Begun.ends` must follow."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    connection.request(method, path, headers={**headers, "Authorization": f"Bearer {token}"})
    return Begun(connection)


def of_a_robot() -> list[tuple[str, str]]:
    """All operations of the HTTP API on a robot, from its OpenAPI document."""
    paths = document(operations(), "1", "session")["paths"]
    return [(method, path) for path in paths if "{robot}" in path for method in paths[path]]


@pytest.mark.parametrize("who", UNKNOWN)
@pytest_twisted.ensureDeferred
async def test_robots_that_one_may_not_know_of_ask_as_much_as_those_there_are_not(lab: Lab, who: str) -> None:
    """For every operation: robots of another realm, and those of the own one without a right."""

    def request(method: str, path: str) -> Callable[[str], tuple[Any, ...]]:
        query = "?topic=/camera" if path.startswith("/robots/") else ""
        body = None if method == "get" else ROBOT_BODIES.get(path.partition("{robot}/")[2], {})

        def made(robot: str) -> tuple[Any, ...]:
            at = path.replace("{robot}", robot).replace("{name}", "mode").replace("{id}", IDS[robot])
            return method.upper(), at + query, body, {HEADER: lab.moment}

        return made

    await lab.same(who, *(request(*each) for each in of_a_robot()))
    # For a permitted robot there are more queries, so a difference would be visible.
    known = await lab.asks(ask, True, "toad@lab1", "POST", "/api/v1/robots/mobile/stop", {})
    unknown = await lab.asks(ask, True, "toad@lab1", "POST", "/api/v1/robots/hidden/stop", {})
    assert known[0].status < 300 and unknown[0].status == 404
    assert known[1] != unknown[1]


@pytest.mark.parametrize("who", UNKNOWN)
@pytest_twisted.ensureDeferred
async def test_so_do_websockets(lab: Lab, who: str) -> None:
    """Those of a robot and of a camera."""
    await lab.same(
        who,
        lambda robot: ("GET", f"/robots/{robot}", None, UPGRADE),
        lambda robot: ("GET", f"/robots/{robot}/video/ws?topic=/camera", None, UPGRADE),
    )


@pytest.mark.parametrize("who", UNKNOWN)
@pytest_twisted.ensureDeferred
async def test_so_does_what_is_about_them(lab: Lab, who: str) -> None:
    """Entries of the service registry, recordings and alerts by their ids, and all parameters that name a
    robot.
    """
    recording = "/api/v1/robots/mobile/recordings"
    order = {"do": "call", "service": "/where"}
    entry = {"kind": "service", "name": "x", "address": "http://a/"}
    await lab.same(
        who,
        *(
            lambda robot, method=method: (method, f"/api/v1/directory/{IDS[robot]}", None, {})
            for method in ("GET", "PUT", "DELETE")
        ),
        lambda robot: ("GET", f"/api/v1/directory/robot:{robot}", None, {}),
        lambda robot: ("GET", f"{recording}/{IDS[robot]}", None, {}),
        lambda robot: ("GET", f"{recording}/{IDS[robot]}/file", None, {}),
        lambda robot: ("POST", f"{recording}/{IDS[robot]}/stop", {}, {}),
        lambda robot: ("DELETE", f"{recording}/{IDS[robot]}", None, {}),
        lambda robot: ("POST", f"/api/v1/alerts/{lab.alerts[robot]}/acknowledge", {}, {}),
        lambda robot: ("GET", f"/api/v1/alerts?robot={robot}", None, {}),
        lambda robot: ("GET", f"/api/v1/events?robot={robot}", None, {}),
        lambda robot: ("GET", f"/api/v1/events?robot={robot}&count=true", None, {}),
        lambda robot: ("GET", f"/api/v1/events?robot={robot}", None, {"Accept": "text/csv"}),
        lambda robot: ("GET", f"/api/v1/directory?robot={robot}", None, {}),
        lambda robot: ("POST", "/api/v1/events", {"kind": "x", "robot": robot}, {}),
        lambda robot: ("POST", "/api/v1/directory", {**entry, "robot": robot}, {}),
        lambda robot: ("POST", "/api/v1/tickets", {"robot": robot}, {}),
        lambda robot: ("POST", "/api/v1/fleet", {**order, "robots": [robot]}, {}),
    )


@pytest.mark.parametrize("who", UNKNOWN)
@pytest_twisted.ensureDeferred
async def test_so_do_streams(lab: Lab, who: str) -> None:
    """Of events, of the service registry, of a topic."""
    events = {"Accept": "text/event-stream"}
    await lab.same(
        who,
        lambda robot: ("GET", f"/api/v1/events?robot={robot}", None, events),
        lambda robot: ("GET", f"/api/v1/directory?robot={robot}", None, events),
        lambda robot: ("GET", f"/api/v1/robots/{robot}/topics/mode", None, events),
        sender=stream,
    )
