"""The HTTP site: deadlines, limits, headers, the portal's files."""

from __future__ import annotations

import gzip
import random
from email.utils import parsedate_to_datetime
from pathlib import Path

import pytest
from twisted.logger import capturedLogs

from relay_protocol import limits
from relay_server.http import site as module
from tests.worlds.http_client import Answer, World, parse

GET = b"GET /healthz HTTP/1.1\r\nHost: x\r\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A built portal, and a file beside it that must not be served."""
    portal = tmp_path / "portal"
    (portal / "assets").mkdir(parents=True)
    (portal / "index.html").write_text("<!doctype html>")
    (portal / "assets" / "app-1234.js").write_text("let a")
    (portal / "icon.svg").write_text("<svg/>")
    (tmp_path / "secret").write_text("secret")
    (portal / "link").symlink_to(tmp_path / "secret")
    return portal


@pytest.fixture
def world(folder: Path) -> World:
    """A site with a portal."""
    return World(folder)


def reported(answer: Answer, status: int) -> None:
    """An error is problem details (RFC 9457)."""
    assert (answer.status, answer.json["status"]) == (status, status)
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json["title"]
    assert answer.json["detail"]


@pytest.mark.parametrize("sent", [b"", GET, GET + b"Content-Length: 10\r\n\r\nx"])
def test_a_request_that_trickles_is_cut_by_an_absolute_deadline(world: World, sent: bytes) -> None:
    """Further bytes of head or body do not extend it."""
    transport = world.connect()
    world.send(transport, sent)
    for _ in range(5):
        world.clock.advance(limits.UNAUTHENTICATED_SECONDS / 5 - 0.01)
        if sent and not sent.endswith(b"x"):
            world.send(transport, b"X: y\r\n")
    assert transport.connected
    world.clock.advance(0.1)
    assert not transport.connected
    reported(parse(transport.value()), 408)
    assert not world.cap._counts


def test_a_kept_connection_is_dropped_when_it_idles(world: World) -> None:
    """Its next request has an absolute deadline of its own."""
    transport = world.connect()
    world.send(
        transport,
        b"GET /api/v1/session HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer ann\r\n\r\n" + GET + b"\r\n",
    )
    world.clock.advance(0)
    world.clock.advance(module.IDLE_SECONDS - 1)
    assert transport.connected
    world.send(transport, b"GET /healthz HTTP/1.1\r\nHo")
    world.clock.advance(1.1)
    assert not transport.connected
    assert not world.cap._counts


def test_an_unauthenticated_connection_has_10_s_for_each_request(world: World) -> None:
    transport = world.connect()
    for _ in range(3):
        world.send(transport, GET + b"\r\n")
        world.clock.advance(0)
        world.clock.advance(limits.UNAUTHENTICATED_SECONDS - 0.1)
        assert transport.connected
    world.clock.advance(0.2)
    assert not transport.connected
    assert not world.cap._counts


@pytest.mark.parametrize("chunked", [False, True])
def test_a_body_that_is_too_large_is_refused(world: World, chunked: bool) -> None:
    """With a length before it is read; in chunks when it exceeds the limit."""
    transport = world.connect()
    head = b"POST /api/v1/session HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n"
    if chunked:
        world.send(transport, head + b"Transfer-Encoding: chunked\r\n\r\n")
        for _ in range(limits.HTTP_BODY // 4096 + 1):
            world.send(transport, b"1000\r\n" + b"x" * 4096 + b"\r\n")
    else:
        world.send(transport, head + b"Content-Length: %d\r\n\r\n" % (limits.HTTP_BODY + 1))
    reported(parse(transport.value()), 413)
    assert not transport.connected


def test_too_many_connections_of_one_address_are_refused(world: World) -> None:
    """With 429, without reading their requests. Closed connections free their places."""
    kept = [world.connect() for _ in range(4)]
    refused = world.connect()
    reported(parse(refused.value()), 429)
    assert not refused.connected
    kept[0].loseConnection()
    assert world.ask("GET", "/healthz").status == 200
    for each in kept[1:]:
        each.loseConnection()
    assert not world.cap._counts


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/", 200),
        ("/nothing", 404),
        ("/api/v1/session", 401),
        ("/api/none", 404),
        ("/robots/rover", 200),
        ("/healthz", 200),
    ],
)
@pytest.mark.parametrize("tls", [False, True])
def test_every_answer_carries_the_security_headers(folder: Path, path: str, status: int, tls: bool) -> None:
    """Pages, API, errors; with TLS also Strict-Transport-Security."""
    answer = World(folder, tls).ask("GET", path)
    assert answer.status == status
    for name, value in module.SECURITY_HEADERS.items():
        assert answer.headers[name.decode()] == value.decode()
    assert answer.headers["server"] == "switchboard"
    assert ("strict-transport-security" in answer.headers) is tls


