"""Resources over HTTP on transports in memory: the headers of their answers, in every form and as a stream."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from twisted.internet.defer import Deferred

from relay_protocol.errors import NotFound, Refused, SwitchboardError
from relay_server.common.freshness_tokens import HEADER, FreshnessTokens
from relay_server.http.idempotent_requests import IdempotentRequests
from relay_server.http.media_types import FORMS
from relay_server.http_sessions.loopback_client import MaybeDone
from relay_server.resources import http as module
from relay_server.resources.etags import ParamState, TopicState
from relay_server.resources.http import TopicResource
from relay_server.resources.page import PageQuery
from relay_server.resources.service import RequestOrigin, TopicQuery
from relay_server.resources.topic_context import TopicContext
from tests.relay_server.edges.http_client import HOST, World, parse

HERE = "/api/v1/robots/rover"
ANN = {"Authorization": "Bearer ann"}
MEDIA = [each.media for each in FORMS]
NEWEST = TopicState("/said", "std_msgs/msg/String", 5.0, b'{"data":"hello"}')


SERVICE = {"name": "/reset", "types": ["std_srvs/srv/Trigger"], "providers": ["/base"], "moves": True}


class Desk:
    """Knows one topic, which says the same for ever, one service, one action, and one parameter."""

    def __init__(self) -> None:
        self.over: Deferred[None] = Deferred()
        self.cut: SwitchboardError | None = None
        """What comes in between when parameters are read or deleted."""

    async def members(self, asker: RequestOrigin, kind: str, listing: PageQuery) -> dict[str, Any]:
        """None."""
        return {kind: [], "next": "", "online": True}

    async def member(self, asker: RequestOrigin, kind: str, name: str) -> dict[str, Any]:
        """One of each kind."""
        if (asker.robot, kind, name) not in (
            ("rover", "topics", "said"),
            ("rover", "services", "reset"),
            ("rover", "actions", "reset"),
        ):
            raise NotFound("there is none, or you have no right on it")
        return SERVICE

    async def see(self, asker: RequestOrigin) -> None:
        """One robot is there."""
        if asker.robot != "rover":
            raise NotFound("there is no such robot, or you have no right on it")

    async def state(self, asker: RequestOrigin, name: str, wanted: TopicQuery) -> tuple[TopicState, bool]:
        """What is said."""
        return NEWEST, NEWEST.etag in wanted.unlike

    async def param(self, asker: RequestOrigin, name: str) -> ParamState:
        """A truth."""
        if self.cut is not None:
            raise self.cut
        if (asker.robot, name) != ("rover", "node:truth"):
            raise NotFound("there is none")
        return ParamState(name, b"true")

    async def remove_param(self, asker: RequestOrigin, name: str, match: str | None) -> None:
        """Nothing comes of it."""
        if self.cut is not None:
            raise self.cut

    async def call(
        self, asker: RequestOrigin, name: str, args: Any, type_name: str, seconds: float, moment: int | None
    ) -> bytes:
        """How long it may take."""
        return str(seconds).encode()

    async def background(self, asker: RequestOrigin, state: TopicState) -> TopicContext:
        """Nothing."""
        return TopicContext({}, False)

    async def made(self, asker: RequestOrigin, work: Callable[[], Any]) -> Any:
        """Here and now."""
        return work()

    @asynccontextmanager
    async def follow(
        self, asker: RequestOrigin, name: str, throttle_ms: float, tell: Callable[[bytes], None]
    ) -> AsyncIterator[Any]:
        """Said once, at once."""
        tell(NEWEST.value)
        yield SimpleNamespace(over=self.over, reason=None, look=lambda: None)


@pytest.fixture
def desk() -> Desk:
    """Who is asked."""
    return Desk()


@pytest.fixture
def world(tmp_path: Path, desk: Any) -> World:
    """A site in front of it."""
    made, moments, unused = World(tmp_path), FreshnessTokens(lambda: 1), SimpleNamespace()

    def below(part: str, api: Any, robot: str) -> Any:
        resources = TopicResource(
            made.clock,
            desk,
            moments,
            IdempotentRequests(unused, desk),  # type: ignore[arg-type]
            unused,  # type: ignore[arg-type]
            part,
            api,
            robot,
        )
        return resources.app.resource()

    made.below.update({part: partial(below, part) for part in module.PARTS})
    return made


@pytest.mark.parametrize(
    ("body", "prefer", "seconds", "applied"),
    [
        ({}, {}, 10.0, None),
        ({}, {"Prefer": "wait=25"}, 25.0, "wait=25"),
        ({}, {"Prefer": "wait=900"}, 60.0, "wait=60"),
        ({}, {"Prefer": "wait=0"}, 10.0, None),
        ({"timeout": 200}, {"Prefer": "wait=25"}, 200.0, None),
        ({"timeout": 0.5}, {}, 0.5, None),
    ],
)
def test_a_call_takes_as_long_as_is_said(
    world: World, body: dict[str, float], prefer: dict[str, str], seconds: float, applied: str | None
) -> None:
    """By the body, else by what is preferred; and what of that is so is said."""
    answer = world.ask("POST", f"{HERE}/services/reset", body, **prefer, **ANN)
    assert answer.json == {"values": seconds}
    assert answer.headers.get("preference-applied") == applied


def test_a_call_without_a_body_has_an_empty_request(world: World) -> None:
    """Nor need it say that nothing is JSON."""
    answer = world.ask("POST", f"{HERE}/services/reset", **ANN)
    assert (answer.status, answer.json) == (200, {"values": 10.0})


@pytest.mark.parametrize("media", MEDIA)
@pytest.mark.parametrize(
    "address", ["topics", "topics/said", "services/reset", "actions/reset", "params/node:truth"]
)
def test_an_answer_has_a_moment_in_every_form(world: World, address: str, media: str) -> None:
    """Who reads in that form gives it back."""
    answer = world.ask("GET", f"{HERE}/{address}", Accept=media, **ANN)
    assert (answer.status, answer.headers["content-type"].partition(";")[0]) == (200, media)
    assert answer.body
    assert answer.headers[HEADER][:2] == "1."


def test_a_stream_has_a_moment(world: World, desk: Desk) -> None:
    """Though what is there already is told at once."""
    transport = world.connect()
    lines = {"Host": HOST, "Accept": "text/event-stream", **ANN}
    head = f"GET {HERE}/topics/said HTTP/1.1\r\n" + "".join(
        f"{key}: {each}\r\n" for key, each in lines.items()
    )
    world.send(transport, head.encode() + b"\r\n")
    desk.over.callback(None)
    answer = parse(transport.value())
    assert (answer.status, answer.headers["content-type"]) == (200, "text/event-stream")
    assert NEWEST.value in answer.body
    assert answer.headers[HEADER][:2] == "1."


@pytest.mark.parametrize("media", MEDIA)
def test_what_is_known_is_told_with_its_tag(world: World, media: str) -> None:
    """That of the form asked for (RFC 9110 section 15.4.5)."""
    address = f"{HERE}/topics/said"
    tag = world.ask("GET", address, Accept=media, **ANN).headers["etag"]
    known = world.ask("GET", address, Accept=media, If_None_Match=f'"other", {tag}', **ANN)
    assert (known.status, known.body, known.headers["etag"]) == (304, b"", tag)
    assert known.headers["vary"] == "Accept"


def test_what_may_have_been_done_is_told_so(world: World, desk: Desk) -> None:
    """But for what is only read: that is refused."""
    desk.cut = MaybeDone(Refused("your right was revoked"))
    address = f"{HERE}/params/node:truth"
    changed = world.ask("DELETE", address, **ANN)
    told = changed.json
    assert (changed.status, told["code"], told["title"]) == (409, "maybe_done", "Perhaps done")
    assert "revoked" in told["detail"] and "may have been done" in told["detail"]
    # Which is all that is done for a method that there is not.
    for method in ("GET", "POST"):
        read = world.ask(method, address, **ANN)
        assert (read.status, read.json["code"]) == (403, "refused")
        assert read.json["detail"] == "your right was revoked" and read.headers[HEADER][:2] == "1."


@pytest.mark.parametrize("media", MEDIA)
@pytest.mark.parametrize("part", ["services", "actions"])
def test_one_service_or_action_is_told(world: World, part: str, media: str) -> None:
    """As it is listed, in every form, each with a tag of its own by which it is known."""
    address = f"{HERE}/{part}/reset"
    answer = world.ask("GET", address, Accept=media, **ANN)
    if media == "application/json":
        assert answer.json == SERVICE
    assert b"std_srvs/srv/Trigger" in answer.body and b"/base" in answer.body
    known = world.ask("GET", address, Accept=media, If_None_Match=answer.headers["etag"], **ANN)
    assert (known.status, known.body, known.headers["etag"]) == (304, b"", answer.headers["etag"])
    others = [each for each in MEDIA if each != media]
    for other in others:
        assert (
            world.ask("GET", address, Accept=other, If_None_Match=known.headers["etag"], **ANN).status == 200
        )
    assert world.ask("GET", f"{address}/now", Accept=media, **ANN).status == 404
    assert world.ask("GET", address, Accept=media).status == 401


@pytest.mark.parametrize(
    ("address", "methods", "takes"),
    [
        ("topics", ("PUT", "POST", "DELETE", "PATCH"), "GET, HEAD"),
        ("params", ("POST",), "GET, HEAD"),
        ("topics/said", ("DELETE", "PATCH"), "GET, HEAD, POST, PUT"),
        ("services/reset", ("PUT", "DELETE"), "GET, HEAD, POST"),
        ("actions/reset", ("PUT", "DELETE"), "GET, HEAD, POST"),
        ("params/node:truth", ("POST", "PATCH"), "DELETE, GET, HEAD, PUT"),
    ],
)
def test_addresses_take_their_own_methods(
    world: World, address: str, methods: tuple[str, ...], takes: str
) -> None:
    """Of others they say so to who may know what is there; where there is nothing for him, there is nothing."""
    for method in methods:
        answer = world.ask(method, f"{HERE}/{address}", **ANN)
        assert (answer.status, answer.headers["allow"]) == (405, takes), method
        assert answer.headers["content-type"] == "application/problem+json"
        assert takes in answer.json["detail"] and answer.headers[HEADER]
        other = HERE.replace("rover", "other")
        absent = [f"{other}/{address}", *([f"{HERE}/{address}x"] if "/" in address else [])]
        for path in absent:
            strange = world.ask(method, path, **ANN)
            assert (strange.status, "allow" in strange.headers) == (404, False), (method, path)
        assert world.ask(method, f"{HERE}/{address}").status == 401, method


@pytest.mark.parametrize("method", ["PUT", "POST"])
def test_a_message_takes_the_place_of_none(world: World, method: str) -> None:
    """Who wants it compared with what was said before is refused in words."""
    answer = world.ask(method, f"{HERE}/topics/said", {"value": {}}, If_Match="*", **ANN)
    assert answer.status == 400 and "'If-Match' does not apply" in answer.json["detail"]
