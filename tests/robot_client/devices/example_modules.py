"""Modules for the tests."""

from __future__ import annotations

import os
import threading
import time
from typing import Any

from robot_client.devices import Module


class Echo(Module):
    """Feeds back whatever happens to it."""

    def __init__(self, greeting: str = "hello") -> None:
        self.greeting = greeting

    def start(self) -> None:
        self.feedback([self.greeting, self.stopped])
        threading.Thread(target=self.call, args=(self.feedback, "from a thread"), daemon=True).start()

    def handle(self, command: Any) -> None:
        if command == "crash":
            raise RuntimeError("it crashes")
        if command == "read":
            command = os.read(0, 10).decode()
        if command == "slow":
            time.sleep(600)
        if not isinstance(command, str):
            raise ValueError(f"{command!r} is not a text")
        self.feedback(["command", command, self.sender])

    def sender_left(self, sender: int) -> None:
        self.feedback(["left", sender])

    def robot_stopped(self, stopped: bool) -> None:
        self.feedback(["stopped", stopped])

    def stop(self) -> None:
        print("stopped in order")


class Log(Module):
    """Prints what happens to it."""

    def robot_stopped(self, stopped: bool) -> None:
        print("stopped:", stopped, flush=True)


class FailingThread(Module):
    """Fails in a thread of its own once it is ready, after a line without an end."""

    def start(self) -> None:
        print("starting …", end="", flush=True)

    def handle(self, command: Any) -> None:
        threading.Thread(target=self.fail).start()

    def fail(self) -> None:
        raise RuntimeError("the thread fails")

    def stop(self) -> None:
        print("stopped in order")


class NoModule:
    pass
