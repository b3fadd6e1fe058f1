"""Resources over HTTP on transports in memory: headers of answers in every format and as a stream."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from twisted.internet.defer import Deferred

from relay_protocol.errors import NotFound, Refused, SwitchboardError
from relay_protocol.rights import Operation
from relay_server.common.freshness_tokens import HEADER
from relay_server.http.idempotency import Idempotency
from relay_server.http.media_types import FORMS
from relay_server.in_process_sessions.in_process_port import MaybeDone
from relay_server.in_process_sessions.pool import RobotCaller
from relay_server.resources.goals_http import GoalEndpoints
from relay_server.resources.page import PageQuery
from relay_server.resources.service import MessageConditions
from relay_server.resources.services_http import ActionEndpoints, ParameterEndpoints, ServiceEndpoints
from relay_server.resources.states import ParamState, TopicContext, TopicState
from relay_server.resources.topics_http import TopicEndpoints
from tests.worlds.http_client import HOST, World, parse

HERE = "/api/v1/robots/rover"
ANN = {"Authorization": "Bearer ann"}
MEDIA = [each.media for each in FORMS]
NEWEST = TopicState("/said", "std_msgs/msg/String", 5.0, b'{"data":"hello"}')


SERVICE = {"name": "/reset", "types": ["std_srvs/srv/Trigger"], "providers": ["/base"], "moves": True}


class FakeResources:
    """Has one topic with a constant message, one service, one action, and one parameter."""

    def __init__(self) -> None:
        self.over: Deferred[None] = Deferred()
        self.cut: SwitchboardError | None = None
        """What comes in between when parameters are read or deleted."""

    async def members(self, caller: RobotCaller, kind: str, listing: PageQuery) -> dict[str, Any]:
        """No members."""
        return {kind: [], "next": "", "online": True}

    async def member(self, caller: RobotCaller, kind: str, name: str) -> dict[str, Any]:
        """One member of each kind."""
        if (caller.robot, kind, name) not in (
            ("rover", "topics", "said"),
            ("rover", "services", "reset"),
            ("rover", "actions", "reset"),
        ):
            raise NotFound("there is none, or you have no right on it")
        return SERVICE

    async def check_may_know(self, caller: RobotCaller) -> None:
        """One robot exists."""
        if caller.robot != "rover":
            raise NotFound("there is no such robot, or you have no right on it")

    async def may(self, caller: RobotCaller, operation: Operation, name: str) -> None:
        """Allows everything."""

    async def newest_message(self, caller: RobotCaller, name: str, wanted: MessageConditions) -> TopicState:
        """The constant message."""
        return NEWEST

    async def param(self, caller: RobotCaller, name: str) -> ParamState:
        """The value true."""
        if self.cut is not None:
            raise self.cut
        if (caller.robot, name) != ("rover", "node:truth"):
            raise NotFound("there is none")
        return ParamState(name, b"true")

    async def remove_param(self, caller: RobotCaller, name: str, match: str | None) -> None:
        """Has no effect."""
        if self.cut is not None:
            raise self.cut

    async def call(
        self,
        caller: RobotCaller,
        name: str,
        args: Any,
        type_name: str,
        seconds: float,
        earliest_sent: int | None,
    ) -> bytes:
        """Returns the timeout."""
        return str(seconds).encode()

    async def topic_context(self, caller: RobotCaller, state: TopicState) -> TopicContext:
        return TopicContext({}, False)

    async def convert(self, caller: RobotCaller, work: Callable[[], Any]) -> Any:
        """Converts it here."""
        return work()

    @asynccontextmanager
    async def follow(
        self,
        caller: RobotCaller,
        name: str,
        throttle_ms: float,
        on_message: Callable[[bytes], None],
        on_status: Callable[[str, str], None],
        *,
        whole: bool,
    ) -> AsyncIterator[Any]:
        """Sends the message once."""
        on_message(NEWEST.value)
        on_status("warning", "some are missing")
        yield SimpleNamespace(over=self.over, reason=None, check=lambda: None)


@pytest.fixture
def fake() -> FakeResources:
    """The resource service of the site."""
    return FakeResources()


@pytest.fixture
def world(tmp_path: Path, fake: Any) -> World:
    """A site with the fake service."""
    made = World(tmp_path)
    keys = Idempotency(made.clock)
    made.router.add(
        TopicEndpoints(made.clock, fake, keys),
        ServiceEndpoints(fake, keys),
        ActionEndpoints(fake),
        ParameterEndpoints(fake),
        GoalEndpoints(made.clock, fake, fake, keys),
    )
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
def test_a_call_has_the_requested_timeout(
    world: World, body: dict[str, float], prefer: dict[str, str], seconds: float, applied: str | None
) -> None:
    """The body's value precedes ``Prefer``; an applied preference is confirmed."""
    answer = world.ask("POST", f"{HERE}/services/reset", body, **prefer, **ANN)
    assert answer.json == {"values": seconds}
    assert answer.headers.get("preference-applied") == applied


