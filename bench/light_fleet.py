"""Thousands of light robots and clients in one process: ``python -m bench.light_fleet FILE``.

FILE is JSON: ``robots`` (``name``, ``key`` in base64, ``dials``: ports of relays in order), ``clients`` (``ports`` of
relays in order, ``path``, ``token``), and ``seconds``, over which first the robots and then the clients connect. All
connect again to the next port when a link ends. A robot publishes :data:`TOPIC` every :data:`PERIOD`
seconds while it is subscribed. For each line of standard input the process prints what is connected; it ends with
standard input.
"""

from __future__ import annotations

import heapq
import itertools
import json
import random
import selectors
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from websockets.frames import Frame, Opcode

from bench.wire import CHUNK, handshake, text_frame
from relay_protocol import PROTOCOL_VERSION, identity, jsontext, link
from relay_protocol.frames import encode_sample

TOPIC = "/state"
PERIOD = 5.0
FIRST_REDIAL_SECONDS, LAST_REDIAL_SECONDS = 1.0, 8.0
"""Most seconds before a connection is tried again, the first time and after several failures."""


class Reactor:
    """Sockets and timers."""

    def __init__(self) -> None:
        self.selector = selectors.DefaultSelector()
        self._timers: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()

    def later(self, seconds: float, call: Callable[[], None]) -> None:
        """Call a function after some seconds."""
        heapq.heappush(self._timers, (time.monotonic() + seconds, next(self._numbers), call))

    def run(self) -> None:
        """Run until standard input ends."""
        while True:
            now = time.monotonic()
            while self._timers and self._timers[0][0] <= now:
                heapq.heappop(self._timers)[2]()
            wait = max(0.0, self._timers[0][0] - time.monotonic()) if self._timers else 1.0
            for key, _ in self.selector.select(min(wait, 1.0)):
                if key.data() is False:
                    return


class Connection:
    """One socket; what is received goes to ``take``, its end to ``ended``, also if it could not be opened."""

    def __init__(
        self, reactor: Reactor, port: int, take: Callable[[bytearray], None], ended: Callable[[], None]
    ) -> None:
        self._reactor = reactor
        self._take = take
        self._ended = ended
        self._received = bytearray()
        self._unsent = bytearray()
        self._socket = socket.socket()
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)
        self._socket.connect_ex(("127.0.0.1", port))
        self.open = True
        both = selectors.EVENT_READ | selectors.EVENT_WRITE
        reactor.selector.register(self._socket, both, self._ready)

    def send(self, data: bytes) -> None:
        """Send all of it, sooner or later."""
        if self.open:
            waits = bool(self._unsent)
            self._unsent += data
            if not waits:
                self._watch(selectors.EVENT_READ | selectors.EVENT_WRITE)

    def close(self) -> None:
        """Close it; ``ended`` is called."""
        if self.open:
            self.open = False
            self._reactor.selector.unregister(self._socket)
            self._socket.close()
            self._ended()

    def _watch(self, events: int) -> None:
        self._reactor.selector.modify(self._socket, events, self._ready)

    def _ready(self) -> None:
        if not self.open:
            # Another connection has closed it in the same turn.
            return
        try:
            if self._unsent:
                del self._unsent[: self._socket.send(self._unsent)]
            if not self._unsent:
                self._watch(selectors.EVENT_READ)
            data = self._socket.recv(CHUNK)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.close()
            return
        self._received += data
        self._take(self._received)


class Redial:
    """When a connection is tried again: later after each failure, with jitter."""

    def __init__(self, reactor: Reactor, dial: Callable[[], None]) -> None:
        self._reactor = reactor
        self._dial = dial
        self._most = FIRST_REDIAL_SECONDS

    def lost(self) -> None:
        """The connection has ended, or could not be opened."""
        self._reactor.later(random.uniform(0, self._most), self._dial)
        self._most = min(2 * self._most, LAST_REDIAL_SECONDS)

    def works(self) -> None:
        """The connection is of use."""
        self._most = FIRST_REDIAL_SECONDS


def link_messages(buffer: bytearray) -> list[dict[str, Any]]:
    """The JSON messages at the beginning of a buffer, which are removed."""
    found, start = [], 0
    while len(buffer) - start >= 4:
        end = start + 4 + int.from_bytes(buffer[start : start + 4], "big")
        if end > len(buffer):
            break
        if buffer[start + 4] == 0:
            found.append(dict(jsontext.decode_any(bytes(buffer[start + 5 : end]))))
        start = end
    del buffer[:start]
    return found


