"""Goals over HTTP on transports in memory: what a stream tells, and to whom; what is preferred."""

from __future__ import annotations

import json
from functools import partial
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from twisted.internet.defer import Deferred
from twisted.web.test.requesthelper import DummyRequest

from relay_protocol.errors import Invalid, NotFound
from relay_server.common.freshness_tokens import HEADER, FreshnessTokens
from relay_server.http.idempotency import Idempotency
from relay_server.http.idempotent_requests import IdempotentRequests
from relay_server.http.request_params import APPLIED, wait_preferred
from relay_server.resources import goals_http as module
from relay_server.resources.goals import GoalOwner, GoalReply, HttpGoal
from relay_server.resources.page import PageQuery
from relay_server.resources.service import RequestOrigin
from tests.relay_server.edges.http_client import ANN as ANN_HERSELF
from tests.relay_server.edges.http_client import HOST, Transport, World, parse
from tests.relay_server.steering import outcome

HERE = "/api/v1/robots/rover/goals"
ANN = {"Authorization": "Bearer ann"}


class Desk:
    """Knows one goal, which is ann's."""

    def __init__(self, clock: Any) -> None:
        self.cancelled = False
        client = SimpleNamespace(new_id=lambda: "1", closed=None, do=self._cancel)
        robot = SimpleNamespace(name="rover")
        guest: Any = SimpleNamespace(client=client, session=SimpleNamespace(robot=robot))
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
            unwatched=20.0,
            on_end=lambda goal: None,
        )

    def _cancel(self, operation: object) -> None:
        self.cancelled = True

    async def members(self, asker: RequestOrigin, listing: PageQuery) -> dict[str, Any]:
        """One."""
        return {"goals": [self.goal.summary()], "next": ""}

    def find(self, asker: RequestOrigin, id: str) -> HttpGoal:
        """Only this."""
        if (id, asker.principal.name) != ("g", "ann"):
            raise NotFound("there is no such goal")
        return self.goal

    async def told(self, asker: RequestOrigin, goal: HttpGoal) -> GoalReply:
        """All of it."""
        return GoalReply(goal.json(), goal.over)

    async def state(self, asker: RequestOrigin, id: str, wait: float, unlike: frozenset[str]) -> GoalReply:
        """As it is."""
        told = await self.told(asker, self.find(asker, id))
        return told._replace(known=told.etag in unlike)

    def cancel(self, asker: RequestOrigin, id: str) -> HttpGoal | None:
        """Only what goes on."""
        goal = self.find(asker, id)
        goal.cancel("unwanted")
        return None if goal.over else goal


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A site."""
    return World(tmp_path)


@pytest.fixture
def desk(world: World) -> Desk:
    """Who is asked there for goals."""
    made: Any = Desk(world.clock)
    world.below["goals"] = partial(module.below, world.clock, made, FreshnessTokens(lambda: 1))
    return made


def follows(world: World) -> Transport:
    """Somebody who follows the goal."""
    transport = world.connect()
    lines = {"Host": HOST, "Accept": "text/event-stream", **ANN}
    head = f"GET {HERE}/g HTTP/1.1\r\n" + "".join(f"{name}: {value}\r\n" for name, value in lines.items())
    world.send(transport, head.encode() + b"\r\n")
    return transport


def events(transport: Transport) -> list[tuple[str, Any]]:
    """What he was told."""
    lines = transport.value().decode().split("\n")
    pairs = [
        (lines[at].partition(": ")[2], line.partition(": ")[2])
        for at, line in enumerate(lines[1:])
        if line.startswith("data: ")
    ]
    return [(name, json.loads(data)) for name, data in pairs]


def feedback(value: int) -> bytes:
    """How far it has come."""
    return b'{"sequence":[%d]}' % value


def test_a_stream_tells_how_far_it_has_come_and_how_it_ended(world: World, desk: Desk) -> None:
    """What is known already at once; it is a look at the goal, and ends with it."""
    desk.goal.feedback(feedback(1))
    reader = follows(world)
    world.clock.pump([1.0] * 30)
    desk.goal.feedback(feedback(2))
    assert not desk.cancelled
    desk.goal.ended(4, True, feedback(3))
    (*told, (name, status)) = events(reader)
    assert told == [("feedback", {"sequence": [1]}), ("feedback", {"sequence": [2]})]
    assert (name, status["state"], status["result"]) == ("ended", "succeeded", {"sequence": [3]})
    assert reader.value().endswith(b"0\r\n\r\n")
    assert parse(reader.value()).headers[HEADER][:2] == "1."


def test_a_stream_ends_after_a_minute(world: World, desk: Desk) -> None:
    """Without a word of the goal's end; who has gone looks at it no more."""
    reader = follows(world)
    world.clock.pump([1.0] * 59)
    assert reader.value().count(b":\n\n") >= 10 and not reader.value().endswith(b"0\r\n\r\n")
    world.clock.pump([1.0] * 5)
    assert reader.value().endswith(b"0\r\n\r\n") and events(reader) == []
    world.clock.pump([1.0] * 20)
    assert desk.cancelled


