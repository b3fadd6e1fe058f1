"""Clients that go on by themselves, each in a thread."""

from __future__ import annotations

import contextlib
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from switchboard_client import Client


class Driver(threading.Thread):
    """Keeps driving at 10 Hz until told to stop, or until the connection breaks.

    :ivar sent: how many commands have been sent
    """

    def __init__(self, client: Client, v: float = 0.2, w: float = 0.6) -> None:
        super().__init__(daemon=True)
        self._client = client
        self._v, self._w = v, w
        self._end = threading.Event()
        self._silent = threading.Event()
        self._pause = 0.0
        self.sent = 0
        self.broken: str | None = None

    def run(self) -> None:
        """Send, and read what comes so that nothing piles up."""
        try:
            self._drive(self._client)
        except Exception as error:
            self.broken = repr(error)

    def _drive(self, client: Client) -> None:
        client.send(op="advertise", topic="/cmd_vel", type="geometry_msgs/msg/Twist")
        if self._pause:
            client.drive(self._v, self._w)
            self._end.wait(self._pause)
        while not self._end.is_set():
            if not self._silent.is_set():
                client.drive(self._v, self._w)
                self.sent += 1
            with contextlib.suppress(TimeoutError):
                client.receive(0.1)

    def begin_with_a_pause(self, seconds: float) -> None:
        """Say nothing for so long after the first command.

        To a robot whose relay was started anew, whoever drove it before must let go, and not by having been away.
        """
        self._pause = seconds

    def let_go(self, seconds: float) -> None:
        """Say nothing for so long, and then drive on."""
        self._silent.set()
        time.sleep(seconds)
        self._silent.clear()

    def stop(self) -> None:
        """Let go, without a zero."""
        self._end.set()
        self.join(10)


class Returning(Driver):
    """Connects again as soon as its connection breaks, and commands at once.

    :param connect: makes a connection
    :ivar connections: how many there have been so far
    """

    def __init__(self, connect: Callable[[], Client]) -> None:
        super().__init__(connect())
        self._connect = connect
        self.connections = 1

    def run(self) -> None:
        """Drive by one connection after the other."""
        super().run()
        while not self._end.wait(0.01):
            with contextlib.suppress(Exception), self._connect() as client:
                self.connections += 1
                self._drive(client)


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
