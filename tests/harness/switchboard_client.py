"""A rosbridge client that does what it is told, message by message."""

from __future__ import annotations

import contextlib
import json
import random
import time
from typing import Any

from switchboard_waiting import PATIENCE
from websockets.sync.client import ClientConnection


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
        """Leave."""
        self._stack.close()

    def send(self, **message: Any) -> None:
        """One operation."""
        self.connection.send(json.dumps(message))

    def receive(self, seconds: float = PATIENCE) -> dict[str, Any]:
        """The next message."""
        return dict(json.loads(self.connection.recv(timeout=seconds)))

    def until(self, seconds: float = PATIENCE, **like: Any) -> dict[str, Any]:
        """The next message with these fields; what came before it is passed over."""
        end = time.monotonic() + seconds
        while True:
            message = self.receive(max(0.01, end - time.monotonic()))
            if all(message.get(key) == value for key, value in like.items()):
                return message

    def call(self, service: str, args: Any = None, seconds: float = PATIENCE) -> dict[str, Any]:
        """Call a service and wait for the answer."""
        call_id = f"call-{random.random()}"
        self.send(op="call_service", id=call_id, service=service, args={} if args is None else args)
        return self.until(seconds, op="service_response", id=call_id)

    def drive(self, v: float, w: float = 0.0, topic: str = "/cmd_vel") -> None:
        """One motion command."""
        self.send(op="publish", topic=topic, msg={"linear": {"x": v}, "angular": {"z": w}})
