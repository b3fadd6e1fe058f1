"""Plain ends of connections, all served by one loop in one thread, so that they add as little as possible.

:class:`WebEnd` is a rosbridge client, :class:`PlainRobot` a robot that speaks the link of SPEC 2,
:class:`TcpEnd` what stands behind a proxy that knows neither.
"""

from __future__ import annotations

import itertools
import selectors
import socket
import struct
import time
from collections.abc import Callable, Sequence
from typing import Any

from websockets.frames import Frame, Opcode

from bench.relay import Relay
from relay_protocol import PROTOCOL_VERSION, identity, jsontext, link
from relay_protocol.frames import encode_sample

CHUNK = 1 << 20
_LENGTH = struct.Struct("!I").unpack_from


def text_frame(payload: bytes, *, binary: bool = False) -> bytes:
    """A masked websocket frame, as a client sends it."""
    return Frame(Opcode.BINARY if binary else Opcode.TEXT, payload).serialize(mask=True)


def handshake(path: str, token: str = "") -> bytes:
    """The HTTP request that opens a websocket."""
    credentials = f"Authorization: Bearer {token}\r\n" if token else ""
    return (
        f"GET {path} HTTP/1.1\r\nHost: relay\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        f"Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\nSec-WebSocket-Version: 13\r\n{credentials}\r\n"
    ).encode()


class Loop:
    """Reads from all its ends; whoever waits for something turns it."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self._ends: list[End] = []

    def add(self, end: End) -> None:
        """Read from this end too."""
        self._selector.register(end.socket, selectors.EVENT_READ, end)
        self._ends.append(end)

    def drop(self, end: End) -> None:
        """Don't any more."""
        self._selector.unregister(end.socket)
        self._ends.remove(end)
        end.socket.close()

    def turn(self, timeout: float = 0.0) -> None:
        """Take what has come."""
        for key, _ in self._selector.select(timeout):
            key.data.readable()

    def until(self, what: str, condition: Callable[[], Any], seconds: float = 30.0) -> None:
        """Turn until something is so."""
        end = time.monotonic() + seconds
        while not condition():
            self.turn(0.05)
            assert time.monotonic() < end, f"not within {seconds:g} s: {what}"

    def close(self) -> None:
        """End all."""
        for end in list(self._ends):
            self.drop(end)
        self._selector.close()


