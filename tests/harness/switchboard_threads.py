"""Clients that go on by themselves, each in a thread."""

from __future__ import annotations

import contextlib
import threading
from abc import ABC, abstractmethod
from typing import Any

from switchboard_client import Client


class Driver(threading.Thread):
    """Keeps driving at 10 Hz until told to stop, or until the connection breaks."""

    def __init__(self, client: Client, v: float = 0.2, w: float = 0.6) -> None:
        super().__init__(daemon=True)
        self._client = client
        self._v, self._w = v, w
        self._end = threading.Event()
        self.broken: str | None = None

    def run(self) -> None:
        """Send, and read what comes so that nothing piles up."""
        self._client.send(op="advertise", topic="/cmd_vel", type="geometry_msgs/msg/Twist")
        while not self._end.is_set():
            try:
                self._client.drive(self._v, self._w)
                with contextlib.suppress(TimeoutError):
                    self._client.receive(0.1)
            except Exception as error:
                self.broken = repr(error)
                return

    def stop(self) -> None:
        """Let go, without a zero."""
        self._end.set()
        self.join(10)


class Listener(threading.Thread, ABC):
    """Takes whatever comes until told to stop, or until the connection breaks."""

    def __init__(self, client: Client) -> None:
        super().__init__(daemon=True)
        self.client = client
        self.broken = ""
        self._end = threading.Event()

    @abstractmethod
    def take(self, message: dict[str, Any]) -> None:
        """One message."""

    def run(self) -> None:
        """Receive."""
        while not self._end.is_set():
            try:
                message = self.client.receive(0.5)
            except TimeoutError:
                continue
            except Exception as error:
                self.broken = repr(error)
                return
            self.take(message)

    def stop(self) -> None:
        """Leave."""
        self._end.set()
        self.join(10)
        self.client.close()
