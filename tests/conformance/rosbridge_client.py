"""A rosbridge v2 client for checking servers: text and binary frames unchanged."""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import time
import zlib
from collections.abc import Callable
from typing import Any

import cbor2
from websockets.sync.client import ClientConnection, connect

PATIENCE = 30.0
"""Seconds an answer may take, unless the client is told otherwise: our own server may run on a busy machine."""

SOON = 8.0
"""Seconds to be closed for what was done, and not for saying nothing, which takes the relay longer."""

ABSENCE = 0.3
"""Seconds without a message that prove it doesn't come."""

_ids = itertools.count(1)


def _no_constant(name: str) -> None:
    raise AssertionError(f"the server sent {name}, which is no JSON (RFC 8259, 6)")


def strict_json(text: str) -> Any:
    """JSON of RFC 8259: no NaN, no Infinity."""
    return json.loads(text, parse_constant=_no_constant)


def png_text(data: str) -> str:
    """The text in the pixels of a base64 PNG (rosbridge v2, 3.1.2), without its padding."""
    png = base64.b64decode(data, validate=True)
    assert png[:8] == b"\x89PNG\r\n\x1a\n", "it is no PNG"
    at, packed, head = 8, b"", b""
    while at < len(png):
        size = int.from_bytes(png[at : at + 4], "big")
        kind, body = png[at + 4 : at + 8], png[at + 8 : at + 8 + size]
        assert zlib.crc32(kind + body) == int.from_bytes(png[at + 8 + size : at + 12 + size], "big")
        head = body if kind == b"IHDR" else head
        packed += body if kind == b"IDAT" else b""
        at += 12 + size
    width, height, depth, colour = (
        int.from_bytes(head[:4], "big"),
        int.from_bytes(head[4:8], "big"),
        *head[8:10],
    )
    assert (depth, colour) == (8, 2), f"bit depth {depth} and colour type {colour}, not 8-bit RGB"
    return _unfilter(zlib.decompress(packed), width * 3, height).decode().rstrip("\n")