@pytest.mark.parametrize(
    "path",
    [
        "/../secret",
        "/..%2fsecret",
        "/%2e%2e/secret",
        "/assets/../../secret",
        "/assets/%2e%2e/%2e%2e/secret",
        "/%2fetc/passwd",
        "/link",
        "/assets",
        "/assets/",
        "/a%00b",
        "/%ff%fe",
        "/..\\secret",
    ],
)
def test_only_the_portal_is_served(world: World, path: str) -> None:
    """Whatever the path, symbolic links included."""
    answer = world.ask("GET", path)
    assert answer.status == 404
    assert b"secret" not in answer.body.replace(path.encode(), b"")


def test_the_portals_page_is_served_for_the_addresses_it_routes(world: World) -> None:
    """Browsers may store files with a hash in their names, but not the page."""
    for path in ("/", "/login", "/fleet", "/cockpit/rover"):
        page = world.ask("GET", path)
        assert (page.status, page.body, page.headers["cache-control"]) == (
            200,
            b"<!doctype html>",
            "no-cache",
        )
        assert page.headers["content-type"] == "text/html; charset=utf-8"
    asset = world.ask("GET", "/assets/app-1234.js")
    assert "immutable" in asset.headers["cache-control"]
    assert world.ask("GET", "/icon.svg").headers["content-type"] == "image/svg+xml"
    assert world.ask("HEAD", "/").body == b""


def test_a_missing_portal_is_an_error_with_advice(tmp_path: Path) -> None:
    answer = World(tmp_path / "none").ask("GET", "/")
    assert (answer.status, answer.json["detail"]) == (
        503,
        "The portal is not built; run 'make web' and start the relay again.",
    )


def test_a_plain_get_of_a_robot_describes_the_server(world: World) -> None:
    """Addresses below it do not exist."""
    about = world.ask("GET", "/robots/rover").json
    assert (about["product"], about["version"], about["protocol"]) == ("switchboard", "1.2.3", "rosbridge v2")
    assert world.ask("GET", "/robots/rover/").json == about
    assert world.ask("GET", "/robots/rover/more").status == 404
    assert world.ask("GET", "/robots/rover//").status == 404


@pytest.mark.parametrize(
    "data",
    [b"\x16\x03\x01\x02\x00", b"GET\r\n\r\n", b"\x00" * 100, b"GET / HTTP/9.9\r\n\r\n", b"A" * 100_000],
)
def test_bytes_that_are_no_http_do_no_harm(world: World, data: bytes) -> None:
    """The connection ends at the deadline at the latest, and frees its place."""
    transport = world.connect()
    world.send(transport, data)
    world.clock.pump([limits.UNAUTHENTICATED_SECONDS, module.IDLE_SECONDS])
    assert not transport.connected
    assert not world.cap._counts


@pytest.mark.parametrize("header", ["Authorization", "Cookie", "Origin", "Accept", "Content-Type"])
def test_a_header_that_is_no_text_is_no_failure_of_the_relay(world: World, header: str) -> None:
    """Bytes that are not UTF-8 are replaced."""
    transport = world.connect()
    head = f"GET /api/v1/session HTTP/1.1\r\nHost: x\r\n{header}: Bearer ".encode()
    world.send(transport, head + b"\xff\xfe\r\n\r\n")
    assert parse(transport.value()).status in (401, 403)


@pytest.mark.parametrize("host", ["a" * 64 + ".example", "a..b", "x" * 300])
def test_an_invalid_host_is_an_error_of_the_sender(world: World, host: str) -> None:
    reported(world.ask("GET", "/api/v1/session", Host=host), 400)


@pytest.mark.parametrize("path", ["/api/v1/robots/%ff", "/api/%ff", "/healthz/%ff"])
def test_an_address_that_is_not_utf8_is_an_error(world: World, path: str) -> None:
    reported(world.ask("GET", path), 400)


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "BREW"])
@pytest.mark.parametrize("path", ["/", "/robots/rover", "/icon.svg"])
def test_read_only_addresses_support_get_only(world: World, method: str, path: str) -> None:
    answer = world.ask(method, path)
    reported(answer, 405)
    assert answer.headers["allow"] == "GET, HEAD"


def test_an_unsupported_method_of_the_api_gets_405_with_the_supported_ones(world: World) -> None:
    answer = world.ask("PATCH", "/api/v1/session")
    reported(answer, 405)
    assert answer.headers["allow"] == "DELETE, GET, HEAD, POST"


def test_bytes_that_are_no_request_get_a_400(world: World) -> None:
    """The connection is closed."""
    transport = world.connect()
    world.send(transport, b"what is this\r\n\r\n")
    reported(parse(transport.value()), 400)
    assert not transport.connected


