"""Commands to a module of kind ``python``, and its answers and feedback, as its runner passes them on. No sockets.

Runner → module, JSON by line: ``{"settings": {…}}``, once and first; ``{"stopped": true}`` when the robot is stopped or
resumed; ``{"command": …, "number": 7, "sender": 3}``; ``{"left": 3}`` when a sender has disconnected.

Module → runner: ``{"answer": 7, "error": ""}``; ``{"feedback": …}``; ``{"failure": …}``, why it ends with an
error, in words.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, NamedTuple

MESSAGE_BYTES = 64 * 1024
"""Longest message of this protocol."""

WAITING_BYTES = 512 * 1024
"""While this much waits for a module, further commands are refused."""

WAITING_COMMANDS = 1000
"""Most commands without an answer."""


class _UnansweredCommand(NamedTuple):
    sender: int
    id: Any


class CommandRelay:
    """Numbers commands, so that their answers find the sender.

    :param send: sends one message to the module
    :param waiting: bytes that wait to be sent to the module
    :param answer: called with sender and answer
    :param listener: called with each feedback
    :param on_failure: called with the reason why the module ends with an error
    """

    def __init__(
        self,
        *,
        send: Callable[[dict[str, Any]], None],
        waiting: Callable[[], int],
        answer: Callable[[int, dict[str, Any]], None],
        listener: Callable[[dict[str, Any]], None],
        on_failure: Callable[[str], None],
    ) -> None:
        self._send = send
        self._waiting = waiting
        self._answer = answer
        self._listener = listener
        self._on_failure = on_failure
        self._count = 0
        self._sent: dict[int, _UnansweredCommand] = {}
        self._senders: set[int] = set()
        self._daemon: int | None = None

    def command(self, sender: int, id: Any, value: Any) -> None:
        """Pass a command on, or answer that the module is too slow."""
        if len(self._sent) >= WAITING_COMMANDS or self._waiting() > WAITING_BYTES:
            error = "the module is busy: commands wait for it already; send this one again later"
            self._answer(sender, {"event": "answer", "id": id, "error": error})
            return
        self._count += 1
        self._sent[self._count] = _UnansweredCommand(sender, id)
        self._senders.add(sender)
        self._send({"command": value, "number": self._count, "sender": sender})

    def robot_stopped(self, daemon: int, stopped: bool) -> None:
        """Pass on what the daemon reports: whether the robot is stopped."""
        self._daemon = daemon
        self._send({"stopped": stopped})

    def left(self, sender: int) -> None:
        """A sender has disconnected. Without a daemon nothing can be stopped, so the robot counts as stopped."""
        if sender in self._senders:
            self._senders.discard(sender)
            self._send({"left": sender})
        if sender == self._daemon:
            self._daemon = None
            self._send({"stopped": True})

    def received(self, line: bytes) -> None:
        """Pass on one message of the module.

        :raises ValueError: it is no message of this protocol
        """
        message = json.loads(line)
        if not isinstance(message, dict):
            raise ValueError("not an object")
        if "feedback" in message:
            self._listener({"event": "feedback", "value": message["feedback"]})
            return
        if "failure" in message:
            self._on_failure(str(message["failure"]))
            return
        sent = self._sent.pop(message.get("answer", 0), None)
        if sent is not None:
            error = str(message.get("error", ""))
            self._answer(sent.sender, {"event": "answer", "id": sent.id, "error": error})
