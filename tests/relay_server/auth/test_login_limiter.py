"""Failed logins are counted per account and network."""

from __future__ import annotations

import pytest

from relay_server.auth import login_limiter as module
from relay_server.auth.login_limiter import (
    FAILURES,
    FAILURES_OF_NETWORK,
    WINDOW,
    LoginLimiter,
    network_of,
)
from tests.worlds.relay import Time


def exhausted(time: Time) -> LoginLimiter:
    """A limiter with all allowed failures of ann from one address."""
    limiter = LoginLimiter(time)
    for _ in range(FAILURES):
        assert limiter.wait("ann", "192.0.2.1") == 0
        limiter.failed("ann", "192.0.2.1")
    return limiter


def test_the_eleventh_try_waits_for_the_first_to_be_forgotten(time: Time) -> None:
    """Ten failures in 15 min are allowed, in a sliding window."""
    limiter = exhausted(time)
    time.now += 60
    assert limiter.wait("ann", "192.0.2.1") == WINDOW - 60
    time.now += WINDOW - 60
    assert limiter.wait("ann", "192.0.2.1") == 0


def test_failures_elsewhere_cannot_lock_an_account(time: Time) -> None:
    """The same account from another network, and another account from the same network, still work."""
    limiter = exhausted(time)
    assert limiter.wait("ann", "192.0.2.2") == 0
    assert limiter.wait("bob", "192.0.2.1") == 0


def test_an_account_is_one_however_it_is_written(time: Time) -> None:
    """Other spellings of a name give no further tries."""
    limiter = exhausted(time)
    assert limiter.wait("ANN", "192.0.2.1") > 0
    assert limiter.wait("\uff21nn", "192.0.2.1") > 0
    assert limiter.wait("ann@Default", "192.0.2.1") > 0


@pytest.mark.parametrize(
    ("tried", "other"), [("a b", "c d"), ("ann@", "ann@ "), ("", "\0"), ("x" * 500, "x" * 501)]
)
def test_names_that_no_account_can_have_do_not_share_failures(time: Time, tried: str, other: str) -> None:
    limiter = LoginLimiter(time)
    for _ in range(FAILURES):
        limiter.failed(tried, "192.0.2.1")
    assert limiter.wait(tried, "192.0.2.1") > 0
    assert limiter.wait(other, "192.0.2.1") == 0


def test_accounts_of_two_realms_are_two(time: Time) -> None:
    """Guesses at one account lock no account of the same name in another realm."""
    limiter = exhausted(time)
    assert limiter.wait("ann@lab1", "192.0.2.1") == 0
    for _ in range(FAILURES):
        limiter.failed("ann@lab1", "192.0.2.2")
    assert limiter.wait("Ann@LAB1", "192.0.2.2") > 0
    assert limiter.wait("ann@lab2", "192.0.2.2") == limiter.wait("bob@lab1", "192.0.2.2") == 0


def test_a_robot_is_one_however_long_what_it_claims_is(time: Time) -> None:
    """A robot that claims another long name locks out no other robot."""
    limiter = LoginLimiter(time, known_as=module.digest)
    first, second = (f"rover@lab#{key * 64}" for key in "ab")
    for _ in range(FAILURES):
        limiter.failed(first, "192.0.2.1")
    assert limiter.wait(first, "192.0.2.1") > 0
    assert limiter.wait(second, "192.0.2.1") == 0
    limiter.succeeded(first, "192.0.2.1")
    assert limiter.wait(first, "192.0.2.1") == 0


def test_guesses_of_names_are_limited_per_network(time: Time) -> None:
    """A network has a limit over all accounts together; other networks have their own."""
    limiter = LoginLimiter(time)
    for number in range(FAILURES_OF_NETWORK):
        limiter.failed(f"user{number}", "192.0.2.1")
    assert limiter.wait("new", "192.0.2.1") > 0
    assert limiter.wait(None, "192.0.2.1") > 0
    assert limiter.wait("new", "192.0.2.2") == 0


def test_success_forgets_the_failures_of_the_pair_only(time: Time) -> None:
    """The account starts again; the network's other failures still count."""
    limiter = exhausted(time)
    limiter.succeeded("ann", "192.0.2.1")
    assert limiter.wait("ann", "192.0.2.1") == 0
    for number in range(FAILURES_OF_NETWORK - FAILURES + 1):
        limiter.failed(f"user{number}", "192.0.2.1")
    assert limiter.wait("bob", "192.0.2.1") > 0


def test_a_try_that_could_not_be_judged_is_taken_back(time: Time) -> None:
    """A database that is away locks out no user."""
    limiter = LoginLimiter(time)
    for _ in range(3 * FAILURES_OF_NETWORK):
        limiter.failed("ann", "192.0.2.1")
        limiter.forgive("ann", "192.0.2.1")
    assert limiter.wait("ann", "192.0.2.1") == 0


def test_cache_is_bounded(time: Time, monkeypatch: pytest.MonkeyPatch) -> None:
    """The least recently used pairs are removed."""
    monkeypatch.setattr(module, "KEYS", 10)
    limiter = LoginLimiter(time)
    for number in range(100):
        limiter.failed("ann", f"192.0.2.{number}")
    assert len(limiter._failures) == 10


@pytest.mark.parametrize(
    ("address", "network"),
    [
        ("192.0.2.1", "192.0.2.1"),
        ("2001:db8:1:2:3:4:5:6", "2001:db8:1:2::/64"),
        ("::ffff:192.0.2.1", "192.0.2.1"),
        ("local", "local"),
    ],
)
def test_networks(address: str, network: str) -> None:
    """One address of IPv4 or a /64 of IPv6; a mapped address counts as IPv4."""
    assert network_of(address) == network
