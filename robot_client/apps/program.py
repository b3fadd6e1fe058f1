"""Shared by all applications: run until asked to end, reconnect, show the status, take the same options."""

from __future__ import annotations

import contextlib
import math
import random
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol, TextIO, TypeVar

import click

from robot_client.apps.connection import Lost, RosbridgeConnection, connected
from robot_client.apps.driver import MaximumSpeeds
from robot_client.command_line import Number
from robot_client.link.backoff import Backoff


class ExitSignal:
    """SIGINT and SIGTERM. They end the program at once, except while :meth:`deferred`; a second signal always does."""

    def __init__(self) -> None:
        self._requested = False
        self._deferring = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._signalled)

    def requested(self) -> bool:
        """Whether a signal was received."""
        return self._requested

    @contextlib.contextmanager
    def deferred(self) -> Iterator[None]:
        """A signal inside is only recorded."""
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False

    def _signalled(self, *_: Any) -> None:
        if self._requested or not self._deferring:
            sys.exit(0)
        self._requested = True


class ConnectedProgram(Protocol):
    """An application that uses one connection after the other."""

    def begin(self, connection: RosbridgeConnection) -> None:
        """A connection was made."""

    def step(self) -> bool:
        """Receive one message and act on it. False ends the program."""

    def leave(self) -> None:
        """Release the robot over the connection, which still exists."""

    def lost(self, why: str, seconds: float) -> None:
        """The connection was lost.

        :param why: for display
        :param seconds: until the next attempt
        """


def run_connected(
    url: str,
    program: ConnectedProgram,
    exit_signal: ExitSignal,
    connect: Callable[[str], contextlib.AbstractContextManager[RosbridgeConnection]] = connected,
    wait: Callable[[float], None] = time.sleep,
) -> None:
    """Run a program until it ends, and reconnect with backoff when the connection is lost.

    :param url: ``ws://relay/robots/NAME``
    :raises click.ClickException: there is no token
    :raises robot_client.apps.connection.Refused: the relay refuses, and a retry does not help
    """
    backoff = Backoff(random.random)
    while not exit_signal.requested():
        began = time.monotonic()
        was_connected = False
        try:
            with connect(url) as connection:
                was_connected = True
                with exit_signal.deferred():
                    _use(connection, program, exit_signal)
            return
        except Lost as lost:
            if exit_signal.requested():
                return
            seconds = backoff.after_loss(time.monotonic() - began if was_connected else 0.0)
            program.lost(str(lost), seconds)
        wait(seconds)


def _use(connection: RosbridgeConnection, program: ConnectedProgram, exit_signal: ExitSignal) -> None:
    program.begin(connection)
    try:
        while not exit_signal.requested() and program.step():
            pass
    finally:
        program.leave()


UPDATE_SECONDS = 0.2
"""Interval of updates on a terminal."""


class StatusLine:
    """Shows a status: one line that is overwritten on a terminal, else one line for each change.

    :param out: output stream
    :param clock: monotonic seconds
    """

    def __init__(self, out: TextIO, clock: Callable[[], float]) -> None:
        self._out = out
        self._clock = clock
        self._terminal = out.isatty()
        self._state = ""
        self._written = -math.inf

    def show(self, state: str, details: str = "") -> None:
        """Show a status.

        :param state: written when it changes
        :param details: written on terminals only, at most every :data:`UPDATE_SECONDS`
        """
        now = self._clock()
        if state == self._state and not (self._terminal and now - self._written >= UPDATE_SECONDS):
            return
        self._state, self._written = state, now
        if self._terminal:
            text = f"{state}  {details}"[: shutil.get_terminal_size().columns - 1]
            self._out.write(f"\r\x1b[K{text}")
        else:
            self._out.write(state + "\n")
        self._out.flush()

    def finish(self, word: str) -> None:
        """Show the last status."""
        self.show(word)
        if self._terminal:
            self._out.write("\n")
            self._out.flush()


AnyCommand = TypeVar("AnyCommand", bound=Callable[..., Any])

DEFAULT_SPEEDS = MaximumSpeeds(0.3, 1.0)
"""Suitable indoors."""


def driving(command: AnyCommand) -> AnyCommand:
    """Add the options of driving applications: ``url``, ``topic``, ``speed``, ``turn``."""
    found: Any = click.argument("url")
    options = [
        click.option(
            "--command", "topic", default="/cmd_vel", show_default=True, help="Topic for velocity commands."
        ),
        click.option(
            "--speed",
            type=Number(0.01, 10.0),
            default=DEFAULT_SPEEDS.speed,
            show_default=True,
            metavar="M/S",
            help="Maximum speed; the robot's own limits apply too.",
        ),
        click.option(
            "--turn",
            type=Number(0.01, 10.0),
            default=DEFAULT_SPEEDS.turn,
            show_default=True,
            metavar="RAD/S",
            help="Maximum turn rate; the robot's own limits apply too.",
        ),
    ]
    wrapped: Any = command
    for option in reversed(options):
        wrapped = option(wrapped)
    decorated: AnyCommand = found(wrapped)
    return decorated
