"""The way from the executor's thread to the reactor."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import pytest_twisted
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.signals import SignalHandlerOptions
from twisted.internet import reactor as real_reactor

from robot_client.platforms.ros2.executor import (
    BACKLOG,
    STUCK_SECONDS,
    TURN,
    ReactorBridge,
    Spinner,
    make_executor,
)
from tests.robot_client.ros import until


class Reactor:
    def __init__(self) -> None:
        self.calls: list[Callable[[], None]] = []

    def __call__(self, call: Callable[[], None]) -> None:
        self.calls.append(call)

    def turn(self) -> None:
        calls, self.calls = self.calls, []
        for call in calls:
            call()


def test_batch_wakes_the_reactor_once() -> None:
    """Many calls put before the reactor turns need one wake-up and come in order."""
    reactor, got = Reactor(), list[int]()
    hop = ReactorBridge(reactor)
    for number in range(100):
        hop.put(got.append, number)
    assert len(reactor.calls) == 1
    reactor.turn()
    assert got == list(range(100))
    hop.put(got.append, 100)
    reactor.turn()
    assert got[-1] == 100


def test_stalled_reactor_does_not_eat_the_memory() -> None:
    """Samples over the bound are dropped and counted; answers of services are not."""
    reactor, got = Reactor(), list[Any]()
    hop = ReactorBridge(reactor)
    for _ in range(40):
        hop.put(got.append, "sample", BACKLOG // 32)
    hop.put(got.append, "answer")
    reactor.turn()
    assert hop.dropped == 8
    assert got == ["sample"] * 32 + ["answer"]


def test_nothing_is_lost_between_threads() -> None:
    """Calls put by several threads while the reactor drains all arrive."""
    reactor, got = Reactor(), list[int]()
    hop = ReactorBridge(reactor)
    threads = [
        threading.Thread(target=lambda: [hop.put(got.append, each) for each in range(5000)]) for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        reactor.turn()
    reactor.turn()
    assert sorted(got) == sorted([*range(5000)] * 3)


def test_sample_alone_is_as_large_as_it_is() -> None:
    """Bytes that are put as they are count with their length."""
    reactor, got = Reactor(), list[bytes]()
    hop = ReactorBridge(reactor)
    sample = bytes(BACKLOG // 2)
    for _ in range(3):
        hop.put(got.append, sample, None)
    reactor.turn()
    assert hop.dropped == 1
    assert len(got) == 2


def in_threads(count: int, put: Callable[[int], None]) -> list[threading.Thread]:
    threads = [threading.Thread(target=lambda: [put(each) for each in range(2000)]) for _ in range(count)]
    for thread in threads:
        thread.start()
    return threads


@pytest_twisted.ensureDeferred
async def test_bell_wakes_the_reactor_and_loses_nothing() -> None:
    """What threads put arrives by the bell, each thread's in its order, without the reactor's own way."""
    reactor, got = Reactor(), list[int]()
    hop = ReactorBridge(reactor)
    hop.open(real_reactor)
    try:
        threads = in_threads(3, partial(hop.put, got.append))
        await until(lambda: len(got) == 6000)
    finally:
        hop.close()
    for thread in threads:
        thread.join()
    assert sorted(got) == sorted([*range(2000)] * 3)
    assert not reactor.calls


@pytest_twisted.ensureDeferred
async def test_what_is_put_while_the_bell_goes_arrives() -> None:
    """Calls put before, while and after the bell is taken away arrive, then by the reactor's own way."""
    got = list[int]()
    hop = ReactorBridge(real_reactor.callFromThread)  # type: ignore[attr-defined]  # to mypy a module
    hop.open(real_reactor)
    hop.put(got.append, -1)
    hop.close()
    hop.close()
    hop.put(got.append, -2)
    await until(lambda: len(got) == 2)
    assert got == [-1, -2]


@pytest_twisted.ensureDeferred
async def test_bell_the_reactor_gave_up_is_replaced() -> None:
    """When the reactor drops its readers, the hop goes on by the reactor's own way."""
    reactor, got = Reactor(), list[int]()
    hop = ReactorBridge(reactor)
    hop.open(real_reactor)
    bell = hop._bell
    assert bell is not None
    hop.put(got.append, 1)
    bell.connectionLost(None)
    assert bell not in real_reactor.getReaders()  # type: ignore[attr-defined]  # to mypy a module
    hop.put(got.append, 2)
    reactor.turn()
    assert got == [1, 2]


