"""A robot that breaks the rules: one side of the robot link, without a daemon."""

from __future__ import annotations

import contextlib
import json
import socket
import ssl
import time
from typing import Any

from relay_protocol import PROTOCOL_VERSION, identity, limits, link
from relay_protocol.frames import FrameDecoder, JsonFrame
from tests.worlds.waiting import PATIENCE

SOON = 8.0
"""Seconds to be hung up on: fewer than the relay gives to who says nothing, which would end anybody."""

ORDERS = frozenset({"control_grant", "stop", "resume", "suppress", "inhibit"})


class FakeRobot:
    """One side of a robot link, written by the test, for messages that no correct robot sends.

    It answers orders about motion by itself, as if they were done.
    """

    def __init__(self, port: int, source: str = "127.0.0.1", context: ssl.SSLContext | None = None) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), PATIENCE, source_address=(source, 0))
        if context is not None:
            self.socket = context.wrap_socket(self.socket, server_hostname="127.0.0.1")
        self._decoder = FrameDecoder(limits.RELAY_FRAME)
        self._heard: list[dict[str, Any]] = []

    def __enter__(self) -> FakeRobot:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, message: link.Message) -> None:
        """Sends a message."""
        self.send_bytes(link.frame(message))

    def send_bytes(self, data: bytes) -> None:
        """Sends bytes as they are; a peer that has disconnected is no error."""
        with contextlib.suppress(ConnectionError):
            self.socket.sendall(data)

    def receive(self, seconds: float = PATIENCE) -> dict[str, Any] | None:
        """The next message, ``None`` at the end of the connection."""
        self.socket.settimeout(seconds)
        while not self._heard:
            try:
                data = self.socket.recv(65536)
            except ConnectionResetError:
                return None
            if not data:
                return None
            frames = self._decoder.feed(data)
            heard = [json.loads(each.body) for each in frames if isinstance(each, JsonFrame)]
            for each in heard:
                if each["op"] in ORDERS:
                    self.send(link.OrderResult(id=each["id"]))
            self._heard += [each for each in heard if each["op"] not in ORDERS]
        return self._heard.pop(0)

    def until(self, op: str, seconds: float = PATIENCE) -> dict[str, Any]:
        """The next message with this ``op``."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            message = self.receive(max(0.01, end - time.monotonic()))
            assert message is not None, f"the connection ended before '{op}' came"
            if message["op"] == op:
                return message
        raise AssertionError(f"no '{op}' within {seconds:g} s")

    def ended(self, seconds: float = SOON) -> bool:
        """Whether the relay closes the link within this time."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            try:
                if self.receive(max(0.01, end - time.monotonic())) is None:
                    return True
            except TimeoutError:
                return False
        return False

    def hello(self, robot: str, fingerprint: str) -> dict[str, Any]:
        """Sends its name; returns the challenge."""
        self.send(link.Hello(version=PROTOCOL_VERSION, robot=robot, key=fingerprint, encodings=["json"]))
        return self.until("challenge")

    def register(self, robot: str, key: bytes) -> dict[str, Any]:
        """Proves its key; returns ``welcome`` or ``refused``, and the sent proof."""
        challenge = self.hello(robot, identity.fingerprint(identity.public_half(key)))
        nonce = link.from_base64(challenge["nonce"], "the nonce")
        signature = identity.sign(key, challenge["relay"], robot, nonce)
        self.proof = link.Prove(signature=link.to_base64(signature))
        self.send(self.proof)
        return self.receive() or {}

    def enroll(self, robot: str, code: str, key: bytes) -> dict[str, Any]:
        """Enrols a key with a code; returns ``enrolled`` or ``refused``."""
        public = link.to_base64(identity.public_half(key))
        self.send(link.Enroll(version=PROTOCOL_VERSION, robot=robot, code=code, public_key=public))
        return self.receive() or {}
