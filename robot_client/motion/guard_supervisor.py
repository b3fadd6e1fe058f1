"""The daemon's side of its guard: start it, feed it, see that it lives, start it again."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
from twisted.internet.defer import Deferred, succeed
from twisted.logger import Logger

from robot_client.alerts import MODULE, OnAlert, nobody
from robot_client.child import Child
from robot_client.motion.guard_protocol import (
    CANCEL_TYPE,
    GOALS_WITHIN_MS,
    Forget,
    GuardedCommand,
    GuardedTopic,
    Leave,
    Line,
    Probe,
    TopicReady,
    ZeroShape,
    answer_decoder,
    encode,
)
from robot_client.motion.typed_topic import TypedTopic
from robot_client.twisted_types import DelayedCall

PROBE_EVERY = 5.0
PROBE_MOVING = 1.0
"""Seconds between probes while nothing moves, and while something does."""

DOUBTFUL = 2.0
"""Seconds a probe may wait for its answer before the guard no longer counts as able to stop anything."""

SILENT = 20.0
"""Seconds without an answer after which a guard is taken for frozen; its start may take some."""

RESTART = (1.0, 30.0)
LEAVE = 2.0


class GuardSupervisor:
    """Feeds a guard that is always there; a :class:`~robot_client.motion.guard_port.GuardPort`.

    :param reactor: for processes and timers
    :param node: name of the guard's node; those of later guards begin with it
    :param within_ms: time to stop, milliseconds
    :param sim_time: whether the robot's time is what ``/clock`` says
    :param topics: times to stop of single topics, milliseconds
    """

    def __init__(
        self,
        reactor: Any,
        node: str,
        within_ms: int,
        sim_time: bool = False,
        topics: Mapping[str, int] | None = None,
    ) -> None:
        self.on_alert: OnAlert = nobody
        self._reactor = reactor
        self._node = node
        self._within_ms = str(within_ms)
        self._sim_time = sim_time
        self._within = topics or {}
        self._started = 0
        self._process: Child | None = None
        self._topics: dict[TypedTopic, GuardedTopic] = {}
        self._shapes: dict[TypedTopic, ZeroShape] = {}
        self._commands: dict[TypedTopic, GuardedCommand] = {}
        self._ready: set[TypedTopic] = set()
        self._asked: float | None = None
        self._failures = 0
        self._timer: DelayedCall | None = None
        self._left: Deferred[None] | None = None
        self._log = Logger("guard")

    def start(self) -> None:
        """Start a guard and tell it all that matters now."""
        self._timer = None
        self._process = process = Child(self)
        try:
            process.start(self._reactor, self._arguments())
        except OSError as error:
            self.lost(f"it can't be started: {error.strerror}")
            return
        lines: list[Line] = [*self._topics.values(), *self._shapes.values(), *self._commands.values()]
        for line in lines:
            process.tell(encode(line))
        self._heard = self._reactor.seconds()
        self._timer = self._reactor.callLater(self._pause, self._probe)

    def stop(self) -> Deferred[None]:
        """Let the guard leave; fires when it has."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._process is None:
            return succeed(None)
        self._left = Deferred()
        self._process.tell(encode(Leave()))
        self._process.leave()
        self._timer = self._reactor.callLater(LEAVE, self._process.kill)
        return self._left

    @property
    def pid(self) -> int | None:
        """Process of the guard that lives now."""
        return self._process.transport.pid if self._process else None

    def topic(self, on: TypedTopic) -> None:
        """Commands may come on this topic."""
        if on not in self._topics:
            within = GOALS_WITHIN_MS if on.type == CANCEL_TYPE else self._within.get(on.topic, 0)
            self._topics[on] = line = GuardedTopic(*on, within)
            self._tell(line)

    def shape(self, on: TypedTopic, rest: bytes) -> None:
        """What commands on this topic look like when they are zero."""
        self._shapes[on] = line = ZeroShape(*on, rest)
        self._tell(line)

    def forget(self, on: TypedTopic) -> None:
        """No more commands will come on this topic."""
        if self._topics.pop(on, None) is not None:
            self._commands.pop(on, None)
            self._shapes.pop(on, None)
            self._ready.discard(on)
            self._tell(Forget(*on))

    def command(self, on: TypedTopic, moving: bool, at: int) -> None:
        """A command went out."""
        stood = not self._moving
        self._commands[on] = line = GuardedCommand(*on, moving, at)
        self._tell(line)
        if moving and stood and self._process is not None and self._left is None:
            self._probe_at_once()

    def ready(self, on: TypedTopic) -> bool:
        """Whether the guard that lives now could stop this topic, as far as its answers tell."""
        doubtful = self._asked is not None and self._reactor.seconds() - self._asked > DOUBTFUL
        return on in self._ready and not doubtful

    def heard(self, line: bytes) -> None:
        """The guard answered, or something in its process wrote where it answers."""
        try:
            answer = answer_decoder.decode(line)
        except msgspec.MsgspecError:
            return
        self._heard = self._reactor.seconds()
        self._asked = None
        if self._failures:
            self.on_alert("info", "the motion guard is there again", MODULE, "guard", over=True)
        self._failures = 0
        # A word about a topic that was forgotten meanwhile must not count when the topic comes back.
        if isinstance(answer, TopicReady) and answer.on in self._topics:
            self._ready.add(answer.on)

    def lost(self, why: str) -> None:
        """The guard is gone; get another."""
        self._process = None
        self._ready.clear()
        self._asked = None
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._timer = None
        if self._left is not None:
            self._left.callback(None)
            return
        least, most = RESTART
        delay = min(most, least * 2**self._failures)
        self._failures += 1
        text = f"the motion guard is gone ({why}); another one is started in {delay:.0f} s"
        self.on_alert("error", text, MODULE, "guard")
        self._timer = self._reactor.callLater(delay, self.start)

    def _arguments(self) -> list[str]:
        # The network remembers a dead node for a while; one of the same name would be mistaken for it.
        node = f"{self._node}_{self._started}" if self._started else self._node
        self._started += 1
        told = ["-m", "robot_client.motion.guard", "--node", node, "--within-ms", self._within_ms]
        return [*told, "--sim-time"] if self._sim_time else told

    def _tell(self, line: Line) -> None:
        if self._process is not None:
            self._process.tell(encode(line))

    def _probe(self) -> None:
        self._timer = None
        if self._process is None:
            return
        if self._reactor.seconds() - self._heard > SILENT:
            self._log.warn("the motion guard does not answer; it is ended and started anew")
            self._process.kill()
            return
        self._process.tell(encode(Probe()))
        if self._asked is None:
            self._asked = self._reactor.seconds()
        self._timer = self._reactor.callLater(self._pause, self._probe)

    def _probe_at_once(self) -> None:
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._probe()

    @property
    def _moving(self) -> bool:
        return any(each.moving for each in self._commands.values())

    @property
    def _pause(self) -> float:
        return PROBE_MOVING if self._moving else PROBE_EVERY
