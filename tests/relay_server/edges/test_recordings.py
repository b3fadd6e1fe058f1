"""``/api/v1/robots/<robot>/recordings`` on transports in memory."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from twisted.internet.defer import Deferred

from relay_protocol.errors import NotFound, Unavailable
from relay_server.access import Principal
from relay_server.http.idempotency import Idempotency
from relay_server.recordings import http as module
from relay_server.recordings.recordings import RecordingRequest
from tests.relay_server.edges.http_client import HOST, Answer, Transport, World, parse

HERE = "/api/v1/robots/rover/recordings"
ANN = {"Authorization": "Bearer ann"}
CONTENT = bytes(range(256)) * 4096


class File:
    """A file whose parts the test gives when it wants to."""

    name = "rover-a.mcap"
    tag = "a"

    def __init__(self, size: int = len(CONTENT)) -> None:
        self.size = size
        self.open = True
        self.begun = 0
        self.busy = False
        self.denied: Callable[[str], None] = lambda reason: None
        self.asked: list[tuple[int, int, Deferred[bytes]]] = []

    async def begin(self) -> None:
        """It is sent."""
        if self.busy:
            raise Unavailable("too much at once")
        self.begun += 1

    def watch(self, denied: Callable[[str], None]) -> None:
        """Keep who is to be told."""
        self.denied = denied

    async def part(self, offset: int, size: int) -> bytes:
        """When the test says so."""
        part: Deferred[bytes] = Deferred()
        self.asked.append((offset, size, part))
        return await part

    def close(self) -> None:
        """Once."""
        assert self.open
        self.open = False

    def gives(self) -> None:
        """The part that is asked for."""
        offset, size, part = self.asked.pop()
        part.callback(CONTENT[offset : offset + size])


class Desk:
    """Keeps what it is asked; one recording is there."""

    def __init__(self) -> None:
        self.asks: list[RecordingRequest] = []
        self.deleted: list[str] = []
        self.pages: list[tuple[int, str]] = []
        self.file = File()

    async def start(
        self, principal: Principal, robot: str, ask: RecordingRequest, address: str
    ) -> dict[str, Any]:
        """It begins."""
        assert (principal.name, robot, address) == ("ann", "rover", "192.0.2.9")
        self.asks.append(ask)
        return {"id": "a"}

    async def may_start(self, principal: Principal, robot: str, ask: RecordingRequest, address: str) -> None:
        """Still."""

    async def possible(self, principal: Principal, robot: str, address: str) -> dict[str, Any]:
        """One topic."""
        return {"topics": ["/odom"]}

    async def all(
        self, principal: Principal, robot: str, address: str, limit: int, before: str
    ) -> dict[str, Any]:
        """The one."""
        self.pages.append((limit, before))
        return {"recordings": [await self.one(principal, robot, "a", address)], "next": None}

    async def one(self, principal: Principal, robot: str, id: str, address: str) -> dict[str, Any]:
        """Only this."""
        if id != "a":
            raise NotFound("there is no such recording")
        return {"id": id}

    async def stop(self, principal: Principal, robot: str, id: str, address: str) -> dict[str, Any]:
        """It is over."""
        return {"id": id, "state": "complete"}

    async def delete(self, principal: Principal, robot: str, id: str, address: str) -> None:
        """It is gone."""
        self.deleted.append(id)

    async def download(self, principal: Principal, robot: str, id: str, address: str) -> File:
        """Its file."""
        return self.file


@pytest.fixture
def desk() -> Desk:
    """Who is asked."""
    return Desk()


@pytest.fixture
def world(tmp_path: Path, desk: Desk) -> World:
    """A site with recordings."""
    made = World(tmp_path)
    made.below["recordings"] = partial(module.below, made.clock, desk, Idempotency(made.clock))
    return made


def fetch(world: World, method: str = "GET", **headers: str) -> Transport:
    """Somebody downloads; the head of the answer and the beginning of the file come later."""
    transport = world.connect()
    head = f"{method} {HERE}/a/file HTTP/1.1\r\nHost: {HOST}\r\nAuthorization: Bearer ann\r\n"
    head += "".join(f"{name.replace('_', '-')}: {value}\r\n" for name, value in headers.items())
    world.send(transport, f"{head}\r\n".encode())
    return transport


def received(world: World, file: File, **headers: str) -> Answer:
    """What somebody gets who takes all that comes."""
    transport = fetch(world, **headers)
    while file.asked:
        file.gives()
    return parse(transport.value())


def test_each_address_does_its_own(world: World, desk: Desk) -> None:
    """With and without a slash at the end of the first."""
    assert world.ask("GET", HERE, **ANN).json == {"recordings": [{"id": "a"}], "next": None}
    answer = world.ask("POST", HERE, {"topics": ["/odom"], "seconds": 5}, **ANN)
    assert (answer.status, answer.headers["location"]) == (201, f"{HERE}/a")
    assert desk.asks == [RecordingRequest(topics=["/odom"], seconds=5.0)]
    assert world.ask("GET", f"{HERE}/a", **ANN).json == {"id": "a"}
    assert world.ask("GET", f"{HERE}/new", **ANN).json == {"topics": ["/odom"]}
    again = {"Idempotency-Key": "k", **ANN}
    told = [world.ask("POST", HERE, {"topics": ["/odom"]}, **again) for _ in "ab"]
    assert len({(each.status, each.headers["location"], each.body) for each in told}) == 1
    assert len(desk.asks) == 2
    assert world.ask("POST", f"{HERE}/a/stop", **ANN).json["state"] == "complete"
    assert world.ask("DELETE", f"{HERE}/a", **ANN).status == 204
    assert desk.deleted == ["a"]


@pytest.mark.parametrize(
    ("method", "path", "status"),
    [
        ("GET", f"{HERE}/b", 404),
        ("GET", f"{HERE}/a/b/c", 404),
        ("GET", "/api/v1/robots/rover/others", 404),
        ("PUT", HERE, 405),
        ("POST", HERE, 400),
    ],
)
def test_what_is_not_there_is_told_as_problem_details(
    world: World, method: str, path: str, status: int
) -> None:
    """Also where no recording is meant."""
    answer = world.ask(method, path, **ANN)
    assert (answer.status, answer.headers["content-type"]) == (status, "application/problem+json")


@pytest.mark.parametrize(
    "body", [{"topics": "/odom"}, {"seconds": 0}, {"megabytes": 1e9}, {"topics": ["/a"] * 65}, {"topic": []}]
)
def test_an_ask_beyond_the_bounds_is_refused(world: World, desk: Desk, body: dict[str, Any]) -> None:
    """Before anybody is asked; a word that is not known may be a mistake."""
    assert world.ask("POST", HERE, body, **ANN).status == 400
    assert desk.asks == []


def test_the_list_comes_in_pages(world: World, desk: Desk) -> None:
    """Of 100, unless another size is asked for; no page is beyond the bounds."""
    for asked in ("", "?limit=500", "?limit=1&before=17.5_a", "?before=17.5_a"):
        assert world.ask("GET", HERE + asked, **ANN).status == 200
    assert desk.pages == [(100, ""), (500, ""), (1, "17.5_a"), (100, "17.5_a")]
    for wrong in ("0", "501", "-1", "many", "9" * 20, "%C2%B2"):
        answer = world.ask("GET", f"{HERE}?limit={wrong}", **ANN)
        assert (answer.status, answer.json["detail"]) == (400, "'limit' is a number from 1 to 500")
    assert len(desk.pages) == 4


def test_nobody_asks_without_a_credential(world: World, desk: Desk) -> None:
    """Nor with a cookie from another page."""
    assert world.ask("GET", HERE).status == 401
    cookie = {"Cookie": "sb=ann", "Origin": "http://evil.example"}
    assert world.ask("POST", HERE, {"topics": ["/odom"]}, **cookie).status == 403
    assert world.ask("DELETE", f"{HERE}/a", **cookie).status == 403


def test_a_file_comes_in_parts(world: World, desk: Desk) -> None:
    """Under its name, and no more of it is read than is taken."""
    transport = fetch(world)
    while desk.file.asked:
        assert desk.file.asked[0][1] <= module.PART_BYTES
        desk.file.gives()
    answer = parse(transport.value())
    assert (answer.status, answer.headers["accept-ranges"], answer.headers["etag"]) == (200, "bytes", '"a"')
    assert answer.headers["content-disposition"] == 'attachment; filename="rover-a.mcap"'
    assert answer.headers["content-length"] == str(len(CONTENT))
    assert answer.body == CONTENT
    assert not desk.file.open


def test_who_takes_nothing_of_a_file_is_waited_for_and_then_cut(world: World, desk: Desk) -> None:
    """Nothing is read meanwhile."""
    transport = fetch(world)
    transport.producer.pauseProducing()
    desk.file.gives()
    assert desk.file.asked == []
    transport.producer.resumeProducing()
    assert len(desk.file.asked) == 1
    transport.producer.pauseProducing()
    desk.file.gives()
    world.clock.advance(module.STALL_SECONDS)
    assert not transport.connected
    assert not desk.file.open


@pytest.mark.parametrize(
    "error", [OSError("it was deleted"), Unavailable("too much at once"), KeyError("surprise")], ids=repr
)
@pytest.mark.parametrize("parts", [0, 1])
def test_nothing_but_the_file_is_ever_in_it(world: World, desk: Desk, error: Exception, parts: int) -> None:
    """Whatever fails once it was promised, and however little was sent, no words stand in its place."""
    transport = fetch(world)
    for _ in range(parts):
        desk.file.gives()
    desk.file.asked.pop()[2].errback(error)
    assert not transport.connected
    assert not desk.file.open
    body = transport.value().partition(b"\r\n\r\n")[2]
    assert body == CONTENT[: parts * module.PART_BYTES]


@pytest.mark.parametrize("how", ["denied", "gone"])
def test_a_file_that_may_or_can_not_be_sent_on_breaks_off(world: World, desk: Desk, how: str) -> None:
    """The client sees that it has not got all."""
    transport = fetch(world)
    desk.file.gives()
    if how == "denied":
        desk.file.denied("your right was revoked")
    else:
        desk.file.asked.pop()[2].errback(OSError("it was deleted"))
    assert not transport.connected
    assert not desk.file.open
    assert len(parse(transport.value()).body) < len(CONTENT)


END = len(CONTENT)


@pytest.mark.parametrize(
    ("asked", "start", "stop"),
    [
        ("bytes=0-0", 0, 1),
        ("bytes=5-9", 5, 10),
        (f"bytes={END - 3}-", END - 3, END),
        ("bytes=0-", 0, END),
        ("bytes=-7", END - 7, END),
        (f"bytes=-{END + 5}", 0, END),
        (f"bytes=1-{END + 5}", 1, END),
        ("Bytes = 5-9", 5, 10),
    ],
)
def test_a_part_of_a_file(world: World, desk: Desk, asked: str, start: int, stop: int) -> None:
    """RFC 9110 section 14: from the beginning, the end, or between."""
    answer = received(world, desk.file, Range=asked)
    assert (answer.status, answer.headers["content-range"]) == (206, f"bytes {start}-{stop - 1}/{END}")
    assert answer.headers["content-length"] == str(stop - start)
    assert answer.body == CONTENT[start:stop]
    assert desk.file.begun == 1


@pytest.mark.parametrize(
    "asked", ["bytes=0-1,5-6", "lines=1-2", "bytes=9-5", "bytes=x-", "bytes", "bytes=-0"]
)
def test_a_range_that_is_not_understood_is_passed_over(world: World, desk: Desk, asked: str) -> None:
    """All of the file comes."""
    answer = received(world, desk.file, Range=asked)
    assert (answer.status, answer.body) == (200, CONTENT)


def test_a_file_has_nothing_behind_its_end(world: World, desk: Desk) -> None:
    """The answer says how long it is; nothing is sent, so nothing is put on record."""
    answer = received(world, desk.file, Range=f"bytes={END}-")
    assert (answer.status, answer.headers["content-range"]) == (416, f"bytes */{END}")
    assert answer.headers["content-type"] == "application/problem+json"
    assert (desk.file.begun, desk.file.open) == (0, False)


@pytest.mark.parametrize(
    ("tag", "status"), [('"a"', 206), ('"b"', 200), ('W/"a"', 200), ("Sat, 21 Nov 2026 19:00:00 GMT", 200)]
)
def test_only_the_same_file_is_gone_on_with(world: World, desk: Desk, tag: str, status: int) -> None:
    """Otherwise all of it comes; a weak tag or a date proves nothing (section 13.1.5)."""
    answer = received(world, desk.file, Range="bytes=10-", If_Range=tag)
    assert (answer.status, answer.body) == (status, CONTENT[10:] if status == 206 else CONTENT)


def test_a_head_tells_what_a_get_would_bring(world: World, desk: Desk) -> None:
    """Nothing is read, and nothing put on record."""
    answer = parse(fetch(world, "HEAD", Range="bytes=5-9").value())
    assert (answer.status, answer.headers["content-length"], answer.body) == (200, str(END), b"")
    assert (answer.headers["accept-ranges"], answer.headers["etag"]) == ("bytes", '"a"')
    assert (desk.file.asked, desk.file.begun, desk.file.open) == ([], 0, False)


def test_a_file_that_may_not_begin_is_not_promised(world: World, desk: Desk) -> None:
    """The answer is an error in words, under no file's name."""
    desk.file.busy = True
    answer = received(world, desk.file)
    assert (answer.status, answer.json["detail"]) == (503, "too much at once")
    assert "content-disposition" not in answer.headers
    assert not desk.file.open
