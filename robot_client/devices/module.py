"""The base class of all modules that are Python classes."""

from __future__ import annotations

import json
import queue
import threading
from collections.abc import Callable
from functools import partial
from typing import Any

from robot_client.modules.command_relay import MESSAGE_BYTES

WAITING_CALLS = 1000
"""Most calls that wait for the module's thread; further callers wait until one is done."""

Call = Callable[[], object]


class ModuleCore:
    """What a module has beside its author's attributes.

    :ivar send: sends one line to the runner; without one, as in a test, nothing
    :ivar calls: for the module's thread, in order; ``None`` ends it
    :ivar slots: for calls of other threads
    """

    def __init__(self) -> None:
        self.send: Callable[[bytes], None] = lambda line: None
        self.calls: queue.SimpleQueue[Call | None] = queue.SimpleQueue()
        self.slots = threading.BoundedSemaphore(WAITING_CALLS)
        self.own_thread = threading.get_ident()


class Module:
    """One device or function, in a process of its own.

    Its methods are called one at a time, by one thread, and wait for each other. While nothing happens, that thread
    sleeps. Other threads reach the module by :meth:`call`.

    An exception ends the process, also one in another thread; the daemon starts it again by its restart policy. Only a
    ``ValueError`` of :meth:`handle` goes back to the sender of the command instead.

    :ivar stopped: whether the robot is stopped, or there is no daemon that could stop it. Nothing may move then.
    :ivar sender: in :meth:`handle`, number of the connection that sent the command; no later one has it
    """

    stopped: bool
    sender: int

    def __new__(cls, *arguments: Any, **settings: Any) -> Any:
        # Not in __init__, which authors write themselves.
        made = super().__new__(cls)
        made.stopped = True
        made.sender = 0
        made._core = ModuleCore()
        return made

    _core: ModuleCore

    # --- for authors to override -----------------------------------------------------------------------------

    def start(self) -> None:
        """Begin. The module is ready when this returns."""

    def handle(self, command: Any) -> None:
        """Carry out a command, any value of JSON.

        :raises ValueError: it is not understood, or can't be carried out; the sender receives the text
        """
        raise ValueError("this module takes no commands")

    def sender_left(self, sender: int) -> None:
        """The sender of earlier commands has disconnected."""

    def robot_stopped(self, stopped: bool) -> None:
        """:attr:`stopped` has changed."""

    def stop(self) -> None:
        """End: the daemon stops the module. What moves must stand still when this returns."""

    # --- for authors to call ---------------------------------------------------------------------------------

    def feedback(self, value: Any) -> None:
        """Send a value to those that listen to this module; from any thread.

        :param value: can be written as JSON
        :raises ValueError: it can't, or is longer than 64 KiB
        """
        self._write_line({"feedback": value})

    def call(self, function: Callable[..., object], *arguments: Any) -> None:
        """Call a function on the module's thread, after what waits already; from any thread.

        While :data:`WAITING_CALLS` wait, it blocks, unless it is used by the module's thread itself.
        """
        if threading.get_ident() == self._core.own_thread:
            self._host_post(partial(function, *arguments))
            return
        self._core.slots.acquire()
        self._host_post(partial(self._run_in_turn, partial(function, *arguments)))

    # --- for the host, and for base classes; the prefix keeps authors from overriding them by accident ---------

    def _host_open(self) -> None:
        """Prepare what :meth:`start` needs."""

    def _host_close(self) -> None:
        """Undo :meth:`_host_open`."""

    def _host_run(self) -> None:
        """Carry out calls until :meth:`_host_end`."""
        self._core.own_thread = threading.get_ident()
        while (call := self._core.calls.get()) is not None:
            call()

    def _host_end(self) -> None:
        """Have :meth:`_host_run` return; also from a signal's handler."""
        self._core.calls.put(None)

    def _host_post(self, call: Call) -> None:
        """Have the module's thread carry out a call."""
        self._core.calls.put(call)

    def _host_receive(self, message: dict[str, Any]) -> None:
        """Carry out one message of the runner; on the module's thread."""
        if "command" in message:
            self._carry_out(message["command"], message["number"], message["sender"])
        elif "left" in message:
            self.sender_left(message["left"])
        elif "stopped" in message and message["stopped"] is not self.stopped:
            self.stopped = message["stopped"]
            self.robot_stopped(self.stopped)

    def _carry_out(self, command: Any, number: int, sender: int) -> None:
        error = ""
        self.sender = sender
        try:
            self.handle(command)
        except ValueError as refusal:
            error = str(refusal)[:1000] or "the command is not understood"
        self._write_line({"answer": number, "error": error})

    def _run_in_turn(self, call: Call) -> None:
        self._core.slots.release()
        call()

    def _write_line(self, message: dict[str, Any]) -> None:
        try:
            data = json.dumps(message, separators=(",", ":"), allow_nan=False).encode() + b"\n"
        except TypeError as error:
            raise ValueError(f"feedback can't be written as JSON: {error}") from None
        if len(data) > MESSAGE_BYTES:
            raise ValueError(f"feedback of {len(data)} bytes is too long; at most {MESSAGE_BYTES} are sent")
        self._core.send(data)
