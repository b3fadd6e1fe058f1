"""Staying with a robot until the program is asked to end: one line after the other, and what is let go of between."""

from __future__ import annotations

import contextlib
import random
import signal
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any, Protocol

from robot_client.apps.connection import Lost, RosbridgeConnection, connected
from robot_client.link.backoff import Backoff


class Ending:
    """Whether SIGINT or SIGTERM has asked the program to end.

    While nothing is held such a signal ends it at once, and so does a second one.
    """

    def __init__(self) -> None:
        self._asked = False
        self._holds = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._signalled)

    def asked(self) -> bool:
        """Whether it has been asked to."""
        return self._asked

    @contextlib.contextmanager
    def held_up(self) -> Iterator[None]:
        """While this lasts a signal is only written down."""
        self._holds = True
        try:
            yield
        finally:
            self._holds = False

    def _signalled(self, *_: Any) -> None:
        if self._asked or not self._holds:
            sys.exit(0)
        self._asked = True


class ConnectedProgram(Protocol):
    """What is done with a line."""

    def begin(self, line: RosbridgeConnection) -> None:
        """There is a line."""

    def step(self) -> bool:
        """Take what comes within a moment, and act on it; false at the end of what there is to do."""

    def leave(self) -> None:
        """Let go of the robot, by the line that there still is."""

    def lost(self, why: str, seconds: float) -> None:
        """The line is gone.

        :param why: in words
        :param seconds: until another is tried
        """


def run_connected(
    url: str,
    program: ConnectedProgram,
    ending: Ending,
    connect: Callable[[str], contextlib.AbstractContextManager[RosbridgeConnection]] = connected,
    wait: Callable[[float], None] = time.sleep,
) -> None:
    """Run a program at a robot until it ends, with a new line whenever one is lost.

    :param url: ``ws://relay/robots/NAME``
    :raises click.ClickException: there is no token
    :raises robot_client.apps.connection.Refused: the relay says no, and will until a person has done something
    """
    backoff = Backoff(random.random)
    while not ending.asked():
        began = time.monotonic()
        had_one = False
        try:
            with connect(url) as line:
                had_one = True
                with ending.held_up():
                    _use(line, program, ending)
            return
        except Lost as lost:
            if ending.asked():
                return
            seconds = backoff.after_loss(time.monotonic() - began if had_one else 0.0)
            program.lost(str(lost), seconds)
        wait(seconds)


def _use(line: RosbridgeConnection, program: ConnectedProgram, ending: Ending) -> None:
    program.begin(line)
    try:
        while not ending.asked() and program.step():
            pass
    finally:
        program.leave()
