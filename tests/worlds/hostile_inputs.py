"""Inputs that are slow or invalid for parsers, from unauthenticated clients and robots, and their cost.

Each input is made at full size or at a part of it, so that its cost can be compared with that of half of it.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import random
import re
import socket
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote_from_bytes

from relay_protocol import limits
from relay_server.http.openapi.http import operations
from relay_server.http.openapi.operation import Credential
from tests.worlds.waiting import PATIENCE

HEAD = 15_000
"""Bytes of one field for which a head has room, with what else must be in it."""

BODY = limits.HTTP_BODY - 1000
"""Bytes of a body that is nearly as large as the relay takes."""

FIELDS = {
    "Accept": 1024,
    "Accept-Encoding": 1024,
    "Accept-Language": 1024,
    "Authorization": 4096,
    "Connection": 256,
    "Content-Range": 256,
    "Content-Type": 256,
    "Cookie": 8192,
    "Expect": 64,
    "Host": 300,
    "Idempotency-Key": 1024,
    "If-Match": 1024,
    "If-None-Match": 1024,
    "If-Range": 256,
    "Last-Event-ID": 256,
    "Origin": 300,
    "Prefer": 256,
    "Range": 256,
    "Sec-WebSocket-Extensions": 512,
    "Sec-WebSocket-Key": 64,
    "Sec-WebSocket-Protocol": 1024,
    "Sec-WebSocket-Version": 16,
    "Switchboard-Freshness": 8192,
    "Upgrade": 64,
    "User-Agent": 8192,
    "X-Forwarded-For": 8192,
}
"""Fields of a head, and the most bytes the relay takes of each (SPEC 5)."""


def _all(unit: str, before: str = "", after: str = "") -> Callable[[int], bytes]:
    def made(size: int) -> bytes:
        edge = len((before + after).encode())
        piece = unit.encode()
        return before.encode() + piece * max(0, (size - edge) // len(piece)) + after.encode()

    return made


SHAPES: dict[str, Callable[[int], bytes]] = {
    "equals signs and a quotation mark": _all("=", "a", '"'),
    "combining marks": _all("\u0316\u0300", "a"),
    "marks in the wrong order": _all("\u0300\u0316", "a"),
    "ligatures": _all("\ufdfa"),
    "jamo": _all("\u1100\u1161\u11a8"),
    "comments": _all("(a)"),
    "nested comments": _all("("),
    "tabs": _all("\t", "a", "b"),
    "tabs before a comma": _all("\t,", "a"),
    "spaces": _all(" ", "a;", "b"),
    "commas": _all(","),
    "quotation marks": _all('"'),
    "backslashes in quotes": _all("\\", '"'),
    "quoted pairs": _all('\\"', 'a="'),
    "many media types": _all("a/b;q=1,"),
    "many parameters": _all(";a=b", "a/b"),
    "a boundary that is none": _all("; boundary*=idna''%00", "multipart/form-data"),
    "parameters in parts": _all(';a*0*="', "a/b"),
    "entity tags": _all('W/"a" , '),
    "open entity tags": _all('W/"'),
    "percent signs": _all("%"),
    "escapes of escapes": _all("%25"),
    "escaped zeros": _all("%00"),
    "digits": _all("9"),
    "ranges": _all("1-2,", "bytes="),
    "colons": _all(":"),
    "brackets": _all("["),
    "dots": _all("../"),
    "slashes": _all("/"),
    "at signs": _all("a@"),
    "wildcards": _all("*a"),
    "classes of characters": _all("[!a-"),
    "line breaks of Unicode": _all("\x85\u2028\u2029", "a"),
    "half characters": lambda size: b"\xed\xa0\x80" * (size // 3),
    "no text": lambda size: b"\xff" * size,
    "punycode": _all("xn--", "", "a"),
    "Digest": _all('a="b",', "Digest "),
    "Basic": _all("YTph", "Basic "),
    "cookies": _all("a=b;"),
}

KEY = b"Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n"
UPGRADE = {
    "Upgrade": b"websocket",
    "Connection": b"Upgrade",
    "Sec-WebSocket-Key": b"MDEyMzQ1Njc4OWFiY2RlZg==",
    "Sec-WebSocket-Version": b"13",
}


@dataclass(frozen=True)
class Attack:
    """One input.

    :param robots: for the port for robots
    :param data: the bytes, of this part of full size; 1 is all
    :param waits: whether the relay ends the connection after any amount of answers
    :param in_turns: it is thousands of requests or frames; others are served between them
    """

    name: str
    data: Callable[[float], bytes]
    robots: bool = False
    waits: bool = False
    in_turns: bool = False


def request(method: str, path: bytes, fields: dict[str, bytes], body: bytes = b"") -> bytes:
    """A request as bytes; a field with this name is not sent otherwise."""
    lines = {"Host": b"127.0.0.1", "Connection": b"close"} | fields
    if body:
        lines["Content-Length"] = str(len(body)).encode()
    head = b"".join(name.encode() + b": " + value + b"\r\n" for name, value in lines.items())
    return method.encode() + b" " + path + b" HTTP/1.1\r\n" + head + b"\r\n" + body


def unproved() -> list[Attack]:
    """All inputs of unauthenticated clients."""
    return [*_fields(), *_paths(), *_described_places(), *_bodies(), *_framing(), *_websockets(), *_robots()]


# --- HTTP -------------------------------------------------------------------------------------------------

_JSON = {"Content-Type": b"application/json"}


class Entry(NamedTuple):
    """A request that any client can send."""

    method: str
    path: bytes
    fields: dict[str, bytes]
    body: bytes


WEBSOCKETS = {
    "ClientFactory": b"/robots/rover",
    "VideoFactory": b"/robots/rover/video/ws",
    "UpdatesFactory": b"/api/v1/robots/stream",
    "IcpiFactory": b"/icpi",
}
"""Paths of websockets, by the factories that answer there."""

FOXGLOVE = UPGRADE | {"Sec-WebSocket-Protocol": b"foxglove.sdk.v1"}
OPEN = (Credential.NONE, Credential.OAUTH_CLIENT, Credential.OAUTH_CLIENT_OR_USER, Credential.VIEWER)
"""Credentials of operations that read more of a request than a token."""


def entries() -> dict[str, Entry]:
    """A request of each operation that the relay describes."""
    found = {}
    for each in operations():
        fields = {"Content-Type": each.media[0].encode()} if each.body is not None else {}
        body = b"" if each.body is None else b"{}" if "json" in each.media[0] else b"grant_type=password"
        found[f"{each.method} {each.path}"] = Entry(each.method, _filled(each.path), fields, body)
    return found


def _filled(path: str) -> bytes:
    """A path with ``rover`` in place of each parameter."""
    return re.sub(r"\{[^}]*\}", "rover", path).encode()


def handshakes() -> dict[str, Entry]:
    """A handshake of each websocket and dialect."""
    found = {
        f"a handshake at {path.decode()}": Entry("GET", path, UPGRADE, b"") for path in WEBSOCKETS.values()
    }
    return {**found, "a handshake of Foxglove": Entry("GET", b"/robots/rover", FOXGLOVE, b"")}


def _on_entries() -> Iterator[tuple[str, Entry, str, str]]:
    """All fields in each shape, each at one of the handshakes and at one of the requests. Those that need no token come
    more often.
    """
    chance = random.Random(25)
    described = entries()
    often = [f"{each.method} {each.path}" for each in operations() if each.credential in OPEN]
    requests = [*described, *often * 4]
    chance.shuffle(requests)
    requests_in_turn, opened = itertools.cycle(requests), handshakes()
    handshakes_in_turn = itertools.cycle(opened)
    for name, shape in itertools.product(FIELDS, SHAPES):
        handshake, asked = next(handshakes_in_turn), next(requests_in_turn)
        yield handshake, opened[handshake], name, shape
        yield asked, described[asked], name, shape


def _fields() -> Iterator[Attack]:
    # Fields that change the kind of a request are tried on a plain one.
    for route, (method, path, fields, body), name, shape in _on_entries():
        most, made = FIELDS[name], SHAPES[shape]

        def data(
            part: float,
            most: int = most,
            made: Callable[[int], bytes] = made,
            name: str = name,
            method: str = method,
            path: bytes = path,
            fields: dict[str, bytes] = fields,
            body: bytes = body,
        ) -> bytes:
            return request(method, path, fields | {name: made(int(most * part))}, body)

        yield Attack(f"{route}: {name}: {shape}", data)
    for (name, _), (shape, made) in itertools.product(FIELDS.items(), SHAPES.items()):
        yield Attack(
            f"a long {name}: {shape}",
            lambda part, name=name, made=made: request(  # type: ignore[misc]
                "POST", b"/api/v1/session", _JSON | {name: made(int(HEAD * part))}, b"{}"
            ),
        )


_PLACES = (
    b"/",
    b"/assets/",
    b"/api/",
    b"/api/v1/robots/",
    b"/api/v1/vocabulary/",
    b"/oauth/",
    b"/robots/",
    b"/robots/rover/video/",
    b"/healthz?",
    b"/api/v1/robots?name=",
    b"/robots/rover?ticket=",
    b"/robots/rover/video/stream?topic=",
    b"/robots/rover/video/stream?",
)


def _paths() -> Iterator[Attack]:
    """Every place has each shape quoted and unquoted: one of them in a request, the other in a handshake."""
    chance = random.Random(26)
    for place, (shape, made) in itertools.product(_PLACES, SHAPES.items()):
        kinds = [("websocket", UPGRADE), ("request", dict[str, bytes]())]
        chance.shuffle(kinds)
        (kind, fields), (raw_kind, raw_fields) = kinds
        yield Attack(
            f"{kind} {place.decode()}…: {shape}",
            lambda part, place=place, made=made, fields=fields: request(  # type: ignore[misc]
                "GET", place + quote_from_bytes(made(2600), safe="/%").encode()[: int(8000 * part)], fields
            ),
        )
        yield Attack(
            f"{raw_kind} {place.decode()}… as it is: {shape}",
            lambda part, place=place, made=made, fields=raw_fields: request(  # type: ignore[misc]
                "GET", place + made(int(8000 * part)).replace(b" ", b"+").replace(b"\t", b"+"), fields
            ),
        )


def _described_places() -> Iterator[Attack]:
    """Some shapes in place of each parameter of a path, in all parameters of a query, and in the options and
    subprotocols of handshakes.
    """
    chance = random.Random(27)
    places: dict[tuple[str, bytes], dict[str, bytes]] = {}
    for each in operations():
        for parameter in re.finditer(r"\{[^}]*\}", each.path):
            places["GET", _filled(each.path[: parameter.start()])] = {}
        names = [parameter.name for parameter in each.parameters if parameter.place == "query"]
        for name in chance.sample(names, min(2, len(names))):
            places[each.method, _filled(each.path) + f"?{name}=".encode()] = {}
    for path in WEBSOCKETS.values():
        places["GET", path + b"?ticket="] = UPGRADE
    for option in (b"throttle", b"stride", b"voxel", b"token"):
        places["GET", b"/robots/rover?" + option + b"="] = FOXGLOVE
    for (method, place), fields in places.items():
        for shape in chance.sample(sorted(SHAPES), 3):
            yield Attack(
                f"{method} {place.decode()}…: {shape}",
                lambda part, method=method, place=place, made=SHAPES[shape], fields=fields: request(  # type: ignore[misc]
                    method, place + quote_from_bytes(made(2600), safe="").encode()[: int(7800 * part)], fields
                ),
            )
    for shape, made in SHAPES.items():
        yield Attack(
            f"a subprotocol beside Foxglove's: {shape}",
            lambda part, made=made: request(  # type: ignore[misc]
                "GET",
                b"/robots/rover",
                FOXGLOVE | {"Sec-WebSocket-Protocol": b"foxglove.sdk.v1, " + made(int(1000 * part))},
            ),
        )


def _bodies() -> Iterator[Attack]:
    form = {"Content-Type": b"application/x-www-form-urlencoded"}
    for shape, made in SHAPES.items():

        def text(size: float, made: Callable[[int], bytes] = made) -> str:
            return made(int(size)).decode(errors="replace")

        for fields in (["user"], ["password"], ["code"], ["user", "password"]):

            def login(part: float, fields: list[str] = fields, text: Callable[[float], str] = text) -> bytes:
                words = {"user": "a", "password": "b"} if "code" not in fields else {}
                words |= dict.fromkeys(fields, text(BODY * part / len(fields) / 2))
                words |= {"user": "a@" + words["user"]} if fields == ["user", "password"] else {}
                body = json.dumps(words, ensure_ascii=False).encode()
                return request("POST", b"/api/v1/session", _JSON, body[: BODY + 500])

            yield Attack(f"a login's {' and '.join(fields)}: {shape}", login)
        for path, names in (
            (
                "token",
                ("username", "realm", "client_id", "client_secret", "scope", "refresh_token", "grant_type"),
            ),
            ("introspect", ("token", "client_id")),
            ("revoke", ("token", "client_id")),
        ):
            for name in names:

                def oauth(
                    part: float, path: str = path, name: str = name, made: Callable[[int], bytes] = made
                ) -> bytes:
                    words = {"grant_type": b"password", "username": b"a", "password": b"b"}
                    words |= {"client_id": b"a", "client_secret": b"b", "token": b"a"}
                    words[name] = quote_from_bytes(made(int(BODY * part / 3)), safe="%").encode()
                    body = b"&".join(key.encode() + b"=" + value for key, value in words.items())
                    return request("POST", f"/oauth/{path}".encode(), form, body[:BODY])

                yield Attack(f"oauth {path}'s {name}: {shape}", oauth)
        for path, fields in (("/api/v1/session", _JSON), ("/oauth/token", form)):
            yield Attack(
                f"a body to {path}: {shape}",
                lambda part, path=path, fields=fields, made=made: request(  # type: ignore[misc]
                    "POST", path.encode(), fields, made(int(BODY * part))
                ),
            )
    for name, unit in (
        ("nested arrays", b"["),
        ("nested objects", b'{"a":'),
        ("zeros", b"0,"),
        ("keys", b'"a":1,'),
    ):
        yield Attack(
            f"a login's JSON: {name}",
            lambda part, unit=unit: request(  # type: ignore[misc]
                "POST", b"/api/v1/session", _JSON, b'{"x":1,' + unit * int(BODY * part / len(unit))
            ),
        )
    yield Attack(
        "a login's JSON: a long number",
        lambda part: request("POST", b"/api/v1/session", _JSON, b'{"user":' + b"9" * int(BODY * part) + b"}"),
    )
    yield Attack(
        "many fields of a form",
        lambda part: request("POST", b"/oauth/token", form, b"a=b&" * int(BODY * part / 4)),
    )


_POST = b"POST /api/v1/session HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nConnection: close\r\n"
_LAST = b"GET / HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n"
_CHUNKED = _POST + b"Transfer-Encoding: chunked\r\n\r\n"


def _framing() -> Iterator[Attack]:
    """Inputs about the limits between requests."""
    for name, before, unit, after, size in (
        ("chunks of one byte", _CHUNKED, b"1\r\nx\r\n", b"0\r\n\r\n", BODY),
        ("chunks with extensions", _CHUNKED, b"1;a=b;c\r\nx\r\n", b"0\r\n\r\n", BODY),
        ("a long size of a chunk", _CHUNKED, b"0", b"1\r\nx\r\n0\r\n\r\n", 1000),
        ("trailers", _CHUNKED + b"0\r\n", b"a: b\r\n", b"\r\n", BODY),
        ("empty lines", b"", b"\r\n", b"", BODY),
        ("line feeds", b"", b"\n", b"", BODY),
        ("lines of one blank", b"GET / HTTP/1.1\r\nHost: x\r\nA: b\r\n", b" \r\n", b"\r\n", BODY),
        ("continued lines", b"GET / HTTP/1.1\r\nHost: x\r\nA: b\r\n", b" c\r\n", b"\r\n", BODY),
        ("fields without a value", b"GET / HTTP/1.1\r\nHost: x\r\n", b"a:\r\n", b"\r\n", BODY),
        (
            "a long name of a field",
            b"GET / HTTP/1.1\r\nHost: x\r\n",
            b"a-",
            b": b\r\nConnection: close\r\n\r\n",
            HEAD,
        ),
        ("a long method", b"", b"A", b" / HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n", HEAD),
        ("a long length", _POST + b"Content-Length: ", b"9", b"\r\n\r\n", HEAD),
        ("a long line", b"", b"x", b"", BODY),
        ("a long first line", b"GET /", b"x", b"", BODY),
        ("requests one after another", b"", b"GET /robots/x HTTP/1.1\r\nHost: x\r\n\r\n", _LAST, BODY),
        ("requests for nothing", b"", b"GET /a HTTP/1.1\r\n\r\n", _LAST, BODY),
        ("no HTTP", b"", b"\x00\xff\x16\x03", b"", BODY),
    ):
        yield Attack(
            name,
            lambda part, before=before, unit=unit, after=after, size=size: (  # type: ignore[misc]
                before + unit * int(size * part / len(unit)) + after
            ),
            waits=True,
            in_turns=name.startswith("requests"),
        )


# --- websockets -------------------------------------------------------------------------------------------


def frame(payload: bytes, opcode: int = 1, final: bool = True) -> bytes:
    """A masked frame of a websocket; the mask is zero."""
    size = len(payload)
    length = (
        bytes([0x80 | size]) if size < 126 else b"\xfe" + struct.pack(">H", size) if size < 1 << 16 else b""
    )
    length = length or b"\xff" + struct.pack(">Q", size)
    return bytes([opcode | (0x80 if final else 0)]) + length + bytes(4) + payload


def _websockets() -> Iterator[Attack]:
    """Frames after a handshake without credentials."""

    def handshaken(frames: Callable[[float], bytes]) -> Callable[[float], bytes]:
        opened = request("GET", b"/robots/rover", UPGRADE)
        # The relay ends the connection when it has read all of them up to a close.
        return lambda part: opened + b"\x00" + frames(part) + frame(b"", 8)

    texts: dict[str, Callable[[float], bytes]] = {
        f"a token: {shape}": lambda part, made=made: (
            json.dumps({"op": "auth", "mac": made(int(30_000 * part)).decode(errors="replace")}).encode()
        )[
            # type: ignore[misc]
            :65_000
        ]
        for shape, made in SHAPES.items()
    }
    for name, unit in (("arrays", b"["), ("objects", b'{"a":'), ("numbers", b"1,"), ("strings", b'"a",')):
        texts[name] = lambda part, unit=unit: (  # type: ignore[misc]
            b'{"op":"auth","x":[' + unit * int(65_000 * part / len(unit))
        )
    texts["an op"] = lambda part: b'{"op":"' + b"a' - at `$.op`" * int(65_000 * part / 14) + b'"}'
    for name, made in texts.items():
        yield Attack(f"auth: {name}", handshaken(lambda part, made=made: frame(made(part))), waits=True)  # type: ignore[misc]
    for name, unit in (
        ("pings", frame(b"", 9)),
        ("empty fragments", frame(b"", 0, False)),
        ("pongs", frame(b"", 10)),
        ("closes", frame(b"", 8)),
        ("reserved bits", b"\xf1\x80" + bytes(4)),
    ):
        start = frame(b"", 1, False) if name == "empty fragments" else b""
        yield Attack(
            f"frames: {name}",
            handshaken(
                lambda part, unit=unit, start=start: start + unit * int(BODY * part / len(unit))  # type: ignore[misc]
            ),
            waits=True,
            in_turns=True,
        )


# --- the port for robots ----------------------------------------------------------------------------------


def _robot_frame(body: bytes) -> bytes:
    """A JSON frame of the robot link (SPEC 2.1)."""
    return struct.pack(">I", len(body) + 1) + b"\x01" + body


def _robots() -> Iterator[Attack]:
    for shape, made in SHAPES.items():
        for op, field in (
            ("hello", "robot"),
            ("hello", "key"),
            ("enroll", "robot"),
            ("enroll", "code"),
            ("enroll", "public_key"),
            ("join", "ticket"),
        ):

            def opening(
                part: float, op: str = op, field: str = field, made: Callable[[int], bytes] = made
            ) -> bytes:
                message = {
                    "op": op,
                    "version": 1,
                    "robot": "a",
                    "key": "b",
                    "encodings": ["cdr"],
                    "code": "c",
                }
                message |= {"public_key": "d", "ticket": "e"}
                known = {
                    "hello": ("op", "version", "robot", "key", "encodings"),
                    "enroll": ("op", "version", "robot", "code", "public_key"),
                    "join": ("op", "version", "ticket"),
                }[op]
                message = {name: message[name] for name in known}
                text = made(int(15_000 * part)).decode(errors="replace")
                return _robot_frame(
                    json.dumps(message | {field: text}, ensure_ascii=False).encode()
                ) + _robot_frame(json.dumps(message | {field: text[:255]}, ensure_ascii=False).encode())

            yield Attack(f"{op}'s {field}: {shape}", opening, robots=True, waits=True)
    for name, unit in (
        ("nested arrays", b"["),
        ("nested objects", b'{"a":'),
        ("numbers", b"1,"),
        ("a long number", b"9"),
    ):
        yield Attack(
            f"a robot's JSON: {name}",
            lambda part, unit=unit: _robot_frame(  # type: ignore[misc]
                b'{"op":"hello","x":[' + unit * int(16_000 * part / len(unit))
            ),
            robots=True,
            waits=True,
        )
    for name, unit in (
        ("empty frames", struct.pack(">I", 0)),
        ("frames of one byte", struct.pack(">IB", 1, 1)),
        ("empty objects", _robot_frame(b"{}")),
        ("pings", _robot_frame(b'{"op":"ping","t":1}')),
        ("no frames", b"\xff"),
        ("HTTP", b"GET / HTTP/1.1\r\n\r\n"),
    ):
        yield Attack(
            name,
            lambda part, unit=unit: unit * int(64_000 * part / len(unit)),  # type: ignore[misc]
            robots=True,
            waits=True,
        )


# --- sending them -----------------------------------------------------------------------------------------

_sources = itertools.cycle(f"127.0.{high}.{low}" for high in range(1, 5) for low in range(1, 255))
"""Every connection comes from another network, so that no limit of one hides what an input costs."""


def send(http_port: int, robots_port: int, attack: Attack, part: float = 1.0) -> bytes:
    """Sends an input on a new connection; returns the answer, up to a complete head if the connection stays."""
    port = robots_port if attack.robots else http_port
    with socket.create_connection(
        ("127.0.0.1", port), timeout=PATIENCE, source_address=(next(_sources), 0)
    ) as connection:
        return exchange(connection, attack.data(part), waits=attack.waits)


def exchange(connection: socket.socket, data: bytes, *, waits: bool = False) -> bytes:
    """Sends bytes and reads the answer."""
    answer = b""
    opened, zero, frames = data.partition(b"\r\n\r\n\x00")
    with contextlib.suppress(ConnectionError, TimeoutError):
        if zero:
            # Frames of a websocket follow the answer to its handshake.
            connection.sendall(opened + b"\r\n\r\n")
            while b"\r\n\r\n" not in answer and (more := connection.recv(65536)):
                answer += more
            answer, data = b"", frames
        connection.sendall(data)
        while more := connection.recv(65536):
            answer += more
            if not waits and _is_whole(answer):
                break
    return answer


def _is_whole(answer: bytes) -> bool:
    """Whether an answer is complete by its head; the connection may stay open."""
    head, end, body = answer.partition(b"\r\n\r\n")
    if not end or not head.startswith(b"HTTP/1.1"):
        return False
    length = re.search(rb"(?i)\r\ncontent-length: *(\d+)", head)
    chunked = b"chunked" in head.lower() and body.endswith(b"0\r\n\r\n")
    return head.startswith(b"HTTP/1.1 101") or chunked or (length is not None and len(body) >= int(length[1]))


class Reactor:
    """CPU time of the thread in which a relay serves all clients.

    :param pid: of the relay
    """

    def __init__(self, pid: int) -> None:
        self._count = Path(f"/proc/{pid}/task/{pid}/schedstat")

    def seconds(self) -> float:
        """CPU seconds so far, by the scheduler's own count."""
        return int(self._count.read_text().split()[0]) / 1e9

    def cost(self, work: Callable[[], object]) -> float:
        """CPU seconds of some work."""
        before = self.seconds()
        work()
        return self.seconds() - before