def test_no_bell_is_no_trouble(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without an eventfd, of the system or at all, the reactor's own way is used."""
    reactor, got = Reactor(), list[int]()
    hop = ReactorBridge(reactor)

    def refuse(*_: int) -> int:
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(os, "eventfd", refuse)
    hop.open(real_reactor)
    hop.put(got.append, 1)
    monkeypatch.delattr(os, "eventfd")
    hop.open(real_reactor)
    reactor.turn()
    hop.put(got.append, 2)
    reactor.turn()
    assert got == [1, 2]


def test_failing_receiver_costs_nobody_else() -> None:
    """A receiver that throws does not lose the others their calls."""
    reactor, got = Reactor(), list[int]()
    hop = ReactorBridge(reactor)
    hop.put(lambda _: 1 / 0, None)
    hop.put(got.append, 1)
    reactor.turn()
    assert got == [1]


def test_executor_that_serves_nothing_is_noticed() -> None:
    """Five seconds without the node's own timer mean that the executor is stuck; a beat means it is not."""

    class Node:
        def create_timer(self, period: float, beat: Callable[[], None], clock: object) -> None:
            self.beat = beat

    class Executor:
        def add_node(self, node: Node) -> None:
            pass

    now, node = [0.0], Node()
    spinner = Spinner(Executor(), node, None, lambda: now[0])
    now[0] = STUCK_SECONDS + 1
    assert "served nothing" in str(spinner.trouble())
    node.beat()
    assert spinner.trouble() is None


class Tasks:
    """An executor that runs its tasks when told, the newest first, as rclpy's does."""

    def __init__(self) -> None:
        self.tasks: list[Callable[[], None]] = []

    def add_node(self, node: object) -> None:
        pass

    def create_task(self, task: Callable[[], None]) -> None:
        self.tasks.append(task)

    def turn(self) -> None:
        while self.tasks:
            self.tasks.pop()()


class Timers:
    def create_timer(self, period: float, beat: Callable[[], None], clock: object) -> None:
        pass


def test_work_for_the_executor_is_done_in_order() -> None:
    """What is given to the executor's thread is done there in the order it came, by one task."""
    tasks, done = Tasks(), list[int]()
    spinner = Spinner(tasks, Timers(), None)
    for number in range(5):
        spinner.do(done.append, number)
    assert len(tasks.tasks) == 1
    tasks.turn()
    spinner.do(done.append, 5)
    tasks.turn()
    assert done == [0, 1, 2, 3, 4, 5]


def test_work_that_fails_costs_no_other() -> None:
    """A request that ROS refuses does not lose those behind it."""
    tasks, done = Tasks(), list[int]()
    spinner = Spinner(tasks, Timers(), None)
    spinner.do(lambda: 1 / 0)
    spinner.do(done.append, 1)
    tasks.turn()
    assert done == [1]


@pytest.mark.parametrize("kind", ["events", "single"])
def test_executor_at_rest_serves_and_ends(kind: str, environment: dict[str, str]) -> None:
    """While nothing happens in the graph, work is done, the node's timer beats, and the thread ends when told."""
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("spun", context=context, start_parameter_services=False, enable_rosout=False)
    turns = list[float]()
    executor = make_executor(kind, context)

    class Counted:
        def __getattr__(self, name: str) -> Any:
            return getattr(executor, name)

        def spin_once(self, timeout_sec: float) -> None:
            turns.append(timeout_sec)
            executor.spin_once(timeout_sec=timeout_sec)

    spinner = Spinner(Counted(), node, Clock(clock_type=ClockType.STEADY_TIME))
    try:
        spinner.start()
        done = threading.Event()
        spinner.do(done.set)
        assert done.wait(60)
        served = spinner._served
        end = time.monotonic() + 60
        while spinner._served == served and time.monotonic() < end:
            time.sleep(0.01)  # the beat comes from another thread
        assert spinner._served > served
        assert spinner.trouble() is None
        assert set(turns) == {TURN}
    finally:
        spinner.stop()
        assert not spinner._thread.is_alive()
        node.destroy_node()
        rclpy.try_shutdown(context=context)