@pytest.mark.parametrize("path", ["/api/v1//session", "/api//v1/session", "/api/v1/%2Fsession"])
def test_additional_slashes_are_ignored(world: World, path: str) -> None:
    """Names of ROS begin with one, which may be escaped. There is no redirect."""
    assert world.ask("GET", path, Authorization="Bearer ann").json["user"] == "ann"


ENCODINGS = {
    "gzip": "gzip",
    "deflate, gzip;q=1.0, *;q=0.5": "gzip",
    "*": "gzip",
    "GZIP": "gzip",
    "gzip;q=0.5, identity;q=0.5": "gzip",
    "gzip;q=0": None,
    "gzip;q=0.000, *": None,
    "gzip;q=0.3, identity;q=0.5": None,
    "br, zstd": None,
    "*;q=0": None,
    "identity": None,
    "": None,
    "gzip" + ", br" * 100: None,
    "gzip;q=nan": None,
}


@pytest.mark.parametrize(("accept", "encoding"), ENCODINGS.items())
def test_files_are_compressed_for_clients_that_prefer_it(
    folder: Path, accept: str, encoding: str | None
) -> None:
    """RFC 9110 section 12.5.3. Caches are informed by ``Vary``, and the entity tags differ."""
    text = b"let a = 1;\n" * 1000
    (folder / "assets" / "large-1.js").write_bytes(text)
    world = World(folder)
    answer = world.ask("GET", "/assets/large-1.js", Accept_Encoding=accept)
    assert (answer.status, answer.headers.get("content-encoding")) == (200, encoding)
    assert (gzip.decompress(answer.body) if encoding else answer.body) == text
    assert answer.headers["content-length"] == str(len(answer.body))
    assert answer.headers["vary"] == "accept-encoding"
    plain = world.ask("GET", "/assets/large-1.js")
    assert (plain.headers["etag"] == answer.headers["etag"]) is (encoding is None)
    for headers in ({"Accept_Encoding": accept}, {}):
        known = world.ask("GET", "/assets/large-1.js", If_None_Match=answer.headers["etag"], **headers)
        assert (known.status, known.body) == (304, b"")
        assert {"etag", "vary", "cache-control"} <= set(known.headers)


def test_images_and_small_files_are_not_compressed(folder: Path) -> None:
    noise = random.Random(1).randbytes(5000)
    (folder / "assets" / "noise-1.png").write_bytes(noise)
    for path in ("/assets/noise-1.png", "/icon.svg"):
        answer = World(folder).ask("GET", path, Accept_Encoding="gzip")
        assert "content-encoding" not in answer.headers
        assert "vary" not in answer.headers


def test_portal_files_are_those_of_the_start(folder: Path) -> None:
    """No request reaches the disk."""
    world = World(folder)
    (folder / "later.js").write_text("let b")
    assert world.ask("GET", "/later.js").status == 404
    assert world.ask("GET", "/assets/" + "a" * 300).status == 404
    (folder / "icon.svg").unlink()
    assert world.ask("GET", "/icon.svg").status == 200


def test_requests_for_the_portal_are_counted(folder: Path) -> None:
    """Over the limit of their network they get 429."""
    world = World(folder, rate=0.1)
    assert world.ask("GET", "/icon.svg").status == 200
    for path in ("/icon.svg", "/", "/nothing"):
        answer = world.ask("GET", path)
        reported(answer, 429)
        assert int(answer.headers["retry-after"]) > 0


def fails(*_: object) -> None:
    """A bug."""
    raise KeyError("the secret of our insides")


@pytest.mark.parametrize(
    ("place", "status"),
    [
        ("relay_server.http.request_fields.check_field", 500),
        ("relay_server.http.request_fields.check_fields", 500),
        ("twisted.web.server.datetimeToString", 500),
        ("twisted.web.http.Request.parseCookies", 400),
        ("twisted.web.http.parse_qs", 400),
    ],
)
def test_errors_of_the_relay_are_logged_with_their_traceback(
    world: World, monkeypatch: pytest.MonkeyPatch, place: str, status: int
) -> None:
    """And answered with 500; those of parsers are the sender's, and one line."""
    monkeypatch.setattr(place, fails)
    transport = world.connect()
    with capturedLogs() as logs:
        world.send(transport, b"GET /healthz?a=b HTTP/1.1\r\nHost: x\r\n\r\n")
    reported(parse(transport.value()), status)
    assert b"insides" not in transport.value()
    assert any("log_failure" in each for each in logs) is (status == 500)


def test_each_answer_has_the_relays_time(world: World) -> None:
    """The portal shows times by it, also those of errors (RFC 9110 section 6.6.1)."""
    for path in ("/api/v1/robots", "/healthz"):
        assert parsedate_to_datetime(world.ask("GET", path).headers["date"]).timestamp() > 0
