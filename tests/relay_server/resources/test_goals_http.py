"""Goals over HTTP on transports in memory: streams, their rights, and ``Prefer``."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from twisted.web.test.requesthelper import DummyRequest

from relay_protocol.errors import NotFound
from relay_server.common.freshness_tokens import HEADER
from relay_server.http.idempotency import Idempotency
from relay_server.http.request_fields import APPLIED, wait_preferred
from relay_server.in_process_sessions.pool import RobotCaller
from relay_server.resources.goals import GoalOwner, GoalReply, HttpGoal
from relay_server.resources.goals_http import GoalEndpoints
from relay_server.resources.page import PageQuery
from tests.worlds.http_client import HOST, Transport, World, parse

HERE = "/api/v1/robots/rover/goals"
ANN = {"Authorization": "Bearer ann"}


class FakeResources:
    """Has one goal, which is ann's."""

    def __init__(self, clock: Any) -> None:
        self.cancelled = False
        client = SimpleNamespace(new_id=lambda: "1", closed=None, perform=self._cancel)
        robot = SimpleNamespace(name="rover")
        guest: Any = SimpleNamespace(port=client, client=SimpleNamespace(robot=robot))
        self.goal = HttpGoal(
            clock,
            lambda: 5.0,
            guest,
            lambda: None,
            id="g",
            owner=GoalOwner(1, "main", None),
            action="/count",
            type="",
            moves=False,
            poll_timeout=20.0,
            on_end=lambda goal: None,
        )

    def _cancel(self, operation: object) -> None:
        self.cancelled = True

    async def members(self, caller: RobotCaller, listing: PageQuery) -> dict[str, Any]:
        """The only goal."""
        return {"goals": [self.goal.summary()], "next": ""}

    def find(self, caller: RobotCaller, id: str) -> HttpGoal:
        """The only goal."""
        if (id, caller.principal.name) != ("g", "ann"):
            raise NotFound("there is no such goal")
        return self.goal

    async def status(self, caller: RobotCaller, goal: HttpGoal) -> GoalReply:
        """Its complete status."""
        return GoalReply(goal.json(), goal.over)

    async def state(self, caller: RobotCaller, id: str, wait: float, unlike: frozenset[str]) -> GoalReply:
        """Its state."""
        status = await self.status(caller, self.find(caller, id))
        return status._replace(known=status.etag in unlike)

    def cancel(self, caller: RobotCaller, id: str) -> HttpGoal | None:
        """Cancels it if it is active."""
        goal = self.find(caller, id)
        goal.cancel("unwanted")
        return None if goal.over else goal


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A site."""
    return World(tmp_path)


@pytest.fixture
def fake(world: World) -> FakeResources:
    """The goal service of the site."""
    made: Any = FakeResources(world.clock)
    world.router.add(GoalEndpoints(world.clock, made, made, Idempotency(world.clock)))
    return made


def follows(world: World, method: str = "GET") -> Transport:
    """A client follows the goal."""
    transport = world.connect()
    lines = {"Host": HOST, "Accept": "text/event-stream", **ANN}
    head = f"{method} {HERE}/g HTTP/1.1\r\n" + "".join(
        f"{name}: {value}\r\n" for name, value in lines.items()
    )
    world.send(transport, head.encode() + b"\r\n")
    return transport


def events(transport: Transport) -> list[tuple[str, Any]]:
    """Received events."""
    lines = transport.value().decode().split("\n")
    pairs = [
        (lines[at].partition(": ")[2], line.partition(": ")[2])
        for at, line in enumerate(lines[1:])
        if line.startswith("data: ")
    ]
    return [(name, json.loads(data)) for name, data in pairs]


def feedback(value: int) -> bytes:
    """Feedback of the goal."""
    return b'{"sequence":[%d]}' % value


def test_a_stream_reports_progress_and_result(world: World, fake: FakeResources) -> None:
    """The present status is sent at once. The stream counts as polling, and ends with the goal."""
    fake.goal.feedback(feedback(1))
    reader = follows(world)
    world.clock.pump([1.0] * 30)
    fake.goal.feedback(feedback(2))
    assert not fake.cancelled
    fake.goal.ended(4, True, feedback(3))
    (*reported, (name, status)) = events(reader)
    assert reported == [("feedback", {"sequence": [1]}), ("feedback", {"sequence": [2]})]
    assert (name, status["state"], status["result"]) == ("ended", "succeeded", {"sequence": [3]})
    assert reader.value().endswith(b"0\r\n\r\n")
    assert parse(reader.value()).headers[HEADER][:2] == "1."


def test_a_stream_ends_after_a_minute(world: World, fake: FakeResources) -> None:
    """Without an end of the goal. A client that has left does not poll any more."""
    reader = follows(world)
    world.clock.pump([1.0] * 59)
    assert reader.value().count(b":\n\n") >= 10 and not reader.value().endswith(b"0\r\n\r\n")
    world.clock.pump([1.0] * 5)
    assert reader.value().endswith(b"0\r\n\r\n") and events(reader) == []
    world.clock.pump([1.0] * 20)
    assert fake.cancelled


def test_gone_viewer_is_removed(world: World, fake: FakeResources) -> None:
    """Although the stream could continue."""
    follows(world).loseConnection()
    world.clock.pump([1.0] * 20)
    assert fake.cancelled


def test_head_of_a_stream_ends_and_follows_nothing(world: World, fake: FakeResources) -> None:
    reader = follows(world, "HEAD")
    head, _, rest = reader.value().partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 200 ")
    assert b"text/event-stream" in head
    fake.goal.feedback(feedback(1))
    world.clock.pump([1.0] * 3)
    assert rest == reader.value().partition(b"\r\n\r\n")[2] == b""
    assert fake.goal._polls == 0


def test_a_stream_ends_with_its_token(world: World, fake: FakeResources) -> None:
    """Within seconds, and without the goal's end."""
    reader = follows(world)
    del world.service.tokens["ann"]
    world.clock.pump([1.0] * 6)
    assert reader.value().endswith(b"0\r\n\r\n")
    fake.goal.ended(4, True, feedback(3))
    assert events(reader) == []


