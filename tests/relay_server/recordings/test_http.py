"""``/api/v1/robots/<robot>/recordings`` on transports in memory."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from twisted.internet.defer import Deferred

from relay_protocol.errors import NotFound, Refused, Unavailable
from relay_server.access import Principal
from relay_server.http import download
from relay_server.http.idempotency import Idempotency
from relay_server.recordings import http as module
from relay_server.recordings.recordings import RecordingRequest
from tests.worlds.http_client import HOST, Answer, Transport, World, parse

HERE = "/api/v1/robots/rover/recordings"
ANN = {"Authorization": "Bearer ann"}
CONTENT = bytes(range(256)) * 4096


class File:
    """A file whose parts the test returns on request."""

    name = "rover-a.mcap"
    tag = "a"

    def __init__(self, size: int = len(CONTENT)) -> None:
        self.size = size
        self.open = True
        self.begun = 0
        self.busy = False
        self.permit: Any = SimpleNamespace()
        self.may_go_on = True
        self.asked: list[tuple[int, int, Deferred[bytes]]] = []

    async def begin(self) -> None:
        """Begins the download."""
        if self.busy:
            raise Unavailable("too much at once")
        self.begun += 1

    def allowed(self) -> bool:
        """Whether the download may continue."""
        return self.may_go_on

    async def part(self, offset: int, size: int) -> bytes:
        """Waits for the test."""
        part: Deferred[bytes] = Deferred()
        self.asked.append((offset, size, part))
        return await part

    def close(self) -> None:
        """Must be called once."""
        assert self.open
        self.open = False

    def gives(self) -> None:
        """Returns the requested part."""
        offset, size, part = self.asked.pop()
        part.callback(CONTENT[offset : offset + size])


class FakeRecordings:
    """Records calls; one recording exists."""

    def __init__(self) -> None:
        self.asks: list[RecordingRequest] = []
        self.deleted: list[str] = []
        self.pages: list[tuple[int, str]] = []
        self.file = File()

    async def start(
        self, principal: Principal, robot: str, ask: RecordingRequest, address: str
    ) -> dict[str, Any]:
        """Starts a recording."""
        assert (principal.name, robot, address) == ("ann", "rover", "192.0.2.9")
        self.asks.append(ask)
        return {"id": "a"}

    async def may_start(self, principal: Principal, robot: str, ask: RecordingRequest, address: str) -> None:
        """Always allowed."""

    async def possible(self, principal: Principal, robot: str, address: str) -> dict[str, Any]:
        """One topic."""
        return {"topics": ["/odom"]}

    async def all(
        self, principal: Principal, robot: str, address: str, limit: int, before: str
    ) -> dict[str, Any]:
        """The only recording."""
        self.pages.append((limit, before))
        return {"recordings": [await self.one(principal, robot, "a", address)], "next": None}

    async def one(self, principal: Principal, robot: str, id: str, address: str) -> dict[str, Any]:
        """The only recording."""
        if id != "a":
            raise NotFound("there is no such recording")
        return {"id": id}

    async def stop(self, principal: Principal, robot: str, id: str, address: str) -> dict[str, Any]:
        """Stops it."""
        return {"id": id, "state": "complete"}

    async def delete(self, principal: Principal, robot: str, id: str, address: str) -> None:
        """Deletes it."""
        self.deleted.append(id)

    async def download(self, principal: Principal, robot: str, id: str, address: str) -> File:
        """Its file."""
        return self.file


@pytest.fixture
def fake() -> FakeRecordings:
    """The fake recording service."""
    return FakeRecordings()


@pytest.fixture
def world(tmp_path: Path, fake: FakeRecordings) -> World:
    """A site with recordings."""
    made = World(tmp_path)
    made.router.add(module.RecordingEndpoints(made.clock, cast(Any, fake), Idempotency(made.clock)))
    return made


def fetch(world: World, method: str = "GET", **headers: str) -> Transport:
    """A client starts a download; head and content follow later."""
    transport = world.connect()
    head = f"{method} {HERE}/a/file HTTP/1.1\r\nHost: {HOST}\r\nAuthorization: Bearer ann\r\n"
    head += "".join(f"{name.replace('_', '-')}: {value}\r\n" for name, value in headers.items())
    world.send(transport, f"{head}\r\n".encode())
    return transport


def received(world: World, file: File, **headers: str) -> Answer:
    """The answer to a client that reads everything."""
    transport = fetch(world, **headers)
    while file.asked:
        file.gives()
    return parse(transport.value())


def test_address_has_one_purpose(world: World, fake: FakeRecordings) -> None:
    """With and without a trailing slash at the first."""
    assert world.ask("GET", HERE, **ANN).json == {"recordings": [{"id": "a"}], "next": None}
    answer = world.ask("POST", HERE, {"topics": ["/odom"], "seconds": 5}, **ANN)
    assert (answer.status, answer.headers["location"]) == (201, f"{HERE}/a")
    assert fake.asks == [RecordingRequest(topics=["/odom"], seconds=5.0)]
    assert world.ask("GET", f"{HERE}/a", **ANN).json == {"id": "a"}
    assert world.ask("GET", f"{HERE}/new", **ANN).json == {"topics": ["/odom"]}
    again = {"Idempotency-Key": "k", **ANN}
    reported = [world.ask("POST", HERE, {"topics": ["/odom"]}, **again) for _ in "ab"]
    assert len({(each.status, each.headers["location"], each.body) for each in reported}) == 1
    assert len(fake.asks) == 2
    assert world.ask("POST", f"{HERE}/a/stop", **ANN).json["state"] == "complete"
    assert world.ask("DELETE", f"{HERE}/a", **ANN).status == 204
    assert fake.deleted == ["a"]


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
def test_missing_resource_is_problem_details(world: World, method: str, path: str, status: int) -> None:
    """This includes addresses without a recording."""
    answer = world.ask(method, path, **ANN)
    assert (answer.status, answer.headers["content-type"]) == (status, "application/problem+json")


@pytest.mark.parametrize(
    "body", [{"topics": "/odom"}, {"seconds": 0}, {"megabytes": 1e9}, {"topics": ["/a"] * 65}, {"topic": []}]
)
def test_an_ask_beyond_the_bounds_is_refused(
    world: World, fake: FakeRecordings, body: dict[str, Any]
) -> None:
    """Before the service is called; an unknown parameter may be a mistake."""
    assert world.ask("POST", HERE, body, **ANN).status == 400
    assert fake.asks == []


def test_the_list_comes_in_pages(world: World, fake: FakeRecordings) -> None:
    """The default is 100; out of range sizes are refused."""
    for asked in ("", "?limit=500", "?limit=1&before=17.5_a", "?before=17.5_a"):
        assert world.ask("GET", HERE + asked, **ANN).status == 200
    assert fake.pages == [(100, ""), (500, ""), (1, "17.5_a"), (100, "17.5_a")]
    for wrong in ("0", "501", "-1", "many", "9" * 20, "%C2%B2"):
        answer = world.ask("GET", f"{HERE}?limit={wrong}", **ANN)
        assert answer.status == 400 and answer.json["detail"].startswith("'limit' ")
    assert len(fake.pages) == 4


def test_no_request_without_a_credential(world: World, fake: FakeRecordings) -> None:
    """A cookie from another page's origin does not count."""
    assert world.ask("GET", HERE).status == 401
    cookie = {"Cookie": "sb=ann", "Origin": "http://evil.example"}
    assert world.ask("POST", HERE, {"topics": ["/odom"]}, **cookie).status == 403
    assert world.ask("DELETE", f"{HERE}/a", **cookie).status == 403