def _unfilter(rows: bytes, stride: int, height: int) -> bytes:
    """PNG's filters undone (RFC 2083, 6)."""
    above, out = bytearray(stride), bytearray()
    for row in range(height):
        start = row * (stride + 1)
        filter_, line = rows[start], bytearray(rows[start + 1 : start + 1 + stride])
        for at in range(stride):
            left = line[at - 3] if at >= 3 else 0
            corner = above[at - 3] if at >= 3 else 0
            guess = (0, left, above[at], (left + above[at]) // 2, _paeth(left, above[at], corner))[filter_]
            line[at] = (line[at] + guess) & 255
        out += line
        above = line
    return bytes(out)


def _paeth(left: int, up: int, corner: int) -> int:
    guess = left + up - corner
    return min((abs(guess - left), 0, left), (abs(guess - up), 1, up), (abs(guess - corner), 2, corner))[2]


class Client:
    """A websocket to a rosbridge server.

    :param token: sent as ``Authorization: Bearer``, if there is one
    :param patience: timeout of an answer in seconds
    :param options: further ones of ``websockets.sync.client.connect``
    """

    def __init__(self, url: str, token: str = "", patience: float = PATIENCE, **options: Any) -> None:
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self.patience = patience
        options = {
            "open_timeout": min(20.0, patience),
            "close_timeout": 1,
            "max_size": None,
            "compression": None,
            **options,
        }
        self._stack = contextlib.ExitStack()
        self.connection: ClientConnection = self._stack.enter_context(
            connect(url, additional_headers=headers, **options)
        )
        self._passed_over: list[Any] = []

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._stack.close()

    # --- sending ---

    def send(self, op: str, **fields: Any) -> None:
        """Sends an operation."""
        self.send_raw(json.dumps({"op": op, **fields}))

    def send_raw(self, data: str | bytes) -> None:
        """Sends a text message (``str``) or a binary one (``bytes``) unchanged."""
        self.connection.send(data)

    # --- receiving ---

    def receive_raw(self, seconds: float | None = None) -> str | bytes:
        """The next message, not decoded."""
        return self.connection.recv(timeout=self.patience if seconds is None else seconds)

    def receive(self, seconds: float | None = None) -> Any:
        """The next message, decoded: text is JSON, binary is CBOR."""
        data = self.receive_raw(seconds)
        return cbor2.loads(data) if isinstance(data, bytes) else strict_json(data)

    def until(self, op: str, seconds: float | None = None, **like: Any) -> Any:
        """The next message with this ``op`` and these fields. Others are kept for later."""
        for place, message in enumerate(self._passed_over):
            if _alike(message, op, like):
                return self._passed_over.pop(place)
        seconds = self.patience if seconds is None else seconds
        end = time.monotonic() + seconds
        while True:
            try:
                message = self.receive(max(0.01, end - time.monotonic()))
            except TimeoutError:
                other = ", ".join(str(each)[:200] for each in self._passed_over[-3:])
                raise AssertionError(
                    f"no '{op}' with {like} within {seconds:g} s; the last others were: {other or 'none'}"
                ) from None
            if _alike(message, op, like):
                return message
            self._passed_over.append(message)

    def formed(self, ask: Callable[[], object], seconds: float | None = None) -> None:
        """Asks until the answer is a PNG or fragments, which is kept for the next reader.

        A server may send plain JSON while a user's quota is used up (SPEC 1.6).

        :param ask: sends one request
        """
        seconds = self.patience if seconds is None else seconds
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            ask()
            message = self.receive(seconds)
            while message["op"] == "status":
                self._passed_over.append(message)
                message = self.receive(seconds)
            self._passed_over.append(message)
            if message["op"] in ("png", "fragment"):
                return
            time.sleep(0.1)  # the quota refills over time
        raise AssertionError(f"only plain JSON came within {seconds:g} s")

    def none(self, op: str, seconds: float = ABSENCE, **like: Any) -> None:
        """No such message has arrived, nor arrives within this time."""
        try:
            message = self.until(op, seconds, **like)
        except AssertionError:
            return
        raise AssertionError(f"what should not have come: {str(message)[:300]}")

    def all_within(self, op: str, seconds: float, **like: Any) -> list[Any]:
        """All such messages that arrive within this time."""
        found = []
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                found.append(self.until(op, left, **like))
            except AssertionError:
                break
        return found

    def fragments(self, seconds: float | None = None) -> list[Any]:
        """The next message's fragments (rosbridge v2, 3.1.1), by their number."""
        first = self.until("fragment", seconds)
        parts = [first]
        while len(parts) < first["total"]:
            parts.append(self.until("fragment", seconds, id=first["id"]))
        return sorted(parts, key=lambda part: int(part["num"]))

    def closed(self) -> int:
        """Waits until the server closes; returns its close code."""
        seconds = min(SOON, self.patience)
        end = time.monotonic() + seconds
        try:
            while True:
                self.connection.recv(timeout=max(0.01, end - time.monotonic()))
        except TimeoutError:
            raise AssertionError(f"the server did not close within {seconds:g} s") from None
        except Exception:
            code = self.connection.protocol.close_code
            return -1 if code is None else int(code)

    # --- common operations ---

    def call(self, service: str, args: Any = None, seconds: float | None = None, **fields: Any) -> Any:
        """Calls a service; returns its ``service_response``."""
        call_id = f"call-{next(_ids)}"
        if args is not None:
            fields["args"] = args
        self.send("call_service", id=call_id, service=service, **fields)
        return self.until("service_response", seconds, id=call_id)

    def values(self, service: str, args: Any = None, seconds: float | None = None) -> Any:
        """The values of a service's successful answer."""
        answer = self.call(service, args, seconds)
        assert answer["result"] is True, f"{service} failed: {answer.get('values')}"
        return answer.get("values", {})

    def lives(self) -> None:
        """The connection still works: a call is answered, and the server has not closed."""
        assert self.values("/conformance/invert", {"data": False}) == {"success": True, "message": "inverted"}


def _alike(message: Any, op: str, like: dict[str, Any]) -> bool:
    return (
        isinstance(message, dict)
        and message.get("op") == op
        and all(message.get(key) == value for key, value in like.items())
    )
