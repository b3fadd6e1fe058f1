"""When the robot dials again."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_client.link.backoff import CAP, FIRST, REFUSED, Backoff


def test_first_retry_is_quick() -> None:
    """After the first loss the robot waits at most half a second."""
    assert Backoff(lambda: 0.999).after_loss(100.0) <= FIRST


def test_fresh_outage_is_met_often() -> None:
    """While an outage is younger than a minute no wait is longer than two seconds."""
    backoff = Backoff(lambda: 0.999)
    assert max(backoff.after_loss(0.0) for _ in range(25)) <= 2.0


def test_long_outage_slows_down_to_the_cap() -> None:
    """An outage of minutes is asked about every 15 seconds at most, and never less."""
    backoff = Backoff(lambda: 0.999)
    waits = [backoff.after_loss(0.0) for _ in range(100)]
    assert max(waits) == pytest.approx(CAP, rel=0.01)
    assert waits[-1] == pytest.approx(CAP, rel=0.01)


def test_good_link_starts_afresh() -> None:
    """A link that was registered for ten seconds resets the backoff, a short one does not."""
    backoff = Backoff(lambda: 0.999)
    for _ in range(100):
        backoff.after_loss(0.0)
    assert backoff.after_loss(9.0) > 10.0
    assert backoff.after_loss(10.0) <= FIRST


@given(st.floats(0, 1000), st.integers(0, 2**32))
def test_retry_after_is_honoured(retry_after: float, seed: int) -> None:
    """A relay that says when to come back is not asked before."""
    assert Backoff(random.Random(seed).random).after_refusal(retry_after) >= retry_after


def test_refusal_for_good_is_asked_slowly() -> None:
    """When only a person can help, the robot asks every 30 to 60 seconds."""
    least, most = REFUSED
    assert least <= Backoff(lambda: 0.5).after_refusal(None) <= most