def test_who_leaves_looks_no_more(world: World, desk: Desk) -> None:
    """Though a stream could have gone on."""
    follows(world).loseConnection()
    world.clock.pump([1.0] * 20)
    assert desk.cancelled


def test_whose_token_ends_is_told_no_more(world: World, desk: Desk) -> None:
    """Within seconds; not even how it ended."""
    reader = follows(world)
    del world.desk.tokens["ann"]
    world.clock.pump([1.0] * 6)
    assert reader.value().endswith(b"0\r\n\r\n")
    desk.goal.ended(4, True, feedback(3))
    assert events(reader) == []


def test_who_reads_slowly_is_told_the_newest(world: World, desk: Desk) -> None:
    """When he takes something again, and the end in any case."""
    reader = follows(world)
    reader.producer.pauseProducing()
    for value in range(5):
        desk.goal.feedback(feedback(value))
    assert events(reader) == []
    reader.producer.resumeProducing()
    desk.goal.feedback(feedback(7))
    desk.goal.feedback(feedback(8))
    assert [data["sequence"] for _, data in events(reader)] == [[7], [8]]


def test_a_status_is_read_and_cancelled(world: World, desk: Desk) -> None:
    """With an entity tag, and a moment as all answers have."""
    assert [each["id"] for each in world.ask("GET", HERE, **ANN).json["goals"]] == ["g"]
    read = world.ask("GET", f"{HERE}/g", **ANN)
    assert (read.status, read.json["state"], read.headers[HEADER][:2]) == (200, "active", "1.")
    known = world.ask("GET", f"{HERE}/g", If_None_Match=read.headers["etag"], **ANN)
    assert (known.status, known.body, known.headers["etag"]) == (304, b"", read.headers["etag"])
    cancelled = world.ask("DELETE", f"{HERE}/g", **ANN)
    assert (cancelled.status, cancelled.json["state"]) == (202, "cancelling")
    desk.goal.ended(5, True, feedback(1))
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
def test_what_makes_no_sense_is_refused(
    world: World, desk: Desk, method: str, address: str, status: int
) -> None:
    """As problem details."""
    answer = world.ask(method, HERE + address, **ANN)
    assert (answer.status, answer.headers["content-type"]) == (status, "application/problem+json")


def test_a_preference_that_cannot_be_read_gives_no_goal(world: World) -> None:
    """It is refused in words, before anything is done."""
    given: list[str] = []

    async def give(asker: RequestOrigin, name: str, ask: Any, moment: int | None) -> HttpGoal:
        given.append(name)
        raise NotFound("there is no such action")

    desk: Any = SimpleNamespace(give=give)
    giving = module.GoalSubmission(desk, IdempotentRequests(Idempotency(world.clock), desk))
    request: Any = DummyRequest([b""])
    request.channel = SimpleNamespace(transport=None)
    request.content = BytesIO(b"{}")
    request.requestHeaders.setRawHeaders("content-type", ["application/json"])
    request.requestHeaders.setRawHeaders(b"prefer", [b"wait=\xff"])
    asker = RequestOrigin(ANN_HERSELF, "rover", "192.0.2.9")
    (error,) = outcome(Deferred.fromCoroutine(giving.give(request, asker, "/count", None)))
    assert isinstance(error, Invalid) and "prefer" in str(error)
    assert given == []
    request.requestHeaders.setRawHeaders(b"prefer", [b"wait=1"])
    request.content.seek(0)
    (error,) = outcome(Deferred.fromCoroutine(giving.give(request, asker, "/count", None)))
    assert isinstance(error, NotFound) and given == ["/count"]


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
    """What can't be done is passed over; what is done is said to be."""
    request: Any = DummyRequest([b""])
    request.requestHeaders.setRawHeaders("prefer", preferred)
    assert wait_preferred(request) == seconds
    assert request.responseHeaders.getRawHeaders(APPLIED) == (None if applied is None else [applied])
