"""The guard: a small process that stops the robot when the daemon can't, because it was killed or is frozen.

It is started by the daemon (``python -m robot_client.guard``), has a node and publishers of its own, and
hears of every motion command over its standard input. The end of that pipe is the end of the daemon.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
import time
from collections.abc import Callable
from typing import Any, Protocol

import click
import msgspec

from robot_client.guard_protocol import Alive, Command, Leave, Line, Probe, Ready, Topic, decoder, encode
from robot_client.ros_log import ensure_log_folder
from robot_client.safety import GUARD_SHARE, Watchdog

MILLI = 1_000_000
NANO = 1_000_000_000
REPEATS = 5
REPEAT_EVERY = 40 * MILLI
"""A stop is said five times within 200 ms: the first ones may find a network that is just breaking."""

LOOK_EVERY = 20 * MILLI
LOOK_SELDOM = 500 * MILLI
"""How often to look whether a new publisher has found its listeners: the less the longer nobody was there."""

UNHEARD = 10 * NANO
"""How much longer to repeat while nobody who listens to the topic was found yet, after the daemon's end."""


class Outlets(Protocol):
    """Publishers of zero."""

    def open(self, topic: str, type: str) -> None:
        """Have a publisher ready."""

    def zero(self, topic: str) -> bool:
        """Publish zero; whether anybody listens."""

    def heard(self, topic: str) -> bool:
        """Whether anybody listens."""


class _Stop:
    """A stop being repeated."""

    def __init__(self, now: int) -> None:
        self.left = REPEATS
        self.next = now
        self.until = now + UNHEARD


