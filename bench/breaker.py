"""A client that breaks every rule, for as long as it is let. Started by ``crowd``, as a process.

Arguments: port, robot, token. One thing after another, at random with a fixed seed; whoever cuts it sees it again at
once. Ends with the standard input, and prints what it has done as JSON.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import select
import socket
import struct
import sys
from collections import Counter
from collections.abc import Callable
from typing import Any

from bench.wire import handshake, text_frame

OPS = [
    "advertise",
    "unadvertise",
    "publish",
    "subscribe",
    "unsubscribe",
    "call_service",
    "service_response",
    "advertise_service",
    "fragment",
    "png",
    "send_action_goal",
    "cancel_action_goal",
    "action_result",
    "set_level",
    "status",
    "auth",
    "nonsense",
]
FIELDS = [
    "topic",
    "type",
    "msg",
    "id",
    "args",
    "service",
    "action",
    "values",
    "result",
    "data",
    "num",
    "total",
    "level",
    "qos",
    "compression",
]
TOPICS = [
    "/bench/cloud",
    "/bench/scan",
    "/cmd_vel",
    "/rosout",
    "no name",
    "/" + "x" * 300,
    "",
    "/a//b",
    7,
    None,
]
TYPES = [
    "std_msgs/msg/String",
    "sensor_msgs/PointCloud2",
    "no/such/Type",
    "../../etc/passwd",
    "",
    3,
    [],
    None,
]


class Breaker:
    """One connection at a time, badly used."""

    def __init__(self, port: int, robot: str, token: str) -> None:
        self._port = port
        self._request = handshake(f"/robots/{robot}", token)
        self._random = random.Random(11)
        self.done: Counter[str] = Counter()
        self._ways: list[Callable[[socket.socket], None]] = [
            self.fuzzed,
            self.fuzzed,
            self.wrong_types,
            self.half,
            self.flood_of_publishes,
            self.flood_of_subscriptions,
            self.flood_of_calls,
            self.flood_of_fragments,
            self.too_large,
            self.bad_frames,
            self.deep,
            self.noise,
        ]

    def once(self) -> None:
        """Connect, do one of these things, read a little, and go without a word."""
        way = self._random.choice(self._ways)
        self.done[way.__name__] += 1
        with (
            contextlib.suppress(OSError),
            socket.create_connection(("127.0.0.1", self._port), 5) as connection,
        ):
            connection.settimeout(2)
            connection.sendall(self._request)
            if b" 101 " not in connection.recv(4096):
                self.done["refused"] += 1
                return
            way(connection)
            while select.select([connection], [], [], 0.3)[0] and connection.recv(1 << 20):
                pass

    def _thing(self, depth: int = 3) -> Any:
        pick = self._random
        plain = [None, True, -1, 2**70, 1e308, "x", "\u0000", "é" * 50, *TOPICS, *TYPES]
        kind = pick.random()
        if depth and kind < 0.2:
            return [self._thing(depth - 1) for _ in range(pick.randrange(4))]
        if depth and kind < 0.4:
            return {pick.choice(FIELDS): self._thing(depth - 1) for _ in range(pick.randrange(4))}
        return pick.choice(plain)

    def fuzzed(self, connection: socket.socket) -> None:
        """Operations with any fields, any values."""
        for _ in range(80):
            message = {name: self._thing() for name in self._random.sample(FIELDS, 5)}
            message["op"] = self._random.choice(OPS)
            connection.sendall(text_frame(json.dumps(message).encode()))

    def wrong_types(self, connection: socket.socket) -> None:
        """What exists, asked for as what it is not."""
        for topic in ("/bench/cloud", "/bench/scan", "/bench/s0"):
            for kind in ("std_msgs/msg/Empty", "no/msg/Such", "geometry_msgs/msg/Twist"):
                message = {
                    "op": "subscribe",
                    "topic": topic,
                    "type": kind,
                    "throttle_rate": -5,
                    "queue_length": 10**9,
                }
                connection.sendall(text_frame(json.dumps(message).encode()))

    def half(self, connection: socket.socket) -> None:
        """The first half of a message."""
        frame = text_frame(b'{"op":"publish","topic":"/cmd_vel","msg":{"linear":{"x":1.0}}}')
        connection.sendall(frame[: len(frame) // 2])

    def flood_of_publishes(self, connection: socket.socket) -> None:
        """Commands without the right to give any."""
        frame = text_frame(b'{"op":"publish","topic":"/cmd_vel","type":"geometry_msgs/msg/Twist","msg":{}}')
        connection.sendall(frame * 2000)

    def flood_of_subscriptions(self, connection: socket.socket) -> None:
        """On and off again."""
        on, off = (
            text_frame(json.dumps({"op": op, "topic": "/bench/cloud"}).encode())
            for op in ("subscribe", "unsubscribe")
        )
        connection.sendall((on + off) * 500)

    def flood_of_calls(self, connection: socket.socket) -> None:
        """Services that don't exist, or that this one may not call."""
        call = {"op": "call_service", "service": "/rosapi/topics", "id": "x" * 200}
        none = {"op": "call_service", "service": "/no/such", "id": 1, "timeout": 1e9}
        for message in (call, none):
            connection.sendall(text_frame(json.dumps(message).encode()) * 100)

    def flood_of_fragments(self, connection: socket.socket) -> None:
        """Parts that never become whole."""
        for number in range(300):
            part = {"op": "fragment", "id": str(number), "num": 0, "total": 2**31, "data": "x" * 2000}
            connection.sendall(text_frame(json.dumps(part).encode()))

    def too_large(self, connection: socket.socket) -> None:
        """A frame that says it has an exabyte, and a message over the limit."""
        connection.sendall(b"\x81\xff" + struct.pack("!Q", 2**60) + b"abcd" + b"x" * 100_000)

    def bad_frames(self, connection: socket.socket) -> None:
        """Unmasked, reserved, and not UTF-8."""
        for frame in (text_frame(b"\xff\xfe{}"), b"\x81\x02{}", b"\xf3\x80abcd", b"\x89\xfe\x10\x00abcd"):
            connection.sendall(frame)

    def deep(self, connection: socket.socket) -> None:
        """JSON without a bottom."""
        for _ in range(20):
            connection.sendall(text_frame(b'{"op":"publish","msg":' + b"[" * 100_000))

    def noise(self, connection: socket.socket) -> None:
        """No websocket at all."""
        connection.sendall(os.urandom(50_000))


def main() -> None:
    """Go on until the standard input ends."""
    breaker = Breaker(int(sys.argv[1]), sys.argv[2], sys.argv[3])
    print("READY", flush=True)
    while not select.select([sys.stdin], [], [], 0.02)[0]:
        breaker.once()
    print(json.dumps(breaker.done), flush=True)


if __name__ == "__main__":
    main()