def test_a_file_comes_in_parts(world: World, fake: FakeRecordings) -> None:
    """It has a file name, and is read only as fast as the client reads."""
    transport = fetch(world)
    while fake.file.asked:
        assert fake.file.asked[0][1] <= download.PART_BYTES
        fake.file.gives()
    answer = parse(transport.value())
    assert (answer.status, answer.headers["accept-ranges"], answer.headers["etag"]) == (200, "bytes", '"a"')
    assert answer.headers["content-disposition"] == 'attachment; filename="rover-a.mcap"'
    assert answer.headers["content-length"] == str(len(CONTENT))
    assert answer.body == CONTENT
    assert not fake.file.open


def test_stalled_download_is_cut_after_a_while(world: World, fake: FakeRecordings) -> None:
    """No part is read meanwhile."""
    transport = fetch(world)
    transport.producer.pauseProducing()
    fake.file.gives()
    assert fake.file.asked == []
    transport.producer.resumeProducing()
    assert len(fake.file.asked) == 1
    transport.producer.pauseProducing()
    fake.file.gives()
    world.clock.advance(download.STALL_SECONDS)
    assert not transport.connected
    assert not fake.file.open


@pytest.mark.parametrize(
    "error", [OSError("it was deleted"), Unavailable("too much at once"), KeyError("surprise")], ids=repr
)
@pytest.mark.parametrize("parts", [0, 1])
def test_folder_contains_only_the_file(
    world: World, fake: FakeRecordings, error: Exception, parts: int
) -> None:
    """A failure after the head adds no text to the file."""
    transport = fetch(world)
    for _ in range(parts):
        fake.file.gives()
    fake.file.asked.pop()[2].errback(error)
    assert not transport.connected
    assert not fake.file.open
    body = transport.value().partition(b"\r\n\r\n")[2]
    assert body == CONTENT[: parts * download.PART_BYTES]


