"""Delays before the robot dials again."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.link.backoff import CAP, FIRST, REFUSED, Backoff


def test_first_retry_is_quick() -> None:
    """At most half a second."""
    assert Backoff(lambda: 0.999).after_loss(100.0) <= FIRST


def test_delay_is_short_in_the_first_minute() -> None:
    """Two seconds at most."""
    backoff = Backoff(lambda: 0.999)
    assert max(backoff.after_loss(0.0) for _ in range(25)) <= 2.0


def test_delay_grows_to_15_s() -> None:
    backoff = Backoff(lambda: 0.999)
    waits = [backoff.after_loss(0.0) for _ in range(100)]
    assert max(waits) == pytest.approx(CAP, rel=0.01)
    assert waits[-1] == pytest.approx(CAP, rel=0.01)


def test_registered_link_resets_the_backoff() -> None:
    """After ten seconds."""
    backoff = Backoff(lambda: 0.999)
    for _ in range(100):
        backoff.after_loss(0.0)
    assert backoff.after_loss(9.0) > 10.0
    assert backoff.after_loss(10.0) <= FIRST


@given(st.floats(0, 1000), st.integers(0, 2**32))
def test_retry_after_is_honoured(retry_after: float, seed: int) -> None:
    assert Backoff(random.Random(seed).random).after_refusal(retry_after) >= retry_after


def test_delay_after_a_refusal_for_good_is_30_to_60_s() -> None:
    least, most = REFUSED
    assert least <= Backoff(lambda: 0.5).after_refusal(None) <= most
