"""Memory that the relay spends on a connection that has not proved who it is, by the worst that such a one can do.

Each connection sends what it has and reads nothing. The figure is the growth of the relay's memory at its highest,
divided by the connections.
"""

from __future__ import annotations

import contextlib
import socket
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import httpx

import relay_server
from bench.cpu import resident
from bench.relay import Relay
from bench.report import Options, Row
from relay_protocol import limits
from tests.worlds.processes import running

BAR_KIB = 64.0
FIRST = 4
"""Connections that come before, so that memory which the relay takes once is not counted."""

WATCHED_SECONDS = 4.0
"""The relay cuts a connection that reads nothing later than that."""

PIPELINED_BYTES = 203_000
ADDRESSES = 8
"""Addresses of loopback that connections come from, so that none meets the limit of connections of one address."""


def pipelined(path: str) -> bytes:
    """The same GET again and again."""
    one = f"GET {path} HTTP/1.1\r\nHost: relay\r\n\r\n".encode()
    return one * (PIPELINED_BYTES // len(one))


def largest_asset() -> str:
    """The address of the portal's largest file."""
    assets = Path(relay_server.PORTAL) / "assets"
    return f"/assets/{max(assets.iterdir(), key=lambda each: each.stat().st_size).name}"


def attacks() -> dict[str, bytes]:
    """What connections send, by its name in the table."""
    upgrade = (
        b"GET /robots/rover HTTP/1.1\r\nHost: relay\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    )
    body = b"POST /api/v1/session HTTP/1.1\r\nHost: relay\r\nContent-Type: application/json\r\n"
    return {
        "half a request": b"GET / HTTP/1.1\r\nHost: relay\r\nX-Filler: " + b"a" * 15_000,
        "a body that lacks its end": body
        + f"Content-Length: {limits.HTTP_BODY}\r\n\r\n".encode()
        + b"a" * (limits.HTTP_BODY - 500),
        "requests for a file of the portal": pipelined(largest_asset()),
        "requests for the API's description": pipelined("/api/openapi.json"),
        "requests for nothing": pipelined("/n"),
        "requests that need a login": pipelined("/api/v1/session"),
        "half a frame of a websocket": upgrade
        + b"\x81\xff\x00\x00\x00\x00\x00\x00\xff\xf0abcd"
        + b"a" * 60_000,
    }


def connections(port: int, count: int) -> Iterator[socket.socket]:
    """Connections that will not read, from some addresses in turn."""
    for number in range(count):
        one = socket.socket()
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        one.bind((f"127.0.0.{1 + number % ADDRESSES}", 0))
        one.connect(("127.0.0.1", port))
        one.setblocking(False)
        yield one


def feed(rest: dict[socket.socket, bytes]) -> None:
    """Send some more where there is room."""
    for one, left in rest.items():
        with contextlib.suppress(OSError):
            rest[one] = left[one.send(left) :] if left else left


def growth(relay: Relay, data: bytes, count: int, seconds: float) -> float:
    """Bytes by which the relay's memory grows for each of so many connections, at its highest.

    :param seconds: how long the relay is watched after the last connection
    """
    highest = before = resident(relay.pid)
    rest: dict[socket.socket, bytes] = {}
    try:
        for one in connections(relay.http_port, count):
            rest[one] = data
            feed(rest)
            highest = max(highest, resident(relay.pid))
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            feed(rest)
            highest = max(highest, resident(relay.pid))
            time.sleep(0.02)
        return (highest - before) / count
    finally:
        for one in rest:
            one.close()


def run(options: Options) -> list[Row]:
    """Each attack on a relay of its own, or one would use memory that another has left."""
    count, seconds = int(options.pick(4, 200)), options.pick(0.2, WATCHED_SECONDS)
    rows = []
    for what, data in attacks().items():
        with tempfile.TemporaryDirectory(prefix="bench-") as name, contextlib.ExitStack() as stack:
            relay = Relay(Path(name))
            stack.enter_context(running(relay))
            # What is loaded at the first request is loaded once.
            for path in ("/", "/api/openapi.json", "/n"):
                httpx.get(f"http://127.0.0.1:{relay.http_port}{path}")
            growth(relay, data, FIRST, seconds)
            grown = growth(relay, data, count, seconds)
        row = Row("unproven", f"{what}, {count} connections", "KiB", grown / 1024, bar=BAR_KIB)
        print(f"    {what}: {row.ours:.1f} KiB", flush=True)
        rows.append(row)
    return rows