def test_a_call_without_a_body_has_an_empty_request(world: World) -> None:
    """Such a request needs no content type."""
    answer = world.ask("POST", f"{HERE}/services/reset", **ANN)
    assert (answer.status, answer.json) == (200, {"values": 10.0})


@pytest.mark.parametrize("media", MEDIA)
@pytest.mark.parametrize(
    "address", ["topics", "topics/said", "services/reset", "actions/reset", "params/node:truth"]
)
def test_an_answer_has_a_moment_in_every_form(world: World, address: str, media: str) -> None:
    """Clients of each format can return the token."""
    answer = world.ask("GET", f"{HERE}/{address}", Accept=media, **ANN)
    assert (answer.status, answer.headers["content-type"].partition(";")[0]) == (200, media)
    assert answer.body
    assert answer.headers[HEADER][:2] == "1."


def test_a_stream_has_a_moment(world: World, fake: FakeResources) -> None:
    """Even if the present message is sent at once."""
    transport = world.connect()
    lines = {"Host": HOST, "Accept": "text/event-stream", **ANN}
    head = f"GET {HERE}/topics/said HTTP/1.1\r\n" + "".join(
        f"{key}: {each}\r\n" for key, each in lines.items()
    )
    world.send(transport, head.encode() + b"\r\n")
    fake.over.callback(None)
    answer = parse(transport.value())
    assert (answer.status, answer.headers["content-type"]) == (200, "text/event-stream")
    assert NEWEST.value in answer.body
    assert b'event: status\ndata: {"level":"warning","msg":"some are missing"}\n\n' in answer.body
    assert answer.headers[HEADER][:2] == "1."


@pytest.mark.parametrize("media", MEDIA)
def test_known_value_is_sent_with_its_tag(world: World, media: str) -> None:
    """The tag belongs to the requested format (RFC 9110 section 15.4.5)."""
    address = f"{HERE}/topics/said"
    tag = world.ask("GET", address, Accept=media, **ANN).headers["etag"]
    known = world.ask("GET", address, Accept=media, If_None_Match=f'"other", {tag}', **ANN)
    assert (known.status, known.body, known.headers["etag"]) == (304, b"", tag)
    assert known.headers["vary"] == "Accept"


def test_uncertain_result_is_reported_as_such(world: World, fake: FakeResources) -> None:
    """Reads are refused instead."""
    fake.cut = MaybeDone(Refused("your right was revoked"))
    address = f"{HERE}/params/node:truth"
    changed = world.ask("DELETE", address, **ANN)
    reported = changed.json
    assert (changed.status, reported["code"], reported["title"]) == (409, "maybe_done", "Perhaps done")
    assert "revoked" in reported["detail"] and "may have been done" in reported["detail"]
    # An unsupported method gets only this check.
    for method in ("GET", "POST"):
        read = world.ask(method, address, **ANN)
        assert (read.status, read.json["code"]) == (403, "refused")
        assert read.json["detail"] == "your right was revoked" and read.headers[HEADER][:2] == "1."


@pytest.mark.parametrize("media", MEDIA)
@pytest.mark.parametrize("part", ["services", "actions"])
def test_service_and_action_are_described(world: World, part: str, media: str) -> None:
    """As in lists, in every format, each with its own entity tag."""
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
    """Other methods get 405 from users who may know the resource, and 404 from others."""
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
    """A condition about the former message is refused with a reason."""
    answer = world.ask(method, f"{HERE}/topics/said", {"value": {}}, If_Match="*", **ANN)
    assert answer.status == 400 and "'If-Match' does not apply" in answer.json["detail"]


def test_a_stop_is_called_each_time_for_any_key(world: World, fake: FakeResources) -> None:
    """An earlier stop with the same key must not prevent a stop."""
    called: list[str] = []

    async def call(caller: RobotCaller, name: str, *args: Any) -> bytes:
        called.append(name)
        return b"{}"

    fake.call = call  # type: ignore[method-assign]
    for key in ("k", "k", "k" * 1000):
        for name in ("relay/stop", "relay/release_control"):
            assert world.ask("POST", f"{HERE}/services/{name}", Idempotency_Key=key, **ANN).status == 200
    assert called == ["relay/stop", "relay/release_control"] * 3
