"""The guard: a small process that stops the robot when the daemon can't, because it was killed or is frozen.

It is started by the daemon (``python -m robot_client.motion.guard``), has a node and publishers of its own, and
hears of every motion command over its standard input, and of goals that move the robot. The end of that pipe is the end
of the daemon.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
from collections.abc import Callable
from typing import Any, Protocol

import click
import msgspec

from relay_protocol.clocks import now_ns
from robot_client.motion.guard_protocol import (
    CANCEL_TYPE,
    Forget,
    GuardAlive,
    GuardedCommand,
    GuardedTopic,
    Leave,
    Line,
    Probe,
    TopicReady,
    ZeroShape,
    decoder,
    encode,
)
from robot_client.motion.safety import GUARD_SHARE, MILLI, REPEAT_EVERY, REPEATS, Watchdog
from robot_client.motion.typed_topic import TypedTopic
from robot_client.ros_log import ensure_log_folder

NANO = 1_000_000_000
LOOK_EVERY = 20 * MILLI
LOOK_SELDOM = 500 * MILLI
"""How often to look whether a new publisher has found its listeners: the less the longer nobody was there."""

NICE = -10
"""The guard does little, and that at once: its scheduling priority, if it may have it (``setpriority(2)``)."""

PUBLISHERS = 4
"""Most publishers of one topic."""

UNHEARD = 10 * NANO
"""How much longer to repeat while nobody who listens to the topic was found yet, after the daemon's end."""


class Outlets(Protocol):
    """Publishers of zero, and clients of the services that cancel goals, which is zero for an action."""

    def open(self, on: TypedTopic) -> None:
        """Have a publisher ready."""

    def close(self, on: TypedTopic) -> None:
        """Take the publisher away, if there is one."""

    def zero(self, on: TypedTopic, rest: bytes) -> bool:
        """Publish zero, of the shape that the last command had; whether anybody listens."""

    def heard(self, on: TypedTopic) -> bool:
        """Whether anybody listens."""


class _RepeatedStop:
    """A stop being repeated."""

    def __init__(self, now: int) -> None:
        self.left = REPEATS
        self.next = now
        self.until = now + UNHEARD