class Guard:
    """Decides; pure but for the outlets.

    :param now: monotonic clock, nanoseconds, the same the daemon has
    """

    def __init__(self, within_ms: int, outlets: Outlets, now: Callable[[], int]) -> None:
        self.leaving = False
        self._outlets = outlets
        self._now = now
        self._watchdog = Watchdog(within_ms, GUARD_SHARE)
        self._stops: dict[str, _Stop] = {}
        self._unready: dict[str, tuple[int, int]] = {}
        self._ready: list[str] = []

    def take(self, line: Line) -> bool:
        """One line from the daemon; whether it wants an answer."""
        if isinstance(line, Topic):
            self._outlets.open(line.topic, line.type)
            self._unready[line.topic] = (self._now(), self._now())
        elif isinstance(line, Command):
            self._stops.pop(line.topic, None)
            self._watchdog.command(line.topic, "daemon", line.moving, line.at)
        elif isinstance(line, Leave):
            self._watchdog.everything()
            self.leaving = True
        return isinstance(line, Probe)

    def orphaned(self) -> None:
        """The daemon is gone: stop what it left moving, then leave."""
        self._begin(self._watchdog.everything())
        self.leaving = True
        self.act()

    def take_ready(self) -> list[str]:
        """Topics it has become able to stop since it was asked last."""
        ready, self._ready = self._ready, []
        return ready

    def act(self) -> None:
        """Do what is due."""
        now = self._now()
        self._look(now)
        self._begin(self._watchdog.expired(now))
        for topic, stop in list(self._stops.items()):
            if stop.next > now:
                continue
            heard = self._outlets.zero(topic)
            stop.left -= 1
            stop.next = now + REPEAT_EVERY
            if stop.left <= 0 and (heard or now >= stop.until):
                del self._stops[topic]

    def wait(self) -> float | None:
        """Seconds until :meth:`act` has something to do; ``None`` for as long as no line comes."""
        times = [stop.next for stop in self._stops.values()] + [due for due, _ in self._unready.values()]
        due = self._watchdog.due()
        if due is not None:
            times.append(due)
        return max(0.0, (min(times) - self._now()) / NANO) if times else None

    @property
    def done(self) -> bool:
        """Whether it may leave."""
        return self.leaving and not self._stops

    def _look(self, now: int) -> None:
        for topic, (due, since) in list(self._unready.items()):
            if due > now:
                continue
            if self._outlets.heard(topic):
                del self._unready[topic]
                self._ready.append(topic)
            else:
                pause = min(max((now - since) // 10, LOOK_EVERY), LOOK_SELDOM)
                self._unready[topic] = (now + pause, since)

    def _begin(self, topics: list[str]) -> None:
        for topic in topics:
            self._stops[topic] = _Stop(self._now())


class RosOutlets:
    """Publishers in a node of their own; nothing spins, so the node costs nothing while it waits."""

    def __init__(self, name: str) -> None:
        import rclpy
        from rclpy.signals import SignalHandlerOptions

        from robot_client.platforms.ros2_types import Types

        ensure_log_folder()
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self._node: Any = rclpy.create_node(name, start_parameter_services=False, enable_rosout=False)
        self._types = Types()
        self._publishers: dict[str, tuple[Any, str]] = {}

    def open(self, topic: str, type: str) -> None:
        """Have a publisher ready."""
        if topic not in self._publishers:
            publisher = self._node.create_publisher(self._types.message(type), topic, 10)
            self._publishers[topic] = (publisher, type)

    def zero(self, topic: str) -> bool:
        """Publish zero."""
        publisher, type = self._publishers[topic]
        publisher.publish(self._types.zero(type, self._node.get_clock().now().to_msg()))
        return self.heard(topic)

    def heard(self, topic: str) -> bool:
        """Whether DDS has matched a subscription."""
        publisher, _ = self._publishers[topic]
        return bool(publisher.get_subscription_count())


def watch(guard: Guard, inlet: int, wake: int) -> None:
    """Serve until the daemon is gone and the robot stands.

    :param inlet: descriptor the daemon writes to
    :param wake: descriptor that becomes readable when this process is told to end
    """
    buffer = b""
    poll = select.poll()
    for each in (inlet, wake):
        poll.register(each, select.POLLIN | select.POLLHUP)
    while not guard.done:
        wait = guard.wait()
        # Rounded up: a wait of 0 ms for the last half millisecond would be a busy loop.
        ready = {each for each, _ in poll.poll(None if wait is None else int(wait * 1000) + 1)}
        if wake in ready:
            poll.unregister(wake)
            guard.orphaned()
        if inlet in ready:
            data = os.read(inlet, 65536)
            *lines, buffer = (buffer + data).split(b"\n")
            for line in lines:
                _serve(guard, line)
            if not data:
                poll.unregister(inlet)
                if not guard.leaving:
                    guard.orphaned()
        guard.act()
        for topic in guard.take_ready():
            _answer(Ready(topic))


def _serve(guard: Guard, line: bytes) -> None:
    try:
        if guard.take(decoder.decode(line)):
            _answer(Alive())
    except msgspec.MsgspecError:
        _say("a line of the daemon made no sense")
    except Exception as error:  # a topic it can't guard must not keep it from guarding the others
        _say(f"a line of the daemon could not be followed: {error}")


def _answer(answer: Alive | Ready) -> None:
    with contextlib.suppress(BrokenPipeError):  # the daemon is gone; the end of the other pipe says so too
        os.write(1, encode(answer))


def _say(text: str) -> None:
    try:
        sys.stderr.write(f"guard: {text}\n")
    except OSError:
        return  # the daemon's log is gone with it


def _wake_on_sigterm() -> int:
    wake, signalled = os.pipe()
    os.set_blocking(signalled, False)
    signal.set_wakeup_fd(signalled)
    signal.signal(signal.SIGTERM, lambda *_: None)
    for ignored in (signal.SIGINT, signal.SIGHUP, signal.SIGPIPE):
        signal.signal(ignored, signal.SIG_IGN)
    return wake


@click.command()
@click.option("--node", required=True, help="Name of the guard's node.")
@click.option("--within-ms", type=int, required=True, help="Time to stop, milliseconds.")
def main(node: str, within_ms: int) -> None:
    """Stop the robot when the daemon that started this can't."""
    with contextlib.suppress(PermissionError):  # a leader of its own already
        os.setsid()  # what ends the daemon's group or terminal must not end its guard
    wake = _wake_on_sigterm()
    guard = Guard(within_ms, RosOutlets(node), time.monotonic_ns)
    _answer(Alive())
    watch(guard, 0, wake)
    # Publishers are not taken down in order: Python's and DDS's farewells take longer than the stop is worth.
    os._exit(0)


if __name__ == "__main__":
    main()
