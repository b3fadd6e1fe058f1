"""The head of a request: each field is bounded before it is parsed, and an invalid head gets an error."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.worlds.http_client import Answer, World, parse

POST = b"POST /api/v1/session HTTP/1.1\r\nConnection: close\r\n"
UPGRADE = (
    b"GET /api/v1/robots/stream HTTP/1.1\r\nHost: x\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n"
)


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A site."""
    return World(tmp_path)


def answer(world: World, data: bytes) -> Answer:
    """The site's answer to these bytes; there must be one."""
    transport = world.connect()
    world.send(transport, data)
    world.clock.advance(0)
    return parse(transport.value())


def with_field(name: bytes, value: bytes) -> bytes:
    """A request with a body and this field."""
    return POST + name + b": " + value + b"\r\nContent-Length: 2\r\n\r\n{}"


@pytest.mark.parametrize(
    ("name", "most"),
    [
        (b"Accept", 1024),
        (b"Authorization", 4096),
        (b"Content-Type", 256),
        (b"Cookie", 8192),
        (b"Host", 300),
        (b"If-None-Match", 1024),
        (b"Origin", 300),
        (b"Prefer", 256),
        (b"Range", 256),
        (b"Sec-WebSocket-Protocol", 1024),
        (b"X-Unknown", 8192),
    ],
)
def test_a_field_has_a_longest_length(world: World, name: bytes, most: int) -> None:
    """The figures of SPEC 5, on one line and on several."""
    assert answer(world, with_field(name, b"a" * most)).status != 431
    too_long = answer(world, with_field(name, b"a" * (most + 1)))
    assert too_long.status == 431
    assert f"'{name.decode()}' may have at most {most} bytes" in too_long.json["detail"]
    half = b"a" * (most // 2 + 1)
    assert answer(world, with_field(name, half + b"\r\n" + name + b": " + half)).status == 431


def test_path_and_query_have_a_longest_length(world: World) -> None:
    head = b" HTTP/1.1\r\nHost: x\r\n\r\n"
    assert answer(world, b"GET /robots/" + b"a" * 8184 + head).status == 200
    assert answer(world, b"GET /robots/" + b"a" * 8185 + head).status == 414
    assert answer(world, b"GET /robots/a?" + b"a" * 8183 + head).status == 414


def test_a_head_has_a_longest_length_and_most_fields(world: World) -> None:
    """16 KiB, 100 fields, names of 256 bytes."""
    assert answer(world, POST + b"X: " + b"a" * 20_000 + b"\r\n").status == 431
    assert answer(world, POST + b"x" * 257 + b": a\r\n\r\n").status == 431
    many = b"".join(b"X-%d: a\r\n" % number for number in range(101))
    assert answer(world, POST + many + b"\r\n").status == 400


@pytest.mark.parametrize("control", [0x00, 0x01, 0x0B, 0x0C, 0x1C, 0x1D, 0x1E, 0x7F])
def test_control_characters_in_a_field_are_refused(world: World, control: int) -> None:
    """Some parsers take them for line breaks."""
    refused = answer(world, with_field(b"Content-Type", b"a" + bytes([control]) + b"b"))
    assert refused.status == 400
    assert "control characters" in refused.json["detail"]


@pytest.mark.parametrize(
    "value",
    [
        b"a\x85b",
        "ä\u0085\u2028".encode(),
        b"(" * 200,
        b"a; boundary*=idna''%00x",
        b"multipart/form-data",
        b"a/b;" * 60,
    ],
)
def test_an_invalid_content_type_gets_an_answer(world: World, value: bytes) -> None:
    """Only the handler reads it."""
    refused = answer(world, with_field(b"Content-Type", value))
    assert refused.status == 400
    assert "application/json" in refused.json["detail"]


@pytest.mark.parametrize(
    "lines",
    [
        b"Content-Length: 99999999999999999999999999\r\n\r\n",
        b"Content-Length: " + b"9" * 5000 + b"\r\n\r\n",
        b"Content-Length: 2\r\nContent-Length: 3\r\n\r\n",
        b"Content-Length: -1\r\n\r\n",
        b"Transfer-Encoding: chunked\r\n\r\n" + b"f" * 2000 + b"\r\n",
        b"Transfer-Encoding: chunked\r\n\r\nxyz\r\n",
        b"Transfer-Encoding: chunked\r\nContent-Length: 2\r\n\r\n",
        b"X: a\r\n continued\r\n\r\n",
        b" X: a\r\n\r\n",
        b"no colon\r\n\r\n",
        b"na\xc3\xa4me: a\r\n\r\n",
        b"Host: \xff\xfe\r\n\r\n",
        b"Host: ]::[:::99999999\r\n\r\n",
    ],
)
def test_an_invalid_head_gets_a_400(world: World, lines: bytes) -> None:
    """The connection is closed, but never without an answer."""
    assert 400 <= answer(world, POST + lines).status < 500


def test_a_body_of_one_byte_chunks_is_refused(world: World) -> None:
    """Each chunk costs as much as a large one."""
    body = b"1\r\nx\r\n" * 5000 + b"0\r\n\r\n"
    refused = answer(world, POST + b"Transfer-Encoding: chunked\r\n\r\n" + body)
    assert refused.status == 413
    assert "chunks" in refused.json["detail"]


def test_a_value_in_a_handshake_does_not_become_a_field_of_its_own(world: World) -> None:
    """0x85 is a part of letters in UTF-8, and a line break to ``str.splitlines``."""
    transport = world.connect()
    world.send(transport, UPGRADE + b"User-Agent: x\xc2\x85Authorization: Bearer wrong\r\n\r\n")
    world.clock.advance(0)
    assert parse(transport.value()).status == 101


def test_an_invalid_handshake_gets_an_answer(world: World) -> None:
    """From Autobahn."""
    for line in (b"Sec-WebSocket-Key: x", b"Origin: x", b"Sec-WebSocket-Protocol: a,a"):
        answered = answer(world, UPGRADE + line + b"\r\n\r\n")
        assert answered.status == 400


@pytest.mark.parametrize("method", [b"GET", b"HEAD"])
@pytest.mark.parametrize("path", [b"/\xe4", b"/api/v1/robots/\xc3\xa4?\xff", b"/robots/\x85"])
def test_a_target_beyond_ascii_is_refused_without_a_traceback(
    world: World, method: bytes, path: bytes
) -> None:
    refused = answer(world, method + b" " + path + b" HTTP/1.1\r\nHost: x\r\n\r\n")
    assert refused.status == 400


ABOUT = b'"product":"switchboard"'


@pytest.mark.parametrize(
    ("target", "status"),
    [
        (b"http://127.0.0.1:9090/robots/rover", 200),
        (b"HTTPS://relay.example.org/robots/rover", 200),
        (b"http://relay/healthz?x", 200),
        (b"http://relay", 503),  # the portal, which is not built
        (b"http://relay?x", 503),
        (b"http://ann@relay/robots/rover", 400),
        (b"http:///robots/rover", 400),
        (b"http://relay/robots/rover#a", 400),
        (b"ftp://relay/robots/rover", 400),
        (b"http://" + b"a" * 400 + b"/robots/rover", 431),
    ],
)
def test_a_target_in_absolute_form_is_read(world: World, target: bytes, status: int) -> None:
    answered = answer(world, b"GET " + target + b" HTTP/1.1\r\nHost: another\r\n\r\n")
    assert answered.status == status
    if b"rover" in target:
        assert (ABOUT in answered.body) == (status == 200)


def test_the_host_of_a_target_in_absolute_form_counts_for_an_origin(world: World) -> None:
    """An address of the relay is its own origin; a name in the field ``Host`` does not make it another one."""
    head = b" HTTP/1.1\r\nHost: %b\r\nOrigin: http://127.0.0.1:9090\r\nContent-Type: application/json\r\n"
    body = b'{"user":"ann","password":"correct horse"}'
    rest = b"Content-Length: %d\r\n\r\n%b" % (len(body), body)
    session = b"/api/v1/session"
    assert answer(world, b"POST http://127.0.0.1:9090" + session + head % b"relay" + rest).status == 200
    assert answer(world, b"POST http://relay" + session + head % b"127.0.0.1:9090" + rest).status == 403


def test_a_handshake_in_absolute_form_opens_a_websocket(world: World) -> None:
    whole = UPGRADE.replace(b"GET /", b"GET http://relay/")
    assert answer(world, whole + b"\r\n").status == 101


@pytest.mark.parametrize("line", [b"CONNECT relay:9090", b"GET robots/rover", b"GET *"])
def test_other_forms_of_a_target_get_an_answer(world: World, line: bytes) -> None:
    assert 400 <= answer(world, line + b" HTTP/1.1\r\nHost: x\r\n\r\n").status < 500
