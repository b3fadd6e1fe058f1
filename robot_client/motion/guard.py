"""The guard: a small process that stops the robot when the daemon can't, because it was killed or is frozen.

The daemon starts it (``python -m robot_client.motion.guard``). It has a node and publishers of its own. Over its
standard input it receives every motion command, and goals that move the robot. The end of that pipe means that the
daemon has ended.
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
from robot_client.motion.command_age import MILLI
from robot_client.motion.guard_protocol import (
    CANCEL_TYPE,
    Forget,
    GuardAlive,
    GuardedCommand,
    GuardedTopic,
    Line,
    Probe,
    ShutDown,
    TopicReady,
    ZeroTemplate,
    decoder,
    encode,
)
from robot_client.motion.typed_topic import TypedTopic
from robot_client.motion.watchdog import GUARD_SHARE, STOP_ZERO_EVERY, STOP_ZEROS, Watchdog
from robot_client.ros_log import ensure_log_folder

NANO = 1_000_000_000
MATCH_CHECK_MIN = 20 * MILLI
MATCH_CHECK_MAX = 500 * MILLI
"""Nanoseconds between checks whether a new publisher has matched a subscriber; the pause grows with the wait."""

NICE = -10
"""Scheduling priority (``setpriority(2)``), where permitted: the guard does little, but must do it at once."""

PUBLISHERS = 4
"""Most publishers of one topic."""

UNMATCHED_REPEAT_NS = 10 * NANO
"""Nanoseconds that zero is repeated on a topic while no subscriber has been matched."""


LATE_CANCELS = 9
LATE_CANCEL_EVERY = 200 * MILLI
"""Further requests to cancel goals after those of a stop, and nanoseconds between them."""


class StopOutputs(Protocol):
    """Publishers of zero, and clients of the services that cancel goals: for an action, cancelling counts as zero."""

    def open(self, topic: TypedTopic) -> None:
        """Create a publisher, or a client of a cancel service."""

    def close(self, topic: TypedTopic) -> None:
        """Remove the publisher or client, if there is one."""

    def zero(self, topic: TypedTopic, zero_template: bytes) -> bool:
        """Publish zero, shaped as ``zero_template``, or cancel all goals; whether a subscriber or server is matched."""

    def is_matched(self, topic: TypedTopic) -> bool:
        """Whether a subscriber, or the action's server, is matched."""


class _PendingZeros:
    """The zeros that are left of a stop on one topic; times in nanoseconds.

    All are due from the first match on: the other side may not know of this one yet, and miss the first. Requests to
    cancel goals go on for two seconds, as an action's server may be matched that has just died, before the one that
    has taken its place.
    """

    def __init__(self, topic: TypedTopic, now: int) -> None:
        self.next = now
        self._late = LATE_CANCELS if topic.type == CANCEL_TYPE else 0
        self._left = STOP_ZEROS + self._late
        self._until = now + UNMATCHED_REPEAT_NS
        self._matched = False

    def published(self, matched: bool, now: int) -> bool:
        """Count a zero; return whether it was the last.

        :param matched: whether a subscriber or server was there
        """
        if matched and not self._matched:
            self._matched, self._left = True, STOP_ZEROS + self._late
        self._left -= 1
        self.next = now + (STOP_ZERO_EVERY if self._left >= self._late else LATE_CANCEL_EVERY)
        return self._left <= 0 and (matched or now >= self._until)


