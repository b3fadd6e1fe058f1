"""Clients that run by themselves, each in a thread."""

from __future__ import annotations

import contextlib
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from tests.worlds.sync_client import Client


class Driver(threading.Thread):
    """Drives at 10 Hz until it is stopped, or until the connection breaks.

    :ivar sent: the number of sent commands
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
        """Sends, and reads so that no messages pile up."""
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
        """Pauses for this time after the first command.

        On a robot whose relay was restarted, the previous driver must release; an absence is no release.
        """
        self._pause = seconds

    def let_go(self, seconds: float) -> None:
        """Pauses for this time, and then drives on."""
        self._silent.set()
        time.sleep(seconds)
        self._silent.clear()

    def stop(self) -> None:
        """Ends without a zero."""
        self._end.set()
        self.join(10)


class Returning(Driver):
    """Reconnects as soon as its connection breaks, and commands at once.

    :param connect: makes a connection
    :ivar connections: the number of connections so far
    """

    def __init__(self, connect: Callable[[], Client]) -> None:
        super().__init__(connect())
        self._connect = connect
        self.connections = 1

    def run(self) -> None:
        """Drives by one connection after the other."""
        super().run()
        while not self._end.wait(0.01):
            with contextlib.suppress(Exception), self._connect() as client:
                self.connections += 1
                self._drive(client)


class Listener(threading.Thread, ABC):
    """Reads all messages until it is stopped, or until the connection breaks."""

    def __init__(self, client: Client) -> None:
        super().__init__(daemon=True)
        self.client = client
        self.broken = ""
        self._end = threading.Event()

    @abstractmethod
    def take(self, message: dict[str, Any]) -> None:
        """One message."""

    def run(self) -> None:
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
        self._end.set()
        self.join(10)
        self.client.close()
