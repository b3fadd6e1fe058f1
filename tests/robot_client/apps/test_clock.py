"""The clock of the applications goes on while the machine is suspended."""

from __future__ import annotations

import inspect
import time
from typing import Any

import pytest

from robot_client.apps.audio import AudioBuffer
from robot_client.apps.clock import now
from robot_client.apps.joystick import Joystick
from robot_client.apps.voice import VoiceControl


def test_it_counts_suspends(monkeypatch: pytest.MonkeyPatch) -> None:
    """CLOCK_MONOTONIC of Linux would stand still."""
    told = {time.CLOCK_BOOTTIME: 9_500_000_000, time.CLOCK_MONOTONIC: 1_000_000_000}
    monkeypatch.setattr(time, "clock_gettime_ns", told.__getitem__)
    assert now() == 9.5


@pytest.mark.parametrize("made", [Joystick, VoiceControl, AudioBuffer])
def test_by_it_looks_words_and_sound_grow_old(made: Any) -> None:
    """Where nobody gives them another clock, as their programs don't."""
    assert inspect.signature(made).parameters["clock"].default is now