class Guard:
    """Decides; pure but for the outlets.

    :param now: clock of :mod:`relay_protocol.clocks`, nanoseconds, the same the daemon has
    """

    def __init__(self, within_ms: int, outlets: Outlets, now: Callable[[], int]) -> None:
        self.leaving = False
        self._outlets = outlets
        self._now = now
        self._watchdog = Watchdog(within_ms, GUARD_SHARE)
        self._stops: dict[TypedTopic, _RepeatedStop] = {}
        self._unready: dict[TypedTopic, tuple[int, int]] = {}
        self._ready: list[TypedTopic] = []
        self._unused: set[TypedTopic] = set()
        self._rests: dict[TypedTopic, bytes] = {}

    def take(self, line: Line) -> bool:
        """One line from the daemon; whether it wants an answer."""
        if isinstance(line, GuardedTopic):
            self._unused.discard(line.on)
            self._unready[line.on] = (self._now(), self._now())
            if line.within_ms:
                self._watchdog.within(line.topic, line.within_ms)
            self._outlets.open(line.on)
        elif isinstance(line, ZeroShape):
            self._rests[line.on] = line.rest
        elif isinstance(line, Forget):
            self._unused.add(line.on)
            self._withdraw()
        elif isinstance(line, GuardedCommand):
            self._stops.pop(line.on, None)
            self._watchdog.command(line.on, "daemon", line.moving, line.at)
        elif isinstance(line, Leave):
            self._begin(self._watchdog.everything())
            self.leaving = True
        return isinstance(line, Probe)

    def orphaned(self) -> None:
        """The daemon is gone: stop what it left moving, then leave."""
        self._begin(self._watchdog.everything())
        self.leaving = True
        self.act()

    def take_ready(self) -> list[TypedTopic]:
        """Topics it has become able to stop since it was asked last."""
        ready, self._ready = self._ready, []
        return ready

    def act(self) -> None:
        """Do what is due."""
        now = self._now()
        self._look(now)
        self._begin(self._watchdog.expired(now))
        for on, stop in list(self._stops.items()):
            if stop.next > now:
                continue
            heard = self._zero(on)
            stop.left -= 1
            stop.next = now + REPEAT_EVERY
            if stop.left <= 0 and (heard or now >= stop.until):
                del self._stops[on]
        self._withdraw()

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
        for on, (due, since) in list(self._unready.items()):
            if due > now:
                continue
            if self._heard(on):
                del self._unready[on]
                self._ready.append(on)
            else:
                pause = min(max((now - since) // 10, LOOK_EVERY), LOOK_SELDOM)
                self._unready[on] = (now + pause, since)

    def _heard(self, on: TypedTopic) -> bool:
        try:
            return self._outlets.heard(on)
        except Exception:  # no publisher yet; a former one of another type may be on its way out
            return False

    def _zero(self, on: TypedTopic) -> bool:
        try:
            return self._outlets.zero(on, self._rests.get(on, b""))
        except Exception as error:  # one topic that fails must not keep the next from its stop
            _say(f"could not stop {on}: {error}")
            return False

    def _begin(self, topics: list[TypedTopic]) -> None:
        for on in topics:
            self._stops[on] = _RepeatedStop(self._now())

    def _withdraw(self) -> None:
        for on in list(self._unused):
            if on not in self._stops and not self._watchdog.moves(on):
                self._unused.discard(on)
                self._unready.pop(on, None)
                self._rests.pop(on, None)
                self._outlets.close(on)


class RosOutlets:
    """Publishers and clients in a node of their own; nothing spins, so the node costs nothing while it waits.

    :param sim_time: whether the robot's time is what ``/clock`` says. The guard does not listen to it and leaves stamps
        at 0, which controllers take for now; the machine's time would lie far in the future of a simulation
    """

    def __init__(self, name: str, sim_time: bool) -> None:
        import rclpy
        from builtin_interfaces.msg import Time
        from rclpy.signals import SignalHandlerOptions

        from robot_client.platforms.ros2.transport import without_shared_memory
        from robot_client.platforms.ros2.types import Types

        ensure_log_folder()
        with without_shared_memory(rclpy.get_rmw_implementation_identifier()):
            rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
            self._node: Any = rclpy.create_node(name, start_parameter_services=False, enable_rosout=False)
        self._unknown = Time() if sim_time else None
        self._types = Types()
        self._publishers: dict[TypedTopic, list[tuple[Any, Any]]] = {}
        """Of each topic the publishers, with their quality of service: one, and one more for subscribers that ask for
        more."""
        self._clients: dict[TypedTopic, Any] = {}

    def open(self, on: TypedTopic) -> None:
        """Have a publisher ready, or a client."""
        if on.type == CANCEL_TYPE:
            self._client(on)
        else:
            self._fit(on)

    def close(self, on: TypedTopic) -> None:
        """Take it away."""
        client = self._clients.pop(on, None)
        if client is not None:
            self._node.destroy_client(client)
        for publisher, _ in self._publishers.pop(on, ()):
            self._node.destroy_publisher(publisher)

    def zero(self, on: TypedTopic, rest: bytes) -> bool:
        """Publish zero, or ask to cancel all goals; nobody waits for an answer."""
        if on.type == CANCEL_TYPE:
            return self._cancel(on)
        stamp = self._unknown or self._node.get_clock().now().to_msg()
        zero = self._types.zero(on.type, stamp, rest)
        for publisher, _ in self._publishers.get(on) or self._fit(on):
            publisher.publish(zero)
        return self.heard(on)

    def heard(self, on: TypedTopic) -> bool:
        """Whether DDS has matched a subscription, or the action's server."""
        if on.type == CANCEL_TYPE:
            return bool(self._client(on).service_is_ready())
        # The latest serves all whom those before it serve.
        return bool(self._fit(on)[-1][0].get_subscription_count())

    def _fit(self, on: TypedTopic) -> list[tuple[Any, Any]]:
        """The publishers of a topic, with one more where there are subscribers that the others do not serve."""
        from relay_protocol.link import QoS
        from robot_client.platforms.ros2 import qos

        found = self._publishers.setdefault(on, [])
        theirs = [each.qos_profile for each in self._node.get_subscriptions_info_by_topic(on.topic)]
        left = [each for each in theirs if all(qos.mismatch(ours, each) for _, ours in found)]
        if not found or (left and len(found) < PUBLISHERS):
            profile = qos.for_publisher(theirs, False, QoS(durability="volatile", depth=10))
            if not found or not all(qos.mismatch(profile, each) for each in left):
                kind = self._types.message(on.type)
                found.append((self._node.create_publisher(kind, on.topic, profile), profile))
        return found

    def _cancel(self, on: TypedTopic) -> bool:
        client = self._client(on)
        if not client.service_is_ready():
            return False
        # No goal's id and no time: all of them.
        client.remove_pending_request(client.call_async(self._types.service(on.type).Request()))
        return True

    def _client(self, on: TypedTopic) -> Any:
        found = self._clients.get(on)
        if found is None:
            found = self._clients[on] = self._node.create_client(self._types.service(on.type), on.topic)
        return found


def watch(guard: Guard, inlet: int, outlet: int, wake: int) -> None:
    """Serve until the daemon is gone and the robot stands.

    :param inlet: descriptor the daemon writes to
    :param outlet: descriptor the daemon reads
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
                if _serve(guard, line):
                    _answer(outlet, GuardAlive())
            if not data:
                poll.unregister(inlet)
                if not guard.leaving:
                    guard.orphaned()
        guard.act()
        for on in guard.take_ready():
            _answer(outlet, TopicReady(*on))


def _serve(guard: Guard, line: bytes) -> bool:
    try:
        return guard.take(decoder.decode(line))
    except msgspec.MsgspecError:
        _say("a line of the daemon made no sense")
    except Exception as error:  # a topic it can't guard must not keep it from guarding the others
        _say(f"a line of the daemon could not be followed: {error}")
    return False


def _answer(outlet: int, answer: GuardAlive | TopicReady) -> None:
    with contextlib.suppress(BrokenPipeError):  # the daemon is gone; the end of the other pipe says so too
        os.write(outlet, encode(answer))


def _own_stdout() -> int:
    """Take standard output for answers alone: ROS can be told to log there (RCUTILS_LOGGING_USE_STDOUT)."""
    outlet = os.dup(1)
    os.dup2(2, 1)
    return outlet


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
@click.option("--sim-time", is_flag=True, help="The robot's time is what /clock says.")
def main(node: str, within_ms: int, sim_time: bool) -> None:
    """Stop the robot when the daemon that started this can't."""
    with contextlib.suppress(PermissionError):  # a leader of its own already
        os.setsid()  # what ends the daemon's group or terminal must not end its guard
    with contextlib.suppress(PermissionError):  # it works without, and is late where the computer is busy
        os.setpriority(os.PRIO_PROCESS, 0, NICE)
    outlet = _own_stdout()
    wake = _wake_on_sigterm()
    guard = Guard(within_ms, RosOutlets(node, sim_time), now_ns)
    _answer(outlet, GuardAlive())
    watch(guard, 0, outlet, wake)
    # Publishers are not taken down in order: Python's and DDS's farewells take longer than the stop is worth.
    os._exit(0)


if __name__ == "__main__":
    main()
