"""The thread that serves ROS callbacks, and the way from there to the reactor."""

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

TURN = 0.5
"""Seconds of one turn of the executor; the first callback ends it. ``spin`` of rclpy 7.1's EventsExecutor hangs; single
turns don't.
"""

BREATH = 0.05
"""Seconds without a turn after one that failed."""

STUCK_SECONDS = 5.0
BACKLOG = 32 * MIB
"""Bytes of samples that may wait for the reactor: a stall must not eat the robot's memory."""


def make_executor(kind: str, context: Any) -> Any:
    """An executor of rclpy.

    :param kind: ``events`` where this rclpy has it (a fifth of the load), else and for ``single`` the plain one
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
    """Turns an executor in a thread of its own and knows, by a timer of the node, whether it still serves.

    :param timer_clock: of rclpy, for that timer; one that never stands still
    :param clock: seconds
    """

    def __init__(
        self, executor: Any, node: Any, timer_clock: Any, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.node = node
        self._executor = executor
        self._clock = clock
        self._stopping = False
        self._served = clock()
        self._thread = threading.Thread(target=self._turn, name="ros2-executor", daemon=True)
        self._timer = node.create_timer(1.0, self._beat, clock=timer_clock)
        self._work: deque[tuple[Callable[..., Any], tuple[Any, ...]]] = deque()
        self._lock = threading.Lock()
        self._scheduled = False
        self._log = Logger("ros2")
        executor.add_node(node)

    def start(self) -> None:
        """Begin to turn."""
        self._served = self._clock()
        self._thread.start()

    def stop(self) -> None:
        """Turn no more; waits for the turn under way, not for ever."""
        self._stopping = True
        if self._thread.is_alive():
            self._executor.create_task(_nothing)  # ends the turn
            self._thread.join(2.0)
        if not self._thread.is_alive():
            self._do_all()
            self._executor.shutdown()

    def do(self, function: Callable[..., Any], *arguments: Any) -> None:
        """Have a function called in the executor's thread, in order; from any thread.

        What rclpy keeps of requests under way may only be touched there: an answer taken while another thread has sent
        the request and not yet noted its number is thrown away.
        """
        with self._lock:
            self._work.append((function, arguments))
            if self._scheduled or self._stopping:
                return
            self._scheduled = True
        # One task for all: the single-threaded executor runs tasks in no order.
        self._executor.create_task(self._do_all)

    def _do_all(self) -> None:
        with self._lock:
            work, self._work = self._work, deque()
            self._scheduled = False
        for function, arguments in work:
            try:
                function(*arguments)
            except Exception:
                self._log.failure("ROS 2 could not do what was asked of it")

    def trouble(self) -> str | None:
        """A sentence when callbacks have not been served for :data:`STUCK_SECONDS`."""
        silent = self._clock() - self._served
        if silent > STUCK_SECONDS:
            return f"the ROS 2 executor has served nothing for {silent:.0f} s"
        return None

    def _beat(self) -> None:
        self._served = self._clock()

    def _turn(self) -> None:
        while not self._stopping:
            try:
                self._executor.spin_once(timeout_sec=TURN)
            except Exception:
                self._turn_failed()

    def _turn_failed(self) -> None:
        if not self._stopping:
            self._log.failure("a ROS callback failed")
            time.sleep(BREATH)  # an executor that fails at once each time must not take the processor


def _nothing() -> None:
    pass


@implementer(IReadDescriptor)
class EventFdWaker:
    """Wakes the reactor from any thread by an eventfd (eventfd(2)).

    The reactor's own way costs the ringing thread and the reactor some twenty Python calls more each time.

    :param answer: called on the reactor's thread, once for all rings so far
    :param lost: called when the reactor no longer listens
    :raises OSError: there is no file descriptor left
    """

    def __init__(self, reactor: Any, answer: Callable[[], None], lost: Callable[[], None]) -> None:
        self._reactor = reactor
        self._answer = answer
        self._lost = lost
        # A closed file refuses what a bare number would write into the next file of that number.
        made = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._file = os.fdopen(made, "r+b", buffering=0)
        self.fileno = self._file.fileno
        self.ring: Callable[[], Any] = partial(self._file.write, (1).to_bytes(8, sys.byteorder))
        reactor.addReader(self)

    def doRead(self) -> None:
        """Somebody rang."""
        self._file.read(8)
        self._answer()

    def logPrefix(self) -> str:
        """Name for the reactor's log."""
        return "ros2"

    def connectionLost(self, reason: Any) -> None:
        """The reactor listens no more."""
        self._lost()

    def close(self) -> None:
        """Answer no more."""
        self._reactor.removeReader(self)
        self._file.close()


class ReactorBridge:
    """Carries calls to the reactor's thread, a batch at a time.

    :param call_from_thread: of the reactor
    """

    def __init__(self, call_from_thread: Callable[[Callable[[], None]], Any]) -> None:
        self.dropped = 0
        self._call_from_thread: Callable[[], Any] = partial(call_from_thread, self._drain)
        self._wake: Callable[[], Any] = self._call_from_thread
        self._bell: EventFdWaker | None = None
        self._queue: deque[tuple[Callable[[Any], None], Any]] = deque()
        self._size = 0
        self._lock = threading.Lock()
        self._scheduled = False
        self._after: list[Callable[[], None]] = []

    def open(self, reactor: Any) -> None:
        """Wake the reactor by a bell of our own, where the system has one."""
        if not hasattr(os, "eventfd"):  # not Linux
            return
        try:
            self._bell = EventFdWaker(reactor, self._drain, self.close)
        except OSError as error:
            Logger("ros2").warn("there is no eventfd: {why}", why=error.strerror)
            return
        self._wake = self._bell.ring

    def close(self) -> None:
        """Wake the reactor by its own means from now on."""
        bell, self._bell = self._bell, None
        if bell is None:
            return
        self._wake = self._call_from_thread
        bell.close()
        with self._lock:
            unheard = self._scheduled
        if unheard:
            self._call_from_thread()

    def after(self, call: Callable[[], None]) -> None:
        """Call once at the end of the batch that is being passed on; on the reactor's thread."""
        self._after.append(call)

    def put(self, function: Callable[[Any], None], argument: Any, size: int | None = 0) -> None:
        """Have ``function(argument)`` called on the reactor's thread; from any thread.

        :param size: bytes of a sample, which is dropped when too many wait; ``None`` if the argument is the sample,
            0 for what must arrive
        """
        if size is None:
            size = len(argument)
        with self._lock:
            # However large, one that nothing waits before has room.
            if size and self._size and self._size + size > BACKLOG:
                self.dropped += 1
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
            self._size = 0
            self._scheduled = False
        for function, argument in batch:
            try:
                function(argument)
            except Exception:  # one receiver's fault must not lose the others their samples
                Logger("ros2").failure("a sample could not be passed on")
        after, self._after = self._after, []
        for call in after:
            try:
                call()
            except Exception:
                Logger("ros2").failure("samples could not be passed on")