class Guard:
    """Decides when to stop which topic; only ``outputs`` has side effects.

    :param within_ms: time to stop, milliseconds
    :param now: clock of :mod:`relay_protocol.clocks`, nanoseconds; the daemon uses the same
    """

    def __init__(self, within_ms: int, outputs: StopOutputs, now: Callable[[], int]) -> None:
        self.shutting_down = False
        self._outputs = outputs
        self._now = now
        self._watchdog = Watchdog(within_ms, GUARD_SHARE)
        self._stops: dict[TypedTopic, _PendingZeros] = {}
        self._unmatched: dict[TypedTopic, tuple[int, int]] = {}
        """Topics whose publisher has matched no subscriber yet: when to check again, and since when; nanoseconds."""
        self._ready: list[TypedTopic] = []
        self._unused: set[TypedTopic] = set()
        self._zero_templates: dict[TypedTopic, bytes] = {}

    def handle(self, line: Line) -> bool:
        """Handle one line from the daemon; return whether to answer it."""
        if isinstance(line, GuardedTopic):
            self._unused.discard(line.typed_topic)
            self._unmatched[line.typed_topic] = (self._now(), self._now())
            if line.within_ms:
                self._watchdog.set_time_to_stop(line.topic, line.within_ms)
            self._outputs.open(line.typed_topic)
        elif isinstance(line, ZeroTemplate):
            self._zero_templates[line.typed_topic] = line.zero_template
        elif isinstance(line, Forget):
            self._unused.add(line.typed_topic)
            self._close_unused()
        elif isinstance(line, GuardedCommand):
            self._stops.pop(line.typed_topic, None)
            self._watchdog.note_command(line.typed_topic, "daemon", line.moving, line.at)
        elif isinstance(line, ShutDown):
            self._begin_stops(self._watchdog.take_all())
            self.shutting_down = True
        return isinstance(line, Probe)

    def daemon_lost(self) -> None:
        """Stop all topics that move, as the daemon is gone; then shut down."""
        self._begin_stops(self._watchdog.take_all())
        self.shutting_down = True
        self.act()

    def take_ready(self) -> list[TypedTopic]:
        """Topics that the guard has become able to stop since the last call."""
        ready, self._ready = self._ready, []
        return ready

    def act(self) -> None:
        """Publish every zero that is due."""
        now = self._now()
        self._check_matched(now)
        self._begin_stops(self._watchdog.take_expired(now))
        for topic, stop in list(self._stops.items()):
            if stop.next > now:
                continue
            if stop.published(self._zero(topic), now):
                del self._stops[topic]
        self._close_unused()

    def wait(self) -> float | None:
        """Seconds until :meth:`act` has something to do; ``None``: nothing until a line comes."""
        times = [stop.next for stop in self._stops.values()] + [due for due, _ in self._unmatched.values()]
        due = self._watchdog.due()
        if due is not None:
            times.append(due)
        return max(0.0, (min(times) - self._now()) / NANO) if times else None

    @property
    def done(self) -> bool:
        """Whether the guard is shutting down and every stop is complete."""
        return self.shutting_down and not self._stops

    def _check_matched(self, now: int) -> None:
        for topic, (due, since) in list(self._unmatched.items()):
            if due > now:
                continue
            if self._has_subscriber(topic):
                del self._unmatched[topic]
                self._ready.append(topic)
            else:
                pause = min(max((now - since) // 10, MATCH_CHECK_MIN), MATCH_CHECK_MAX)
                self._unmatched[topic] = (now + pause, since)

    def _has_subscriber(self, topic: TypedTopic) -> bool:
        try:
            return self._outputs.is_matched(topic)
        except Exception:  # no publisher yet: one of another type may not be removed yet
            return False

    def _zero(self, topic: TypedTopic) -> bool:
        try:
            return self._outputs.zero(topic, self._zero_templates.get(topic, b""))
        except Exception as error:  # a failure on one topic must not prevent the stop of the next
            _log(f"could not stop {topic}: {error}")
            return False

    def _begin_stops(self, topics: list[TypedTopic]) -> None:
        for topic in topics:
            self._stops[topic] = _PendingZeros(topic, self._now())

    def _close_unused(self) -> None:
        for topic in list(self._unused):
            if topic not in self._stops and not self._watchdog.moves(topic):
                self._unused.discard(topic)
                self._unmatched.pop(topic, None)
                self._zero_templates.pop(topic, None)
                self._outputs.close(topic)


class RosStopOutputs:
    """Publishers and clients in a node of their own; the node never spins, so waiting costs nothing.

    :param name: of the node
    :param sim_time: whether the robot's time comes from ``/clock``. The guard does not subscribe to it and leaves
        stamps at 0, which controllers treat as now; the machine's time would be far in the future of a simulation
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
        self._unset_stamp = Time() if sim_time else None
        self._types = Types()
        self._publishers: dict[TypedTopic, list[tuple[Any, Any]]] = {}
        """By topic, publishers with their quality of service: one, and more where subscribers request a QoS that those
        before do not offer."""
        self._clients: dict[TypedTopic, Any] = {}

    def open(self, topic: TypedTopic) -> None:
        """Create a publisher, or a client for :data:`CANCEL_TYPE`."""
        if topic.type == CANCEL_TYPE:
            self._client(topic)
        else:
            self._matching_publishers(topic)

    def close(self, topic: TypedTopic) -> None:
        """Remove the publishers or the client."""
        client = self._clients.pop(topic, None)
        if client is not None:
            self._node.destroy_client(client)
        for publisher, _ in self._publishers.pop(topic, ()):
            self._node.destroy_publisher(publisher)

    def zero(self, topic: TypedTopic, zero_template: bytes) -> bool:
        """Publish zero, or request to cancel all goals without waiting for the response."""
        if topic.type == CANCEL_TYPE:
            return self._cancel(topic)
        stamp = self._unset_stamp or self._node.get_clock().now().to_msg()
        zero = self._types.zero_command(topic.type, stamp, zero_template)
        for publisher, _ in self._publishers.get(topic) or self._matching_publishers(topic):
            publisher.publish(zero)
        return self.is_matched(topic)

    def is_matched(self, topic: TypedTopic) -> bool:
        """Whether DDS has matched a subscription, or the action's server."""
        if topic.type == CANCEL_TYPE:
            return bool(self._client(topic).service_is_ready())
        # The latest publisher serves every subscriber that the earlier ones serve.
        return bool(self._matching_publishers(topic)[-1][0].get_subscription_count())

    def _matching_publishers(self, topic: TypedTopic) -> list[tuple[Any, Any]]:
        """The publishers of a topic; creates one more where the others do not serve every subscriber."""
        from relay_protocol.link import QoS
        from robot_client.platforms.ros2 import qos

        found = self._publishers.setdefault(topic, [])
        requested = [each.qos_profile for each in self._node.get_subscriptions_info_by_topic(topic.name)]
        unserved = [each for each in requested if all(qos.mismatch(ours, each) for _, ours in found)]
        if not found or (unserved and len(found) < PUBLISHERS):
            profile = qos.for_publisher(requested, False, QoS(durability="volatile", depth=10))
            if not found or not all(qos.mismatch(profile, each) for each in unserved):
                kind = self._types.message(topic.type)
                found.append((self._node.create_publisher(kind, topic.name, profile), profile))
        return found

    def _cancel(self, topic: TypedTopic) -> bool:
        client = self._client(topic)
        if not client.service_is_ready():
            return False
        # A zero goal id and a zero time mean all goals (action_msgs/srv/CancelGoal).
        client.remove_pending_request(client.call_async(self._types.service(topic.type).Request()))
        return True

    def _client(self, topic: TypedTopic) -> Any:
        found = self._clients.get(topic)
        if found is None:
            found = self._clients[topic] = self._node.create_client(
                self._types.service(topic.type), topic.name
            )
        return found


def serve(guard: Guard, input_fd: int, output_fd: int, wake: int) -> None:
    """Run the guard until the daemon is gone and every stop is complete.

    :param input_fd: descriptor from which lines of the daemon are read
    :param output_fd: descriptor to which answers are written
    :param wake: descriptor that becomes readable on SIGTERM
    """
    buffer = b""
    poll = select.poll()
    for each in (input_fd, wake):
        poll.register(each, select.POLLIN | select.POLLHUP)
    while not guard.done:
        wait = guard.wait()
        # Rounded up: waiting 0 ms for the last half millisecond would be a busy loop.
        ready = {each for each, _ in poll.poll(None if wait is None else int(wait * 1000) + 1)}
        if wake in ready:
            poll.unregister(wake)
            guard.daemon_lost()
        if input_fd in ready:
            data = os.read(input_fd, 65536)
            *lines, buffer = (buffer + data).split(b"\n")
            for line in lines:
                if _take_line(guard, line):
                    _answer(output_fd, GuardAlive())
            if not data:
                poll.unregister(input_fd)
                if not guard.shutting_down:
                    guard.daemon_lost()
        guard.act()
        for topic in guard.take_ready():
            _answer(output_fd, TopicReady(topic.name, topic.type))


def _take_line(guard: Guard, line: bytes) -> bool:
    try:
        return guard.handle(decoder.decode(line))
    except msgspec.MsgspecError:
        _log("a line of the daemon could not be decoded")
    except Exception as error:  # a failure on one topic must not end the guard of the others
        _log(f"a line of the daemon could not be handled: {error}")
    return False


def _answer(output_fd: int, answer: GuardAlive | TopicReady) -> None:
    with contextlib.suppress(BrokenPipeError):  # the daemon is gone; the end of the other pipe shows it too
        os.write(output_fd, encode(answer))


def _reserve_stdout() -> int:
    """Reserve standard output for answers, as RCUTILS_LOGGING_USE_STDOUT makes ROS log there; return its descriptor."""
    output_fd = os.dup(1)
    os.dup2(2, 1)
    return output_fd


def _log(text: str) -> None:
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
@click.option("--sim-time", is_flag=True, help="The robot's time comes from /clock.")
def main(node: str, within_ms: int, sim_time: bool) -> None:
    """Stop the robot when the daemon that started this process can't."""
    with contextlib.suppress(PermissionError):  # a leader of its own already
        os.setsid()  # a signal to the daemon's process group or terminal must not end the guard
    with contextlib.suppress(PermissionError):  # works without, but late on a busy computer
        os.setpriority(os.PRIO_PROCESS, 0, NICE)
    output_fd = _reserve_stdout()
    wake = _wake_on_sigterm()
    guard = Guard(within_ms, RosStopOutputs(node, sim_time), now_ns)
    _answer(output_fd, GuardAlive())
    serve(guard, 0, output_fd, wake)
    # Skip the orderly shutdown of Python and DDS: it takes longer than the stop.
    os._exit(0)


if __name__ == "__main__":
    main()
