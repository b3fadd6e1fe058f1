"""The thread that runs ROS callbacks, and calls from there to the reactor's thread."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from twisted.internet.interfaces import IReadDescriptor
from twisted.logger import Logger
from zope.interface import implementer

from relay_protocol.limits import MIB

SPIN_SECONDS = 0.5
"""Longest time of one ``spin_once``; the first callback ends it. ``spin`` of rclpy 7.1's EventsExecutor
hangs, ``spin_once`` does not.
"""

FAILURE_PAUSE = 0.05
"""Seconds between a failed ``spin_once`` and the next."""

STUCK_SECONDS = 5.0
"""Seconds without a callback after which the executor counts as stuck."""

MAX_BACKLOG = 32 * MIB
"""Most bytes of samples that wait for the reactor, so that a stall does not exhaust the robot's memory."""


def make_executor(kind: str, context: Any) -> Any:
    """Create an executor.

    :param kind: ``events`` (a fifth of the load) if this rclpy has it; otherwise, and for ``single``, the
        plain one
    """
    if kind == "events":
        try:
            from rclpy.experimental.events_executor import EventsExecutor

            return EventsExecutor(context=context)
        except ImportError:
            Logger("ros2").info("this rclpy has no EventsExecutor; the single-threaded one is used")
    from rclpy.executors import SingleThreadedExecutor

    return SingleThreadedExecutor(context=context)


