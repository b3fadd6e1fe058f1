"""A rosbridge client that the test controls message by message."""

from __future__ import annotations

import contextlib
import json
import random
import time
from typing import Any

from websockets.sync.client import ClientConnection

from tests.worlds.waiting import PATIENCE


class Client:
    """A plain rosbridge client over one websocket."""

    def __init__(self, connecting: Any) -> None:
        self._stack = contextlib.ExitStack()
        self.connection: ClientConnection = self._stack.enter_context(connecting)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._stack.close()

    def send(self, **message: Any) -> None:
        """Sends an operation."""
        self.connection.send(json.dumps(message))

    def receive(self, seconds: float = PATIENCE) -> dict[str, Any]:
        """The next message."""
        return dict(json.loads(self.connection.recv(timeout=seconds)))

    def until(self, seconds: float = PATIENCE, **like: Any) -> dict[str, Any]:
        """The next message with these fields; earlier ones are discarded."""
        end = time.monotonic() + seconds
        while True:
            message = self.receive(max(0.01, end - time.monotonic()))
            if all(message.get(key) == value for key, value in like.items()):
                return message

    def call(self, service: str, args: Any = None, seconds: float = PATIENCE) -> dict[str, Any]:
        """Calls a service and waits for the answer."""
        call_id = f"call-{random.random()}"
        self.send(op="call_service", id=call_id, service=service, args={} if args is None else args)
        return self.until(seconds, op="service_response", id=call_id)

    def drive(self, v: float, w: float = 0.0, topic: str = "/cmd_vel") -> None:
        """Sends a motion command."""
        self.send(op="publish", topic=topic, msg={"linear": {"x": v}, "angular": {"z": w}})