def test_slow_reader_gets_the_newest(world: World, fake: FakeResources) -> None:
    """It gets the newest feedback when it reads again, and always the end."""
    reader = follows(world)
    reader.producer.pauseProducing()
    for value in range(5):
        fake.goal.feedback(feedback(value))
    assert events(reader) == []
    reader.producer.resumeProducing()
    fake.goal.feedback(feedback(7))
    fake.goal.feedback(feedback(8))
    assert [data["sequence"] for _, data in events(reader)] == [[7], [8]]


def test_a_status_is_read_and_cancelled(world: World, fake: FakeResources) -> None:
    """The answer has an entity tag and a freshness token."""
    assert [each["id"] for each in world.ask("GET", HERE, **ANN).json["goals"]] == ["g"]
    read = world.ask("GET", f"{HERE}/g", **ANN)
    assert (read.status, read.json["state"], read.headers[HEADER][:2]) == (200, "active", "1.")
    known = world.ask("GET", f"{HERE}/g", If_None_Match=read.headers["etag"], **ANN)
    assert (known.status, known.body, known.headers["etag"]) == (304, b"", read.headers["etag"])
    cancelled = world.ask("DELETE", f"{HERE}/g", **ANN)
    assert (cancelled.status, cancelled.json["state"]) == (202, "cancelling")
    fake.goal.ended(5, True, feedback(1))
    assert world.ask("DELETE", f"{HERE}/g", **ANN).status == 204


@pytest.mark.parametrize(
    ("method", "address", "status"),
    [
        ("GET", "/g?wait=61", 400),
        ("GET", "/g?wait=nan", 400),
        ("GET", "/g?wait=1&wait=2", 400),
        ("GET", "/g?age=1", 400),
        ("GET", "/h", 404),
        ("DELETE", "/h", 404),
        ("GET", "?limit=0", 400),
        ("POST", "", 405),
        ("PUT", "/g", 405),
    ],
)
def test_invalid_value_is_refused(
    world: World, fake: FakeResources, method: str, address: str, status: int
) -> None:
    """As problem details."""
    answer = world.ask(method, HERE + address, **ANN)
    assert (answer.status, answer.headers["content-type"]) == (status, "application/problem+json")


def test_a_body_that_cannot_be_read_gives_no_goal(world: World) -> None:
    """The error has a reason; no goal is started."""
    given: list[str] = []

    async def give(caller: RobotCaller, name: str, ask: Any, moment: int | None) -> HttpGoal:
        given.append(name)
        raise NotFound("there is no such action")

    goals: Any = SimpleNamespace(give=give, may=give)
    world.router.add(GoalEndpoints(world.clock, goals, goals, Idempotency(world.clock)))
    address = "/api/v1/robots/rover/actions/count"
    assert world.ask("POST", address, {"poll_timeout": 0}, **ANN).status == 400
    assert given == []
    assert world.ask("POST", address, {}, **ANN, Prefer="wait=1").status == 404
    assert given == ["count"]


@pytest.mark.parametrize(
    ("preferred", "seconds", "applied"),
    [
        ([], None, None),
        (["wait=10"], 10.0, "wait=10"),
        (['respond-async, WAIT="2.5"'], 2.5, "wait=2.5"),
        (["respond-async", "wait=3; for=me"], 3.0, "wait=3"),
        (["wait=3600"], 60.0, "wait=60"),
        (["wait"], None, None),
        (["wait=soon"], None, None),
        (["wait=-1"], None, None),
        (["wait=nan"], None, None),
    ],
)
def test_how_long_is_preferred_to_wait(
    preferred: list[str], seconds: float | None, applied: str | None
) -> None:
    """Impossible preferences are ignored; applied ones are confirmed."""
    request: Any = DummyRequest([b""])
    request.requestHeaders.setRawHeaders("prefer", preferred)
    assert wait_preferred(request) == seconds
    assert request.responseHeaders.getRawHeaders(APPLIED) == (None if applied is None else [applied])
