"""The way from the executor's thread to the reactor."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from robot_client.platforms.ros2_executor import BACKLOG, STUCK_SECONDS, Hop, Spinner


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
    hop = Hop(reactor)
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
    hop = Hop(reactor)
    for _ in range(40):
        hop.put(got.append, "sample", BACKLOG // 32)
    hop.put(got.append, "answer")
    reactor.turn()
    assert hop.dropped == 8
    assert got == ["sample"] * 32 + ["answer"]


def test_nothing_is_lost_between_threads() -> None:
    """Calls put by several threads while the reactor drains all arrive."""
    reactor, got = Reactor(), list[int]()
    hop = Hop(reactor)
    threads = [
        threading.Thread(target=lambda: [hop.put(got.append, each) for each in range(5000)]) for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        reactor.turn()
    reactor.turn()
    assert sorted(got) == sorted([*range(5000)] * 3)


def test_failing_receiver_costs_nobody_else() -> None:
    """A receiver that throws does not lose the others their calls."""
    reactor, got = Reactor(), list[int]()
    hop = Hop(reactor)
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
