"""The clock by which commands grow old."""

from __future__ import annotations

import time

import pytest
from twisted.internet.task import Clock

from relay_protocol import identity
from robot_client.clocks import now_ns
from robot_client.config import Safety, Settings
from robot_client.identity import Enrolment
from robot_client.lasting import MemoryLatch
from robot_client.link import Identity
from robot_client.platforms.memory import MemoryPlatform
from robot_client.run import Runner

ASLEEP = 3_600_000_000_000


@pytest.mark.skipif(
    not hasattr(time, "CLOCK_BOOTTIME"), reason="this system has no clock that goes on in suspends"
)
def test_a_suspend_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """After an hour asleep, in which the monotonic clock stood still, an hour has passed."""
    real = time.clock_gettime_ns
    before = now_ns()
    monkeypatch.setattr(
        time, "clock_gettime_ns", lambda which: real(which) + ASLEEP * (which == time.CLOCK_BOOTTIME)
    )
    assert now_ns() - before >= ASLEEP


def test_without_such_a_clock_the_monotonic_one_serves(monkeypatch: pytest.MonkeyPatch) -> None:
    """Systems that can't tell how long they slept have the monotonic clock."""
    monkeypatch.delattr(time, "CLOCK_BOOTTIME", raising=False)
    before = time.monotonic_ns()
    assert before <= now_ns() <= time.monotonic_ns()


def test_the_daemon_judges_commands_by_it() -> None:
    """The daemon, and with it every link's estimate and the watchdog, reads this clock."""
    me = Identity("r1", "relay-1", identity.generate_key())
    enrolment = Enrolment(relay="relay-1", robot="r1", address="127.0.0.1:1", tls=False)
    runner = Runner(
        Clock(), Settings(safety=Safety(guard=False)), enrolment, me, MemoryLatch(), MemoryPlatform()
    )
    assert runner.daemon._now is now_ns
    assert runner.daemon.motion._now is now_ns
