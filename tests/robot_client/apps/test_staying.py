"""Staying with a robot: lines that are lost, and the ways to end."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest
from switchboard_socket import Socket

from robot_client.apps.connection import Lost, Refused, RosbridgeConnection
from robot_client.apps.reconnect import Ending, run_connected


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Signals are what they were, afterwards."""
    before = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


class Program:
    """Writes down what happens to it, and does what is planned in each step."""

    def __init__(self, *plan: Any) -> None:
        self.plan = list(plan)
        self.log: list[str] = []

    def begin(self, line: RosbridgeConnection) -> None:
        self.log.append("begin")

    def step(self) -> bool:
        does = self.plan.pop(0)
        if isinstance(does, Exception):
            raise does
        if callable(does):
            does()
            return True
        return bool(does)

    def leave(self) -> None:
        self.log.append("leave")

    def lost(self, why: str, seconds: float) -> None:
        assert seconds >= 0
        self.log.append(f"lost: {why}")


@contextlib.contextmanager
def connect(url: str) -> Iterator[RosbridgeConnection]:
    yield RosbridgeConnection(Socket())


def run(program: Program, connect: Any = connect) -> None:
    run_connected("ws://relay/robots/r", program, Ending(), connect, lambda _: None)


def test_a_program_runs_to_its_end_and_lets_go() -> None:
    """By the line it has."""
    program = Program(True, True, False)
    run(program)
    assert program.log == ["begin", "leave"]


def test_a_line_that_is_lost_is_made_again() -> None:
    """Also when it can't be made at first."""
    program = Program(Lost("gone"), False)
    failures = [True, False, True, False]

    @contextlib.contextmanager
    def connect(url: str) -> Iterator[RosbridgeConnection]:
        if failures.pop(0):
            raise Lost("nobody there")
        yield RosbridgeConnection(Socket())

    run(program, connect)
    assert program.log == [
        "lost: nobody there",
        "begin",
        "leave",
        "lost: gone",
        "lost: nobody there",
        "begin",
        "leave",
    ]


def test_what_is_refused_for_good_is_not_tried_again() -> None:
    """Only a person can help."""
    program = Program(Refused("no right"))
    with pytest.raises(Refused, match="no right"):
        run(program)
    assert program.log == ["begin", "leave"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_has_the_program_let_go_and_end(number: signal.Signals) -> None:
    """Not in the middle of a step."""
    program = Program(lambda: os.kill(os.getpid(), number))
    run(program)
    assert program.log == ["begin", "leave"]


def test_a_signal_without_a_line_ends_it_at_once() -> None:
    """There is nothing to let go of."""
    ending = Ending()
    with pytest.raises(SystemExit):
        run_connected(
            "ws://relay/robots/r",
            Program(Lost("gone")),
            ending,
            connect,
            lambda _: os.kill(os.getpid(), signal.SIGTERM),
        )


def test_a_second_signal_does_not_wait() -> None:
    """It lets go all the same."""

    def twice() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)

    program = Program(twice)
    with pytest.raises(SystemExit):
        run(program)
    assert program.log == ["begin", "leave"]
