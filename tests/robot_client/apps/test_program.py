"""Programs that stay with a robot: lost connections and ways to end."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest

from robot_client.apps.connection import Lost, Refused, RosbridgeConnection
from robot_client.apps.program import ExitSignal, run_connected
from tests.worlds.memory_socket import Socket


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """Restores the signal handlers."""
    before = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


class Program:
    """Records its calls, and runs a planned action in each step."""

    def __init__(self, *plan: Any) -> None:
        self.plan = list(plan)
        self.log: list[str] = []

    def begin(self, connection: RosbridgeConnection) -> None:
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
    run_connected("ws://relay/robots/r", program, ExitSignal(), connect, lambda _: None)


def test_a_program_runs_to_its_end_and_releases_control() -> None:
    """By its connection."""
    program = Program(True, True, False)
    run(program)
    assert program.log == ["begin", "leave"]


def test_a_line_that_is_lost_is_made_again() -> None:
    """Failed attempts are repeated too."""
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


def test_permanent_refusal_is_not_retried() -> None:
    """Only the user can correct it."""
    program = Program(Refused("no right"))
    with pytest.raises(Refused, match="no right"):
        run(program)
    assert program.log == ["begin", "leave"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_makes_the_program_release_control_and_end(number: signal.Signals) -> None:
    """Not in the middle of a step."""
    program = Program(lambda: os.kill(os.getpid(), number))
    run(program)
    assert program.log == ["begin", "leave"]


def test_a_signal_without_a_line_ends_it_at_once() -> None:
    """There is no control to release."""
    exit_signal = ExitSignal()
    with pytest.raises(SystemExit):
        run_connected(
            "ws://relay/robots/r",
            Program(Lost("gone")),
            exit_signal,
            connect,
            lambda _: os.kill(os.getpid(), signal.SIGTERM),
        )


def test_a_second_signal_does_not_wait() -> None:
    """It still releases control."""

    def twice() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)

    program = Program(twice)
    with pytest.raises(SystemExit):
        run(program)
    assert program.log == ["begin", "leave"]
