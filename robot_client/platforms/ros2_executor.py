"""The thread that serves ROS callbacks, and the way from there to the reactor."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from twisted.logger import Logger

from relay_protocol.limits import MIB

TURN = 0.05
"""Seconds of one turn of the executor. ``spin`` of rclpy 7.1's EventsExecutor hangs; single turns don't."""

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
        self._executor = executor
        self._clock = clock
        self._stop = threading.Event()
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
        self._stop.set()
        if self._thread.is_alive():
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
            if self._scheduled or self._stop.is_set():
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
        while not self._stop.is_set():
            try:
                self._executor.spin_once(timeout_sec=TURN)
            except Exception:
                if self._stop.is_set():
                    return
                self._log.failure("a ROS callback failed")
                time.sleep(TURN)  # an executor that fails at once each time must not take the processor


class Hop:
    """Carries calls to the reactor's thread, a batch at a time.

    :param call_from_thread: of the reactor
    """

    def __init__(self, call_from_thread: Callable[[Callable[[], None]], Any]) -> None:
        self.dropped = 0
        self._call_from_thread = call_from_thread
        self._queue: deque[tuple[Callable[[Any], None], Any, int]] = deque()
        self._size = 0
        self._lock = threading.Lock()
        self._scheduled = False
        self._after: list[Callable[[], None]] = []

    def after(self, call: Callable[[], None]) -> None:
        """Call once at the end of the batch that is being passed on; on the reactor's thread."""
        self._after.append(call)

    def put(self, function: Callable[[Any], None], argument: Any, size: int = 0) -> None:
        """Have ``function(argument)`` called on the reactor's thread; from any thread.

        :param size: bytes of a sample, which is dropped when too many wait; 0 for what must arrive
        """
        with self._lock:
            if size and self._size + size > BACKLOG:
                self.dropped += 1
                return
            self._size += size
            self._queue.append((function, argument, size))
            if self._scheduled:
                return
            self._scheduled = True
        self._call_from_thread(self._drain)

    def _drain(self) -> None:
        with self._lock:
            batch, self._queue = self._queue, deque()
            self._size = 0
            self._scheduled = False
        for function, argument, _ in batch:
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
