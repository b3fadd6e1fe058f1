"""The daemon's side of its guard: start it, feed it, see that it lives, start it again."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred, succeed
from twisted.internet.error import ProcessExitedAlready
from twisted.internet.protocol import ProcessProtocol
from twisted.logger import Logger
from twisted.python.failure import Failure

from robot_client.guard_protocol import Command, Leave, Line, Probe, Ready, Topic, answer_decoder, encode
from robot_client.reactors import Timer

PROBE_EVERY = 5.0
SILENT = 20.0
"""Seconds without an answer after which a guard is taken for frozen; its start may take some."""

RESTART = (1.0, 30.0)
LEAVE = 2.0


class GuardKeeper:
    """Feeds a guard that is always there; a :class:`~robot_client.motion.GuardFeed`.

    :param reactor: for processes and timers
    :param node: name of the guard's node; those of later guards begin with it
    :param within_ms: time to stop, milliseconds
    """

    def __init__(self, reactor: Any, node: str, within_ms: int) -> None:
        self.on_alert: Callable[[str, str], None] = lambda level, text: None
        self._reactor = reactor
        self._node = node
        self._within_ms = str(within_ms)
        self._started = 0
        self._process: _Process | None = None
        self._topics: dict[str, Topic] = {}
        self._commands: dict[str, Command] = {}
        self._ready: set[str] = set()
        self._failures = 0
        self._timer: Timer | None = None
        self._left: Deferred[None] | None = None
        self._log = Logger("guard")

    def start(self) -> None:
        """Start a guard and tell it all that matters now."""
        self._timer = None
        self._process = process = _Process(self)
        try:
            self._reactor.spawnProcess(
                process,
                sys.executable,
                [sys.executable, *self._arguments()],
                # Whole: the wheels of ROS keep their library path in it, and the domain must be the same.
                env=dict(os.environ),
                childFDs={0: "w", 1: "r", 2: 2},
            )
        except OSError as error:
            self.lost(f"it can't be started: {error.strerror}")
            return
        lines: list[Line] = [*self._topics.values(), *self._commands.values()]
        for line in lines:
            process.tell(line)
        self._heard = self._reactor.seconds()
        self._timer = self._reactor.callLater(PROBE_EVERY, self._probe)

    def stop(self) -> Deferred[None]:
        """Let the guard leave; fires when it has."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._process is None:
            return succeed(None)
        self._left = Deferred()
        self._process.tell(Leave())
        self._process.transport.closeStdin()
        self._timer = self._reactor.callLater(LEAVE, self._process.kill)
        return self._left

    @property
    def pid(self) -> int | None:
        """Process of the guard that lives now."""
        return self._process.transport.pid if self._process else None

    def topic(self, topic: str, type: str) -> None:
        """Commands may come on this topic."""
        if topic not in self._topics:
            self._topics[topic] = line = Topic(topic, type)
            self._tell(line)

    def command(self, topic: str, moving: bool, at: int) -> None:
        """A command went out."""
        self._commands[topic] = line = Command(topic, moving, at)
        self._tell(line)

    def ready(self, topic: str) -> bool:
        """Whether the guard that lives now could stop this topic."""
        return topic in self._ready

    def heard(self, line: bytes) -> None:
        """The guard answered."""
        self._heard = self._reactor.seconds()
        self._failures = 0
        answer = answer_decoder.decode(line)
        if isinstance(answer, Ready):
            self._ready.add(answer.topic)

    def lost(self, why: str) -> None:
        """The guard is gone; get another."""
        self._process = None
        self._ready.clear()
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._timer = None
        if self._left is not None:
            self._left.callback(None)
            return
        least, most = RESTART
        delay = min(most, least * 2**self._failures)
        self._failures += 1
        self.on_alert("error", f"the motion guard is gone ({why}); another one is started in {delay:.0f} s")
        self._timer = self._reactor.callLater(delay, self.start)

    def _arguments(self) -> list[str]:
        # The network remembers a dead node for a while; one of the same name would be mistaken for it.
        node = f"{self._node}_{self._started}" if self._started else self._node
        self._started += 1
        return ["-m", "robot_client.guard", "--node", node, "--within-ms", self._within_ms]

    def _tell(self, line: Line) -> None:
        if self._process is not None:
            self._process.tell(line)

    def _probe(self) -> None:
        self._timer = None
        if self._process is None:
            return
        if self._reactor.seconds() - self._heard > SILENT:
            self._log.warn("the motion guard does not answer; it is ended and started anew")
            self._process.kill()
            return
        self._process.tell(Probe())
        self._timer = self._reactor.callLater(PROBE_EVERY, self._probe)


class _Process(ProcessProtocol):
    """One guard process."""

    transport: Any

    def __init__(self, keeper: GuardKeeper) -> None:
        self._keeper = keeper
        self._said = b""

    def tell(self, line: Line) -> None:
        """Write a line to it."""
        self.transport.write(encode(line))

    def kill(self) -> None:
        """End it the hard way."""
        try:
            self.transport.signalProcess("KILL")
        except ProcessExitedAlready:
            return

    def outReceived(self, data: bytes) -> None:
        """It answered."""
        *lines, self._said = (self._said + data).split(b"\n")
        for line in lines:
            self._keeper.heard(line)

    def processEnded(self, reason: Failure) -> None:
        """It is gone and reaped."""
        self._keeper.lost(reason.getErrorMessage())