class Spinner:
    """Spins an executor in its own thread. A timer of the node shows whether it still works.

    :param timer_clock: clock of rclpy for that timer; it must never stop
    :param clock: seconds
    """

    def __init__(
        self, executor: Any, node: Any, timer_clock: Any, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.node = node
        self._executor = executor
        self._clock = clock
        self._stopping = False
        self._last_callback = clock()
        self._thread = threading.Thread(target=self._spin, name="ros2-executor", daemon=True)
        self._timer = node.create_timer(1.0, self._note_callback, clock=timer_clock)
        self._calls: deque[tuple[Callable[..., Any], tuple[Any, ...]]] = deque()
        self._lock = threading.Lock()
        self._scheduled = False
        self._log = Logger("ros2")
        executor.add_node(node)

    def start(self) -> None:
        """Start the thread."""
        self._last_callback = self._clock()
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread; waits for it at most 2 s."""
        self._stopping = True
        if self._thread.is_alive():
            self._executor.create_task(_nothing)  # ends spin_once
            self._thread.join(2.0)
        if not self._thread.is_alive():
            self._run_calls()
            self._executor.shutdown()

    def call(self, function: Callable[..., Any], *arguments: Any) -> None:
        """Call a function on the executor's thread, in order; from any thread.

        rclpy's state of open requests may only be used there: a response that is taken before another
        thread has stored the number of its request is discarded.
        """
        with self._lock:
            self._calls.append((function, arguments))
            if self._scheduled or self._stopping:
                return
            self._scheduled = True
        # One task for all: the single-threaded executor runs tasks in no order.
        self._executor.create_task(self._run_calls)

    def _run_calls(self) -> None:
        with self._lock:
            calls, self._calls = self._calls, deque()
            self._scheduled = False
        for function, arguments in calls:
            try:
                function(*arguments)
            except Exception:
                self._log.failure("a call of ROS 2 failed")

    def fault(self) -> str | None:
        """A sentence that says that the executor is stuck; ``None``: a callback ran within :data:`STUCK_SECONDS`."""
        silent = self._clock() - self._last_callback
        if silent > STUCK_SECONDS:
            return f"the ROS 2 executor has run no callback for {silent:.0f} s"
        return None

    def _note_callback(self) -> None:
        self._last_callback = self._clock()

    def _spin(self) -> None:
        while not self._stopping:
            try:
                self._executor.spin_once(timeout_sec=SPIN_SECONDS)
            except Exception:
                self._spin_failed()

    def _spin_failed(self) -> None:
        if not self._stopping:
            self._log.failure("a ROS callback failed")
            time.sleep(FAILURE_PAUSE)  # an executor that always fails at once must not use a whole core


def _nothing() -> None:
    pass


@implementer(IReadDescriptor)
class EventFdWaker:
    """Wakes the reactor from any thread by an eventfd(2).

    The reactor's own waker costs both threads about twenty Python calls more each time.

    :param on_wake: called on the reactor's thread, once for all wakes so far
    :param on_lost: called when the reactor stops reading it
    :raises OSError: there is no file descriptor left
    """

    def __init__(self, reactor: Any, on_wake: Callable[[], None], on_lost: Callable[[], None]) -> None:
        self._reactor = reactor
        self._on_wake = on_wake
        self._on_lost = on_lost
        # A file object, since a bare descriptor could be reused for another file after it is closed.
        descriptor = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._file = os.fdopen(descriptor, "r+b", buffering=0)
        self.fileno = self._file.fileno
        self.wake: Callable[[], Any] = partial(self._file.write, (1).to_bytes(8, sys.byteorder))
        reactor.addReader(self)

    def doRead(self) -> None:
        self._file.read(8)
        self._on_wake()

    def logPrefix(self) -> str:
        """Prefix in the reactor's log."""
        return "ros2"

    def connectionLost(self, reason: Any) -> None:
        self._on_lost()

    def close(self) -> None:
        """Stop waking the reactor."""
        self._reactor.removeReader(self)
        self._file.close()


class ReactorBridge:
    """Passes calls to the reactor's thread, in batches.

    :param call_from_thread: of the reactor
    """

    def __init__(self, call_from_thread: Callable[[Callable[[], None]], Any]) -> None:
        self.dropped = 0
        self._call_from_thread: Callable[[], Any] = partial(call_from_thread, self._drain)
        self._wake: Callable[[], Any] = self._call_from_thread
        self._waker: EventFdWaker | None = None
        self._queue: deque[tuple[Callable[[Any], None], Any]] = deque()
        self._size = 0
        self._lock = threading.Lock()
        self._scheduled = False
        self._after: list[Callable[[], None]] = []
        self._losses: dict[Callable[[int], None], int] = {}
        """Samples that were dropped since the last batch, by what is called with their number."""

    def open(self, reactor: Any) -> None:
        """Use an eventfd to wake the reactor, if the system has it."""
        if not hasattr(os, "eventfd"):  # not Linux
            return
        try:
            self._waker = EventFdWaker(reactor, self._drain, self.close)
        except OSError as error:
            Logger("ros2").warn("no eventfd is available: {reason}", reason=error.strerror)
            return
        self._wake = self._waker.wake

    def close(self) -> None:
        """Use the reactor's own waker from now on."""
        waker, self._waker = self._waker, None
        if waker is None:
            return
        self._wake = self._call_from_thread
        waker.close()
        with self._lock:
            pending = self._scheduled
        if pending:
            self._call_from_thread()

    def after(self, call: Callable[[], None]) -> None:
        """Call once at the end of the current batch; from the reactor's thread."""
        self._after.append(call)

    def put(
        self,
        function: Callable[[Any], None],
        argument: Any,
        size: int | None = 0,
        on_dropped: Callable[[int], None] | None = None,
    ) -> None:
        """Call ``function(argument)`` on the reactor's thread; from any thread.

        :param size: bytes of a sample, which is dropped if too many wait; ``None`` if the argument is the
            sample; 0 for calls that must not be dropped
        :param on_dropped: called with the number of dropped samples, after those that wait
        """
        if size is None:
            size = len(argument)
        with self._lock:
            # If nothing waits, a sample of any size is accepted.
            if size and self._size and self._size + size > MAX_BACKLOG:
                self.dropped += 1
                if on_dropped is not None:
                    self._losses[on_dropped] = self._losses.get(on_dropped, 0) + 1
                return
            self._size += size
            self._queue.append((function, argument))
            if self._scheduled:
                return
            self._scheduled = True
        self._wake()

    def _drain(self) -> None:
        with self._lock:
            batch, self._queue = self._queue, deque()
            batch += self._losses.items()
            self._losses.clear()
            self._size = 0
            self._scheduled = False
        for function, argument in batch:
            try:
                function(argument)
            except Exception:  # must not affect other receivers
                Logger("ros2").failure("a sample could not be passed on")
        after, self._after = self._after, []
        for call in after:
            try:
                call()
            except Exception:
                Logger("ros2").failure("samples could not be passed on")