class LightRobot:
    """A robot with a control link and at most one channel."""

    def __init__(self, reactor: Reactor, name: str, key: bytes, dials: list[int], wait: float) -> None:
        self.online = False
        self._reactor = reactor
        self._name = name
        self._key = key
        self._dials = itertools.cycle(dials)
        self._port = 0
        self._control: Connection | None = None
        self._channel: LightChannel | None = None
        self._redial = Redial(reactor, self._dial)
        reactor.later(wait, self._dial)

    def _dial(self) -> None:
        self._port = next(self._dials)
        self._control = Connection(self._reactor, self._port, self._control_bytes, self._lost)
        key = identity.fingerprint(identity.public_half(self._key))
        self._tell(link.Hello(version=PROTOCOL_VERSION, robot=self._name, key=key, encodings=["json"]))

    def _tell(self, message: link.Message) -> None:
        assert self._control is not None
        self._control.send(link.frame(message))

    def _lost(self) -> None:
        self.online = False
        if self._channel is not None:
            self._channel.close()
        self._redial.lost()

    def _control_bytes(self, buffer: bytearray) -> None:
        for message in link_messages(buffer):
            op = message["op"]
            if op == "ping":
                self._tell(link.Pong(t=message["t"], at=time.monotonic_ns()))
            elif op == "challenge":
                nonce = link.from_base64(message["nonce"], "the nonce")
                signature = identity.sign(self._key, message["relay"], self._name, nonce)
                self._tell(link.Prove(signature=link.to_base64(signature)))
            elif op == "welcome":
                self._tell(link.Describe(platform="bench"))
                self._tell(link.Graph(full=True))
                self.online = True
                self._redial.works()
            elif op == "open_channel":
                self._channel = LightChannel(self._reactor, self._port, message["ticket"])


class LightChannel:
    """A channel of a robot, with the subscription of :data:`TOPIC`."""

    def __init__(self, reactor: Reactor, port: int, ticket: str) -> None:
        self._reactor = reactor
        self._number: int | None = None
        self._connection = Connection(reactor, port, self._bytes, lambda: None)
        self._tell(link.Join(version=PROTOCOL_VERSION, ticket=ticket))

    def close(self) -> None:
        """Close it."""
        self._connection.close()

    def _tell(self, message: link.Message) -> None:
        self._connection.send(link.frame(message))

    def _bytes(self, buffer: bytearray) -> None:
        for message in link_messages(buffer):
            op = message["op"]
            if op == "ping":
                self._tell(link.Pong(t=message["t"], at=time.monotonic_ns()))
            elif op == "subscribe":
                named = {key: message[key] for key in ("number", "topic", "type")}
                self._tell(link.Subscribed(**named, encoding="json"))
                begins = self._number is None
                self._number = message["number"]
                if begins:
                    self._publish()

    def _publish(self) -> None:
        if self._number is not None and self._connection.open:
            self._connection.send(encode_sample(self._number, time.time_ns(), b'{"data":"ready"}'))
            self._reactor.later(PERIOD, self._publish)


class LightClient:
    """A rosbridge client that subscribes to the topic of one robot."""

    def __init__(self, reactor: Reactor, ports: list[int], path: str, token: str, wait: float) -> None:
        self.messages = 0
        self.served = False
        """Whether it has received a message on its present connection."""
        self._reactor = reactor
        self._ports = itertools.cycle(ports)
        self.path = path
        self._request = handshake(path, token)
        self._open = False
        self._connection: Connection | None = None
        self._redial = Redial(reactor, self._dial)
        reactor.later(wait, self._dial)

    def _dial(self) -> None:
        self._connection = Connection(self._reactor, next(self._ports), self._bytes, self._lost)
        self._connection.send(self._request)

    def _lost(self) -> None:
        self.served = self._open = False
        self._redial.lost()

    def _bytes(self, buffer: bytearray) -> None:
        connection = self._connection
        assert connection is not None
        if not self._open:
            head, end, _ = buffer.partition(b"\r\n\r\n")
            if not end:
                return
            if not head.startswith(b"HTTP/1.1 101"):
                connection.close()
                return
            del buffer[: len(head) + 4]
            self._open = True
            subscribe = {"op": "subscribe", "topic": TOPIC, "type": "std_msgs/msg/String"}
            connection.send(text_frame(jsontext.encode(subscribe)))
        self._frames(connection, buffer)

    def _frames(self, connection: Connection, buffer: bytearray) -> None:
        start = 0
        while len(buffer) - start >= 2:
            length, head = buffer[start + 1] & 127, 2
            if length == 126:
                head, length = 4, int.from_bytes(buffer[start + 2 : start + 4], "big")
            end = start + head + length
            if end > len(buffer):
                break
            opcode = buffer[start] & 15
            if opcode == 1 and b'"op":"publish"' in buffer[start:end]:
                self.messages += 1
                self.served = True
                self._redial.works()
            elif opcode == 9:
                payload = bytes(buffer[start + head : end])
                connection.send(Frame(Opcode.PONG, payload).serialize(mask=True))
            elif opcode == 8:
                connection.close()
                return
            start = end
        del buffer[:start]


def main() -> None:
    """Run until standard input ends."""
    spec = json.loads(Path(sys.argv[1]).read_text())
    reactor = Reactor()
    seconds = float(spec["seconds"])
    robots = [
        LightRobot(
            reactor,
            each["name"],
            link.from_base64(each["key"], "the key"),
            each["dials"],
            random.uniform(0, seconds),
        )
        for each in spec["robots"]
    ]
    clients = [
        LightClient(reactor, each["ports"], each["path"], each["token"], seconds + random.uniform(0, seconds))
        for each in spec["clients"]
    ]

    def asked() -> bool:
        if not sys.stdin.readline():
            return False
        report = {
            "online": sum(each.online for each in robots),
            "served": sum(each.served for each in clients),
            "messages": sum(each.messages for each in clients),
            "missing": [each.path for each in clients if not each.served][:5],
        }
        print(json.dumps(report), flush=True)
        return True

    reactor.selector.register(sys.stdin, selectors.EVENT_READ, asked)
    print("READY", flush=True)
    reactor.run()


if __name__ == "__main__":
    main()
