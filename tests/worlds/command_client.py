"""A client of the command server that sends targets."""

from __future__ import annotations

import hmac
import json
import socket
import struct
from typing import Any


class CommandClient:
    """A client of the command server, as docs/guides/remote_goals.md describes it, for the module ``targets``."""

    def __init__(self, port: int, secret: bytes = b"") -> None:
        self.seen: list[dict[str, Any]] = []
        """Feedback that came before an answer."""
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=60)
        challenge = self.receive()["challenge"]
        if secret:
            self.send(proof=hmac.digest(secret, challenge.encode(), "sha256").hex())
        assert self.receive() == {"welcome": True, "modules": ["targets"]}

    def send(self, **message: Any) -> None:
        body = json.dumps(message).encode()
        self.socket.sendall(struct.pack(">IB", len(body) + 1, 0) + body)

    def receive(self) -> dict[str, Any]:
        (length,) = struct.unpack(">I", self.exactly(4))
        found: dict[str, Any] = json.loads(self.exactly(length)[1:])
        return found

    def exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            more = self.socket.recv(count - len(data))
            assert more, "the server has closed the connection"
            data += more
        return data

    def targets(self, *targets: dict[str, Any]) -> str:
        """Sends targets; returns the answer."""
        return self.command({"go": list(targets)})

    def command(self, command: Any) -> str:
        self.send(id=1, module="targets", command=command)
        while True:
            message = self.receive()
            if "id" in message:
                return str(message["error"])
            self.seen.append(message["feedback"])

    def until(self, state: str) -> dict[str, Any]:
        """Feedback up to this state."""
        while True:
            found = self.feedback()
            if found["state"] == state:
                return found

    def feedback(self) -> dict[str, Any]:
        """The next feedback."""
        if not self.seen:
            self.seen.append(self.receive()["feedback"])
        return self.seen.pop(0)

    def close(self) -> None:
        self.socket.close()
