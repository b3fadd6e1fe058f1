"""The daemon's side of its guard: starts it, passes commands to it, probes it and restarts it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
from twisted.internet.defer import Deferred, succeed
from twisted.logger import Logger

from robot_client.alerts import MODULE, OnAlert, ignore_alert
from robot_client.child_process import ChildProcess
from robot_client.motion.guard_protocol import (
    CANCEL_TYPE,
    GOALS_WITHIN_MS,
    Forget,
    GuardedCommand,
    GuardedTopic,
    Line,
    Probe,
    ShutDown,
    TopicReady,
    ZeroTemplate,
    answer_decoder,
    encode,
)
from robot_client.motion.typed_topic import TypedTopic
from robot_client.twisted_types import DelayedCall

PROBE_EVERY = 5.0
PROBE_MOVING = 1.0
"""Seconds between probes while nothing moves (:data:`PROBE_EVERY`), and while something does."""

DOUBTFUL_AFTER = 2.0
"""Seconds a probe may wait for its answer before the guard no longer counts as able to stop anything."""

FROZEN_AFTER = 20.0
"""Seconds without an answer after which the guard counts as frozen; they include the time it takes to start."""

RESTART_PAUSES = (1.0, 30.0)
"""Least and greatest seconds before a restart; each failure doubles the pause."""

EXIT_SECONDS = 2.0
"""Seconds the guard may take to exit when the daemon shuts down; then it is killed."""


class GuardSupervisor:
    """Keeps a guard process running and passes commands to it.

    Implements :class:`~robot_client.motion.guard_port.GuardPort`.

    :param reactor: for processes and timers
    :param node: name of the first guard's node; after a restart a number is appended
    :param within_ms: time to stop, milliseconds
    :param sim_time: whether the robot's time comes from ``/clock``
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
        self.on_alert: OnAlert = ignore_alert
        self._reactor = reactor
        self._node = node
        self._within_ms = str(within_ms)
        self._sim_time = sim_time
        self._within_by_topic = topics or {}
        self._started = 0
        self._process: ChildProcess | None = None
        self._topics: dict[TypedTopic, GuardedTopic] = {}
        self._zero_templates: dict[TypedTopic, ZeroTemplate] = {}
        self._commands: dict[TypedTopic, GuardedCommand] = {}
        self._ready: set[TypedTopic] = set()
        self._probed_at: float | None = None
        self._failures = 0
        self._timer: DelayedCall | None = None
        self._exited: Deferred[None] | None = None
        self._renewing = False
        self._log = Logger("guard")

    def start(self) -> None:
        """Start a guard and send it all topics, zero templates and last commands."""
        self._timer = None
        self._process = process = ChildProcess(self)
        try:
            process.start(self._reactor, self._arguments())
        except OSError as error:
            self.on_exit(f"it can't be started: {error.strerror}")
            return
        lines: list[Line] = [*self._topics.values(), *self._zero_templates.values(), *self._commands.values()]
        for line in lines:
            process.send(encode(line))
        self._answered_at = self._reactor.seconds()
        self._timer = self._reactor.callLater(self._probe_interval, self._probe)

    def stop(self) -> Deferred[None]:
        """Shut the guard down; fires when its process has ended."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._process is None:
            return succeed(None)
        self._exited = Deferred()
        self._process.send(encode(ShutDown()))
        self._process.close()
        self._timer = self._reactor.callLater(EXIT_SECONDS, self._process.kill)
        return self._exited

    def renew(self) -> None:
        """Replace the process by another, whose node finds all others. Nothing must be moving."""
        if self._process is not None and self._exited is None:
            self._renewing = True
            self._process.kill()

    @property
    def pid(self) -> int | None:
        """Process id of the running guard."""
        return self._process.transport.pid if self._process else None

    def add_topic(self, topic: TypedTopic) -> None:
        """See :meth:`GuardPort.add_topic <robot_client.motion.guard_port.GuardPort.add_topic>`."""
        if topic not in self._topics:
            within = (
                GOALS_WITHIN_MS if topic.type == CANCEL_TYPE else self._within_by_topic.get(topic.name, 0)
            )
            self._topics[topic] = line = GuardedTopic(topic.name, topic.type, within)
            self._send(line)

    def set_zero_template(self, topic: TypedTopic, zero_template: bytes) -> None:
        """See :meth:`GuardPort.set_zero_template <robot_client.motion.guard_port.GuardPort.set_zero_template>`."""
        self._zero_templates[topic] = line = ZeroTemplate(topic.name, topic.type, zero_template)
        self._send(line)

    def forget(self, topic: TypedTopic) -> None:
        """See :meth:`GuardPort.forget <robot_client.motion.guard_port.GuardPort.forget>`."""
        if self._topics.pop(topic, None) is not None:
            self._commands.pop(topic, None)
            self._zero_templates.pop(topic, None)
            self._ready.discard(topic)
            self._send(Forget(topic.name, topic.type))

    def note_command(self, topic: TypedTopic, moving: bool, at: int) -> None:
        """See :meth:`GuardPort.note_command <robot_client.motion.guard_port.GuardPort.note_command>`."""
        was_still = not self._moving
        self._commands[topic] = line = GuardedCommand(topic.name, topic.type, moving, at)
        self._send(line)
        if moving and was_still and self._process is not None and self._exited is None:
            self._probe_at_once()

    def ready(self, topic: TypedTopic) -> bool:
        """Whether the running guard could stop this topic, judged by its answers."""
        doubtful = self._probed_at is not None and self._reactor.seconds() - self._probed_at > DOUBTFUL_AFTER
        return topic in self._ready and not doubtful

    def on_line(self, line: bytes) -> None:
        """Handle a line of the guard's output; lines that are no answers are ignored."""
        try:
            answer = answer_decoder.decode(line)
        except msgspec.MsgspecError:
            return
        self._answered_at = self._reactor.seconds()
        self._probed_at = None
        if self._failures:
            self.on_alert("info", "the motion guard works again", MODULE, "guard", over=True)
        self._failures = 0
        # An answer about a topic that was forgotten in the meantime must not count when the topic returns.
        if isinstance(answer, TopicReady) and answer.typed_topic in self._topics:
            self._ready.add(answer.typed_topic)

    def on_exit(self, reason: str) -> None:
        """The guard's process has ended: start another after a pause, except after :meth:`stop`."""
        self._process = None
        self._ready.clear()
        self._probed_at = None
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._timer = None
        if self._exited is not None:
            self._exited.callback(None)
            return
        if self._renewing:
            self._renewing = False
            self.start()
            return
        least, most = RESTART_PAUSES
        delay = min(most, least * 2**self._failures)
        self._failures += 1
        text = f"the motion guard has ended ({reason}); it is started again in {delay:.0f} s"
        self.on_alert("error", text, MODULE, "guard")
        self._timer = self._reactor.callLater(delay, self.start)

    def _arguments(self) -> list[str]:
        # DDS discovery remembers a dead node for a while; a node of the same name would be mistaken for it.
        node = f"{self._node}_{self._started}" if self._started else self._node
        self._started += 1
        arguments = ["-m", "robot_client.motion.guard", "--node", node, "--within-ms", self._within_ms]
        return [*arguments, "--sim-time"] if self._sim_time else arguments

    def _send(self, line: Line) -> None:
        if self._process is not None:
            self._process.send(encode(line))

    def _probe(self) -> None:
        self._timer = None
        if self._process is None:
            return
        if self._reactor.seconds() - self._answered_at > FROZEN_AFTER:
            self._log.warn("the motion guard does not answer; it is killed and started again")
            self._process.kill()
            return
        self._process.send(encode(Probe()))
        if self._probed_at is None:
            self._probed_at = self._reactor.seconds()
        self._timer = self._reactor.callLater(self._probe_interval, self._probe)

    def _probe_at_once(self) -> None:
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._probe()

    @property
    def _moving(self) -> bool:
        return any(each.moving for each in self._commands.values())

    @property
    def _probe_interval(self) -> float:
        return PROBE_MOVING if self._moving else PROBE_EVERY
