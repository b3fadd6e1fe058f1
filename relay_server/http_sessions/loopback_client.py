"""The client's end of a session that the relay opens itself: it asks by rosbridge operations, as any client."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import msgspec
from twisted.internet.defer import Deferred

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import Invalid, Refused, SwitchboardError, Unavailable
from relay_server.common.websocket_frames import TEXT
from relay_server.sessions.session import Session

_WIDE = {126: struct.Struct("!H"), 127: struct.Struct("!Q")}
"""Forms of the length of a longer frame, by what stands in its place (RFC 6455 section 5.2)."""

_OURS = 4000
"""Close codes from here on tell what the client has done or may not do (SPEC section 1.4)."""


FAILED = 64
"""Operations of which is remembered why they failed."""


class MaybeDone(SwitchboardError):
    """What was asked for is on its way, and nobody can say any more whether it was done.

    :param reason: why
    """

    code = "maybe_done"

    def __init__(self, reason: SwitchboardError) -> None:
        self.reason = reason
        super().__init__(f"{str(reason).rstrip('.')}; it was sent before, and may have been done")


class ServiceReply(NamedTuple):
    """What a service answered.

    :param values: JSON; a string that says why, when ``result`` is false
    """

    result: bool
    values: msgspec.Raw

    @property
    def read(self) -> Any:
        """The values, decoded."""
        return jsontext.decode_any(bytes(self.values))


class GoalListener:
    """Who wants to know how a goal comes along; see :meth:`LoopbackClient.pursue`."""

    def feedback(self, values: bytes) -> None:
        """It has come so far; JSON."""

    def ended(self, status: int, result: bool, values: bytes) -> None:
        """It is over.

        :param status: of ``action_msgs/msg/GoalStatus``; 0 for a goal that never began
        :param values: JSON; a string that says why, when ``result`` is false
        """


class _SentMessage(msgspec.Struct):
    """What a session says, as far as its client looks at it."""

    op: str
    id: str | int | None = None
    topic: str = ""
    msg: msgspec.Raw = msgspec.Raw(b"null")
    values: msgspec.Raw = msgspec.Raw(b"null")
    result: bool = True
    status: int = 0
    level: str = ""


_decode = msgspec.json.Decoder(_SentMessage).decode


class LoopbackClient:
    """Works with one session. It answers pings at once: what it says is never old, unless it is said to be.

    :param undated: what counts for an operation of which nobody says since when it may have been asked for, the relay's
        monotonic nanoseconds; ``None`` for now. Who speaks for others must not make what they say young
    """

    vouches = False

    def __init__(self, undated: int | None = None) -> None:
        self._undated = undated
        self._session: Session | None = None
        self._ids = itertools.count(1)
        self._calls: dict[str, Deferred[ServiceReply]] = {}
        self._goals: dict[str, GoalListener] = {}
        self._hears: dict[str, Callable[[bytes], None]] = {}
        self._failed: dict[str, str] = {}
        """By the id of an operation, what went wrong with it later; the latest last."""
        self._doing: str | None = None
        self._told: SwitchboardError | None = None
        self.closed: SwitchboardError | None = None
        """Why the session is over, when it is."""
        self.on_close: Callable[[], None] = _nothing

    def begin(self, session: Session) -> None:
        """Take part."""
        self._session = session
        session.start()
        self.do(rosbridge.SetLevel(level="warning"))

    def check(self, *ids: str) -> None:
        """See how operations without an answer of their own have gone.

        :raises SwitchboardError: one of these went wrong after it had been asked for, or the session was closed
        """
        if self.closed is not None:
            raise self.closed
        for id in ids:
            words = self._failed.pop(id, None)
            if words is not None:
                raise Refused(words)

    def new_id(self) -> str:
        """What no other operation of this client has."""
        return f"inside-{next(self._ids)}"

    def do(self, operation: rosbridge.ClientOp, since: int | None = None) -> None:
        """Ask for something.

        :param since: a moment before which it can't have been asked for, the relay's monotonic nanoseconds, where
            that is not now
        :raises SwitchboardError: it is refused, or the session was closed; with the reason
        """
        if self.closed is not None:
            raise self.closed
        assert self._session is not None
        self._doing, self._told = None if operation.id is None else str(operation.id), None
        try:
            self._session.do(operation, self._undated if since is None else since)
        finally:
            self._doing, told = None, self._told
        if told is not None:
            raise told

    async def call(
        self,
        service: str,
        args: msgspec.Raw,
        type_name: str = "",
        timeout: float | None = None,
        since: int | None = None,
    ) -> ServiceReply:
        """Call a service.

        :param args: JSON
        :param timeout: seconds
        :param since: as for :meth:`do`
        :raises MaybeDone: the session was closed before there was an answer
        :raises SwitchboardError: it is refused, or the session was closed; with the reason
        """
        id = self.new_id()
        waiting: Deferred[ServiceReply] = Deferred()
        self._calls[id] = waiting
        try:
            ask = rosbridge.CallService(id=id, service=service, args=args, type=type_name, timeout=timeout)
            self.do(ask, since)
            try:
                return await waiting
            except SwitchboardError as error:
                # Which says that the session is over: a service that refuses answers.
                raise MaybeDone(error) from None
        finally:
            self._calls.pop(id, None)

    def hear(self, topic: str, type_name: str, listener: Callable[[bytes], None], **how: Any) -> None:
        """Listen to a topic, with a JSON text for each message.

        :param how: further fields of ``subscribe``
        :raises SwitchboardError: it is refused
        """
        # Before it is asked for: what is there already comes at once.
        self._hears[topic] = listener
        try:
            self.do(rosbridge.Subscribe(id=topic, topic=topic, type=type_name or None, **how))
        except SwitchboardError:
            self._hears.pop(topic, None)
            raise

    def hear_no_more(self, topic: str) -> None:
        """Listen to it no longer."""
        if self._hears.pop(topic, None) is not None and self.closed is None:
            self.do(rosbridge.Unsubscribe(topic=topic))

    def pursue(self, ask: rosbridge.SendActionGoal, progress: GoalListener, since: int | None = None) -> None:
        """Have a goal pursued.

        :param ask: with an ``id``
        :param since: as for :meth:`do`
        :raises SwitchboardError: it is refused
        """
        id = str(ask.id)
        self._goals[id] = progress
        try:
            self.do(ask, since)
        except SwitchboardError:
            self._goals.pop(id, None)
            raise

    # --- the session's transport --------------------------------------------------------------------------

    def send(self, frames: bytes) -> None:
        """What the session says."""
        for payload in texts_in(frames):
            said = _decode(payload)
            id = str(said.id)
            if said.op == "publish":
                listener = self._hears.get(said.topic)
                if listener is not None:
                    listener(bytes(said.msg))
            elif said.op == "service_response":
                waiting = self._calls.pop(id, None)
                if waiting is not None:
                    waiting.callback(ServiceReply(said.result, said.values))
            elif said.op in ("action_feedback", "action_result"):
                self._progress(id, said)
            elif said.op == "status":
                self._status(id, said.level, str(jsontext.decode_any(bytes(said.msg))))

    def _progress(self, id: str, said: _SentMessage) -> None:
        if said.op == "action_feedback":
            pursued = self._goals.get(id)
            if pursued is not None:
                pursued.feedback(bytes(said.values))
            return
        pursued = self._goals.pop(id, None)
        if pursued is not None:
            pursued.ended(said.status, said.result, bytes(said.values))

    def _status(self, id: str, level: str, words: str) -> None:
        if self._doing == id:
            self._told = self._told or (Invalid(words) if level == "error" else Refused(words))
        elif level == "error" and id not in self._failed:
            self._failed[id] = words
            if len(self._failed) > FAILED:
                del self._failed[next(iter(self._failed))]

    def ping(self, payload: bytes) -> None:
        """It is there."""
        if self._session is not None:
            self._session.pong(payload)

    def close(self, code: int, reason: str) -> None:
        """The session is over: a right was revoked, the relay goes down."""
        self.closed = Unavailable(reason) if code < _OURS else Refused(reason)
        calls, self._calls = self._calls, {}
        goals, self._goals = self._goals, {}
        for waiting in calls.values():
            waiting.errback(self.closed)
        for each in goals.values():
            each.ended(0, False, jsontext.encode(reason))
        self.on_close()


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


def _nothing() -> None:
    """Nobody wants to know."""
