"""The client's end of a session that the relay opens for an order: it asks by rosbridge messages, as any client."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

import msgspec
from twisted.internet.defer import Deferred

from relay_protocol import jsontext
from relay_protocol.errors import Refused, SwitchboardError, Unavailable
from relay_server.session import Session
from relay_server.wsframe import TEXT

_WIDE = {126: struct.Struct("!H"), 127: struct.Struct("!Q")}
"""Forms of the length of a longer frame, by what stands in its place (RFC 6455 section 5.2)."""


class Answer(NamedTuple):
    """What a service answered.

    :param values: a string that says why, when ``result`` is false
    """

    result: bool
    values: Any


class OrderClient:
    """Speaks rosbridge with its session. It answers pings at once: what it says is never old."""

    def __init__(self) -> None:
        self._error = ""
        self._session: Session | None = None
        self._ids = itertools.count(1)
        self._calls: dict[str, Deferred[Answer]] = {}
        self._closed: SwitchboardError | None = None

    def begin(self, session: Session) -> None:
        """Take part."""
        self._session = session
        session.start()
        self.say("set_level", level="error")

    def check(self) -> None:
        """:raises SwitchboardError: something without an answer of its own went wrong, or the session was closed"""
        if self._closed is not None:
            raise self._closed
        if self._error:
            raise Refused(self._error)

    def say(self, op: str, **fields: Any) -> None:
        """One message to the session.

        :raises SwitchboardError: it was closed, with the reason
        """
        if self._closed is not None:
            raise self._closed
        assert self._session is not None
        self._session.message(msgspec.json.encode({"op": op, **fields}))

    async def call(
        self, service: str, args: Any, type_name: str = "", timeout: float | None = None
    ) -> Answer:
        """Call a service.

        :param args: what goes into JSON as it is, or JSON
        :param timeout: seconds
        :raises SwitchboardError: the session was closed meanwhile, with the reason
        """
        id = f"order-{next(self._ids)}"
        fields = {"type": type_name} if type_name else {}
        waiting: Deferred[Answer] = Deferred()
        self._calls[id] = waiting
        self.say("call_service", id=id, service=service, args=args, timeout=timeout, **fields)
        try:
            return await waiting
        finally:
            self._calls.pop(id, None)

    # --- the session's transport --------------------------------------------------------------------------

    def send(self, frames: bytes) -> None:
        """What the session says."""
        for payload in texts_in(frames):
            message = jsontext.decode_any(payload)
            if message["op"] == "service_response":
                waiting = self._calls.pop(message["id"], None)
                if waiting is not None:
                    waiting.callback(Answer(message["result"], message.get("values")))
            elif message["op"] == "status":
                self._error = self._error or message["msg"]

    def ping(self, payload: bytes) -> None:
        """It is there."""
        if self._session is not None:
            self._session.pong(payload)

    def close(self, code: int, reason: str) -> None:
        """The session is over: a right was revoked, the relay goes down."""
        self._closed = Unavailable(reason) if code < _OURS else Refused(reason)
        calls, self._calls = self._calls, {}
        for waiting in calls.values():
            waiting.errback(self._closed)


_OURS = 4000
"""Close codes from here on tell what the client has done or may not do (SPEC section 1.4)."""


def texts_in(frames: bytes) -> Iterator[bytes]:
    """The text messages in what a session writes: frames that are whole and not masked."""
    at = 0
    while at < len(frames):
        first, length = frames[at], frames[at + 1]
        at += 2
        wide = _WIDE.get(length)
        if wide is not None:
            (length,) = wide.unpack_from(frames, at)
            at += wide.size
        if first == TEXT:
            yield frames[at : at + length]
        at += length
