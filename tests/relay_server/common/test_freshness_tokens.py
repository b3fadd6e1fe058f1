"""Freshness tokens in answers and requests."""

from __future__ import annotations

import pytest

from relay_server.common.freshness_tokens import FreshnessTokenRequired, FreshnessTokens


def test_a_token_contains_its_time() -> None:
    """In nanoseconds; it can be read repeatedly."""
    now = 123_456_789_012
    moments = FreshnessTokens(lambda: now)
    said = moments.now()
    now += 5
    assert moments.read(said) == moments.read(f" {said} ") == 123_456_789_012
    assert moments.read(moments.now()) == now
    assert moments.read(None) is None


@pytest.mark.parametrize(
    "text", ["", ".", "ffff", "ffff.", "ffff.0000000000000000", "é.é", "x" * 10_000], ids=range(7)
)
def test_invalid_time_is_refused(text: str) -> None:
    with pytest.raises(FreshnessTokenRequired):
        FreshnessTokens(lambda: 1000).read(text)


def test_a_moment_is_believed_by_the_relay_that_named_it_alone() -> None:
    """A token of an earlier relay process, or a changed one, is invalid."""
    moments = FreshnessTokens(lambda: 1000)
    for each in (FreshnessTokens(lambda: 1000).now(), "1" + moments.now()):
        with pytest.raises(FreshnessTokenRequired):
            moments.read(each)