class End:
    """One connection of the loop."""

    def __init__(self, loop: Loop, connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.socket = connection
        self._loop = loop
        self.messages = 0
        self.bytes = 0
        self.at = 0.0
        """When the latest bytes came, seconds of ``time.perf_counter``."""
        loop.add(self)

    def readable(self) -> None:
        """Bytes have come."""
        data = self.socket.recv(CHUNK)
        self.at = time.perf_counter()
        assert data, f"{type(self).__name__}: the other end hung up"
        self.bytes += len(data)
        self.take(data)

    def take(self, data: bytes) -> None:
        """Bytes as they come."""

    def send(self, data: bytes) -> None:
        """All of it."""
        self.socket.sendall(data)


class TcpEnd(End):
    """Takes bytes and counts messages by their known size."""

    def __init__(self, loop: Loop, connection: socket.socket, size: int) -> None:
        super().__init__(loop, connection)
        self.size = size

    def take(self, data: bytes) -> None:
        """Only the number counts."""
        self.messages = self.bytes // self.size


class WebEnd(End):
    """A websocket client: counts messages, answers pings."""

    def __init__(self, loop: Loop, port: int, path: str, token: str = "") -> None:
        connection = socket.create_connection(("127.0.0.1", port), timeout=30)
        self.begin(connection, path, token)
        self._open(loop, connection)

    @classmethod
    def begin(cls, connection: socket.socket, path: str, token: str = "") -> socket.socket:
        """Ask for a websocket on a connection; :meth:`opened` takes the answer."""
        connection.sendall(handshake(path, token))
        return connection

    @classmethod
    def opened(cls, loop: Loop, connection: socket.socket) -> WebEnd:
        """The client on a connection that was asked to become a websocket."""
        made = cls.__new__(cls)
        made._open(loop, connection)
        return made

    def _open(self, loop: Loop, connection: socket.socket) -> None:
        answer = b""
        while b"\r\n\r\n" not in answer:
            data = connection.recv(4096)
            assert data, f"no websocket: {answer!r}"
            answer += data
        head, _, rest = answer.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 101"), head
        End.__init__(self, loop, connection)
        self.payload_bytes = 0
        self.last = b""
        self._buffer = bytearray()
        self.take(rest)

    def say(self, **message: Any) -> None:
        """One operation."""
        self.send(text_frame(jsontext.encode(message)))

    def take(self, data: bytes) -> None:
        """Whole frames; what is left waits."""
        buffer = self._buffer
        buffer += data
        start, have = 0, len(buffer)
        while have - start >= 2:
            length, head = buffer[start + 1] & 127, 2
            if length == 126:
                head = 4
                length = int.from_bytes(buffer[start + 2 : start + 4], "big")
            elif length == 127:
                head = 10
                length = int.from_bytes(buffer[start + 2 : start + 10], "big")
            end = start + head + length
            if end > have or have - start < head:
                break
            opcode = buffer[start] & 15
            if opcode <= 2:
                # A message in several frames counts when its last one is there.
                self.messages += buffer[start] >> 7
                self.payload_bytes += length
                self.last = bytes(buffer[start + head : start + head + 200])
                self.frame(buffer, start, start + head, end)
            elif opcode == 9:
                answer = Frame(Opcode.PONG, bytes(buffer[start + head : end])).serialize(mask=True)
                self.send(answer)
            elif opcode == 8:
                raise AssertionError(f"the websocket was closed: {bytes(buffer[start + head + 2 : end])!r}")
            start = end
        del buffer[:start]

    def frame(self, buffer: bytearray, start: int, payload: int, end: int) -> None:
        """A data frame: where it starts, where its payload starts, and where both end."""


_COUNTED = (1, 5)
"""Kinds of frames: a sample, a command (SPEC 2.1)."""


class _LinkEnd(End):
    """A link to the relay: counts samples and commands, hands JSON on, answers pings."""

    def __init__(self, loop: Loop, port: int, told: Callable[[_LinkEnd, dict[str, Any]], None]) -> None:
        super().__init__(loop, socket.create_connection(("127.0.0.1", port), timeout=30))
        self._told = told
        self._buffer = bytearray()

    def tell(self, message: link.Message) -> None:
        """One message."""
        self.send(link.frame(message))

    def take(self, data: bytes) -> None:
        """Whole frames; what is left waits."""
        buffer = self._buffer
        buffer += data
        start, have = 0, len(buffer)
        while have - start >= 4:
            end = start + 4 + _LENGTH(buffer, start)[0]
            if end > have:
                break
            if buffer[start + 4] in _COUNTED:
                self.messages += 1
            else:
                self._hear(bytes(buffer[start + 5 : end]))
            start = end
        del buffer[:start]

    def _hear(self, body: bytes) -> None:
        message = dict(jsontext.decode_any(body))
        if message["op"] == "ping":
            self.tell(link.Pong(t=message["t"], at=time.monotonic_ns()))
        else:
            self._told(self, message)


class PlainRobot:
    """A robot that proves itself, says yes to everything, and costs next to nothing.

    :param encoding: of its samples, ``json`` or ``cdr``
    :param texts: definitions by type name, for ``cdr``
    :param motion: types it counts as motion
    """

    def __init__(
        self,
        loop: Loop,
        relay: Relay,
        name: str,
        encoding: str,
        texts: dict[str, str],
        motion: tuple[str, ...] = (),
    ) -> None:
        self.loop = loop
        self.name = name
        self.encoding = encoding
        self._port = relay.robots_port
        self._texts = texts
        self._key = identity.generate_key()
        self._heard: list[dict[str, Any]] = []
        self.subscriptions: dict[str, int] = {}
        self.channel: _LinkEnd | None = None
        self._joining = False
        code = relay.cli("robot", "add", name)["enrolment_code"]
        enrolling = _LinkEnd(loop, self._port, self._note)
        public = link.to_base64(identity.public_half(self._key))
        enrolling.tell(link.Enroll(version=PROTOCOL_VERSION, robot=name, code=code, public_key=public))
        self._await("enrolled")
        loop.drop(enrolling)
        self.control = self._register(motion)

    def _note(self, _: _LinkEnd, message: dict[str, Any]) -> None:
        self._heard.append(message)

    def _await(self, op: str) -> dict[str, Any]:
        self.loop.until(f"{self.name} hears {op}", lambda: any(each["op"] == op for each in self._heard))
        found = next(each for each in self._heard if each["op"] == op)
        self._heard.clear()
        return found

    def _register(self, motion: tuple[str, ...]) -> _LinkEnd:
        control = _LinkEnd(self.loop, self._port, self._control_message)
        key = identity.fingerprint(identity.public_half(self._key))
        hello = link.Hello(version=PROTOCOL_VERSION, robot=self.name, key=key, encodings=[self.encoding])
        control.tell(hello)
        challenge = self._await("challenge")
        nonce = link.from_base64(challenge["nonce"], "the nonce")
        signature = identity.sign(self._key, challenge["relay"], self.name, nonce)
        control.tell(link.Prove(signature=link.to_base64(signature)))
        self._await("welcome")
        control.tell(link.Describe(platform="bench", motion=link.MotionPolicy(types=list(motion))))
        control.tell(link.Graph(full=True))
        return control

    def _control_message(self, control: _LinkEnd, message: dict[str, Any]) -> None:
        if message["op"] == "open_channel":
            if self._joining:
                # Asked again, because nobody turned the loop for so long: the first ticket is still good.
                return
            self._joining = True
            self.channel = _LinkEnd(self.loop, self._port, self._channel_message)
            self.channel.tell(link.Join(version=PROTOCOL_VERSION, ticket=message["ticket"]))
        elif message["op"] == "control_grant":
            control.tell(link.OrderResult(id=message["id"]))
        else:
            self._heard.append(message)

    def _channel_message(self, channel: _LinkEnd, message: dict[str, Any]) -> None:
        op = message["op"]
        if op == "joined":
            self._joining = False
        elif op == "subscribe" and message["topic"] not in self.subscriptions:
            self.subscriptions[message["topic"]] = message["number"]
            channel.tell(
                link.Subscribed(
                    number=message["number"],
                    topic=message["topic"],
                    type=message["type"],
                    encoding=self.encoding,
                )
            )
        elif op == "advertise":
            named = {key: message[key] for key in ("number", "topic", "type")}
            channel.tell(link.Advertised(**named, encoding=self.encoding))
        elif op == "get_type":
            text = self._texts.get(message["type"])
            if text is None:
                channel.tell(
                    link.Failed(request="get_type", reference=message["type"], reason="it is not known here")
                )
            else:
                channel.tell(link.TypeDefinition(type=message["type"], text=text))

    def sample(self, topic: str, body: bytes) -> bytes:
        """The frame around a sample of a topic that was asked for."""
        return encode_sample(self.subscriptions[topic], time.time_ns(), body)

    @property
    def received(self) -> int:
        """Samples that have come from the relay."""
        return self.channel.messages if self.channel is not None else 0


def flood(
    loop: Loop,
    sender: End,
    messages: Sequence[bytes],
    total: int,
    received: Callable[[], int],
    window: int,
) -> None:
    """Send messages, one after the other and from the first again, with at most a window of them under way, until all
    have come.

    :param window: messages sent and not yet received; half of it is written at a time
    """
    burst = max(1, window // 2)
    following = itertools.cycle(messages)
    begun, sent = received(), 0
    end = time.monotonic() + 120
    while (came := received() - begun) < total:
        if sent < total and sent - came <= window - burst:
            left = min(burst, total - sent)
            sender.send(b"".join(itertools.islice(following, left)))
            sent += left
        loop.turn(0.5)
        assert time.monotonic() < end, f"{total - came} of {total} messages did not come"
    assert came == total, f"{came} messages came of {total}"


def one_at_a_time(
    loop: Loop, sender: End, messages: Sequence[bytes], total: int, received: Callable[[], int]
) -> None:
    """Send a message only when the one before has come."""
    begun = received()
    for number, message in enumerate(itertools.islice(itertools.cycle(messages), total), 1):
        sender.send(message)
        end = time.monotonic() + 10
        while received() - begun < number:
            loop.turn(0.5)
            assert time.monotonic() < end, "a message did not come"