@pytest.mark.parametrize("how", ["revoked", "denied", "gone"])
def test_a_file_that_may_or_can_not_be_sent_on_breaks_off(
    world: World, fake: FakeRecordings, how: str
) -> None:
    """The client sees that the file is incomplete."""
    transport = fetch(world)
    fake.file.gives()
    if how == "revoked":
        fake.file.permit.on_revoke(Refused("your right was revoked"))
    elif how == "denied":
        fake.file.permit.on_change()
        assert transport.connected
        fake.file.may_go_on = False
        fake.file.permit.on_change()
    else:
        fake.file.asked.pop()[2].errback(OSError("it was deleted"))
    assert not transport.connected
    assert not fake.file.open
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
def test_a_part_of_a_file(world: World, fake: FakeRecordings, asked: str, start: int, stop: int) -> None:
    """RFC 9110 section 14: from the beginning, the end, or between."""
    answer = received(world, fake.file, Range=asked)
    assert (answer.status, answer.headers["content-range"]) == (206, f"bytes {start}-{stop - 1}/{END}")
    assert answer.headers["content-length"] == str(stop - start)
    assert answer.body == CONTENT[start:stop]
    assert fake.file.begun == 1


@pytest.mark.parametrize(
    "asked", ["bytes=0-1,5-6", "lines=1-2", "bytes=9-5", "bytes=x-", "bytes", "bytes=-0"]
)
def test_a_range_that_is_not_understood_is_passed_over(
    world: World, fake: FakeRecordings, asked: str
) -> None:
    """The whole file is sent."""
    answer = received(world, fake.file, Range=asked)
    assert (answer.status, answer.body) == (200, CONTENT)


def test_a_file_has_nothing_behind_its_end(world: World, fake: FakeRecordings) -> None:
    """The answer states its length; no data is sent, so it is not audited."""
    answer = received(world, fake.file, Range=f"bytes={END}-")
    assert (answer.status, answer.headers["content-range"]) == (416, f"bytes */{END}")
    assert answer.headers["content-type"] == "application/problem+json"
    assert (fake.file.begun, fake.file.open) == (0, False)


@pytest.mark.parametrize(
    ("tag", "status"), [('"a"', 206), ('"b"', 200), ('W/"a"', 200), ("Sat, 21 Nov 2026 19:00:00 GMT", 200)]
)
def test_only_the_same_file_is_gone_on_with(
    world: World, fake: FakeRecordings, tag: str, status: int
) -> None:
    """Otherwise the whole file is sent; a weak tag or a date does not count (section 13.1.5)."""
    answer = received(world, fake.file, Range="bytes=10-", If_Range=tag)
    assert (answer.status, answer.body) == (status, CONTENT[10:] if status == 206 else CONTENT)


def test_head_has_the_headers_of_get(world: World, fake: FakeRecordings) -> None:
    """No part is read, and it is not audited."""
    answer = parse(fetch(world, "HEAD", Range="bytes=5-9").value())
    assert (answer.status, answer.headers["content-length"], answer.body) == (200, str(END), b"")
    assert (answer.headers["accept-ranges"], answer.headers["etag"]) == ("bytes", '"a"')
    assert (fake.file.asked, fake.file.begun, fake.file.open) == ([], 0, False)


def test_a_file_that_may_not_begin_is_not_promised(world: World, fake: FakeRecordings) -> None:
    """The answer is an error without a file name."""
    fake.file.busy = True
    answer = received(world, fake.file)
    assert (answer.status, answer.json["detail"]) == (503, "too much at once")
    assert "content-disposition" not in answer.headers
    assert not fake.file.open
