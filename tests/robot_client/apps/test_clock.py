"""The clock of the applications goes on while the machine is suspended."""

from __future__ import annotations

import inspect
import time
from typing import Any

import pytest

from relay_protocol.clocks import now
from robot_client.apps.audio import AudioBuffer
from robot_client.apps.joystick import Joystick
from robot_client.apps.voice import VoiceControl


def test_it_counts_suspends(monkeypatch: pytest.MonkeyPatch) -> None:
    """CLOCK_MONOTONIC of Linux would stop."""
    reported = {time.CLOCK_BOOTTIME: 9_500_000_000, time.CLOCK_MONOTONIC: 1_000_000_000}
    monkeypatch.setattr(time, "clock_gettime_ns", reported.__getitem__)
    assert now() == 9.5


@pytest.mark.parametrize("made", [Joystick, VoiceControl, AudioBuffer])
def test_it_measures_the_age_of_images_words_and_sound(made: Any) -> None:
    """Without another clock, as in their programs."""
    assert inspect.signature(made).parameters["clock"].default is now
