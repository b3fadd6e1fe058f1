"""Calls from the executor's thread to the reactor, and back."""

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
    MAX_BACKLOG,
    SPIN_SECONDS,
    STUCK_SECONDS,
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
    """In order."""
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


def test_samples_for_a_stalled_reactor_are_bounded() -> None:
    """Responses are not dropped."""
    reactor, got = Reactor(), list[Any]()
    hop = ReactorBridge(reactor)
    for _ in range(40):
        hop.put(got.append, "sample", MAX_BACKLOG // 32)
    hop.put(got.append, "answer")
    reactor.turn()
    assert hop.dropped == 8
    assert got == ["sample"] * 32 + ["answer"]


def test_a_receiver_is_told_how_many_of_its_samples_were_dropped() -> None:
    """After the samples that waited, and once for each batch."""
    reactor, got, lost = Reactor(), list[Any](), list[int]()
    hop = ReactorBridge(reactor)
    for _ in range(2):
        for _ in range(40):
            hop.put(got.append, "sample", MAX_BACKLOG // 32, lost.append)
        reactor.turn()
    assert lost == [8, 8]
    assert len(got) == 64


def test_no_call_is_lost_between_threads() -> None:
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


def test_size_of_a_sample_defaults_to_its_length() -> None:
    reactor, got = Reactor(), list[bytes]()
    hop = ReactorBridge(reactor)
    sample = bytes(MAX_BACKLOG // 2)
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
    """Calls from threads arrive by the waker, each thread's in order, without the reactor's own wake-up."""
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
async def test_entry_queued_during_the_wake_up_arrives() -> None:
    """Calls before, during and after the waker's removal arrive, the last ones by the reactor's own wake-up."""
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
    """When the reactor drops its readers, calls use its own wake-up."""
    reactor, got = Reactor(), list[int]()
    hop = ReactorBridge(reactor)
    hop.open(real_reactor)
    bell = hop._waker
    assert bell is not None
    hop.put(got.append, 1)
    bell.connectionLost(None)
    assert bell not in real_reactor.getReaders()  # type: ignore[attr-defined]  # to mypy a module
    hop.put(got.append, 2)
    reactor.turn()
    assert got == [1, 2]


def test_bridge_works_without_an_eventfd(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_failing_receiver_does_not_affect_others() -> None:
    reactor, got = Reactor(), list[int]()
    hop = ReactorBridge(reactor)
    hop.put(lambda _: 1 / 0, None)
    hop.put(got.append, 1)
    reactor.turn()
    assert got == [1]


def test_executor_without_callbacks_for_five_seconds_is_stuck() -> None:
    class Node:
        def create_timer(self, period: float, beat: Callable[[], None], clock: object) -> None:
            self.beat = beat

    class Executor:
        def add_node(self, node: Node) -> None:
            pass

    now, node = [0.0], Node()
    spinner = Spinner(Executor(), node, None, lambda: now[0])
    now[0] = STUCK_SECONDS + 1
    assert "run no callback" in str(spinner.fault())
    node.beat()
    assert spinner.fault() is None


class Tasks:
    """An executor that runs its tasks on request, the newest first, as rclpy's does."""

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


def test_calls_on_the_executors_thread_run_in_order() -> None:
    """By one task."""
    tasks, done = Tasks(), list[int]()
    spinner = Spinner(tasks, Timers(), None)
    for number in range(5):
        spinner.call(done.append, number)
    assert len(tasks.tasks) == 1
    tasks.turn()
    spinner.call(done.append, 5)
    tasks.turn()
    assert done == [0, 1, 2, 3, 4, 5]


def test_failing_call_does_not_affect_later_ones() -> None:
    tasks, done = Tasks(), list[int]()
    spinner = Spinner(tasks, Timers(), None)
    spinner.call(lambda: 1 / 0)
    spinner.call(done.append, 1)
    tasks.turn()
    assert done == [1]


@pytest.mark.parametrize("kind", ["events", "single"])
def test_idle_executor_runs_calls_and_stops(kind: str, environment: dict[str, str]) -> None:
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
        spinner.call(done.set)
        assert done.wait(60)
        served = spinner._last_callback
        end = time.monotonic() + 60
        while spinner._last_callback == served and time.monotonic() < end:
            time.sleep(0.01)  # the beat comes from another thread
        assert spinner._last_callback > served
        assert spinner.fault() is None
        assert set(turns) == {SPIN_SECONDS}
    finally:
        spinner.stop()
        assert not spinner._thread.is_alive()
        node.destroy_node()
        rclpy.try_shutdown(context=context)
