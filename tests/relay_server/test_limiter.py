"""Failed logins are counted per account and network."""

from __future__ import annotations

import pytest

from relay_server.auth import login_limiter as module
from relay_server.auth.login_limiter import (
    ACCOUNT_WINDOW,
    FAILURES,
    FAILURES_OF_NETWORK,
    NETWORKS,
    WINDOW,
    LoginLimiter,
    network_of,
)
from tests.relay_server.memory import Time


def exhausted(time: Time) -> LoginLimiter:
    """A limiter that has had all failures of ann from one address."""
    limiter = LoginLimiter(time)
    for _ in range(FAILURES):
        assert limiter.wait("ann", "192.0.2.1") == 0
        limiter.failed("ann", "192.0.2.1")
    return limiter


def test_the_eleventh_try_waits_for_the_first_to_be_forgotten(time: Time) -> None:
    """Ten failures in fifteen minutes, in a sliding window."""
    limiter = exhausted(time)
    time.now += 60
    assert limiter.wait("ann", "192.0.2.1") == WINDOW - 60
    time.now += WINDOW - 60
    assert limiter.wait("ann", "192.0.2.1") == 0


def test_nobody_locks_an_account_from_afar(time: Time) -> None:
    """The same account from another network, and another account from the same one, go on."""
    limiter = exhausted(time)
    assert limiter.wait("ann", "192.0.2.2") == 0
    assert limiter.wait("bob", "192.0.2.1") == 0


def test_an_account_is_one_however_it_is_written(time: Time) -> None:
    """Other spellings of a name are no further tries."""
    limiter = exhausted(time)
    assert limiter.wait("ANN", "192.0.2.1") > 0
    assert limiter.wait("\uff21nn", "192.0.2.1") > 0
    assert limiter.wait("ann@Default", "192.0.2.1") > 0


def test_accounts_of_two_realms_are_two(time: Time) -> None:
    """Who guesses at one locks no other of the same name, nor all that have a realm."""
    limiter = exhausted(time)
    assert limiter.wait("ann@lab1", "192.0.2.1") == 0
    for _ in range(FAILURES):
        limiter.failed("ann@lab1", "192.0.2.2")
    assert limiter.wait("Ann@LAB1", "192.0.2.2") > 0
    assert limiter.wait("ann@lab2", "192.0.2.2") == limiter.wait("bob@lab1", "192.0.2.2") == 0


def test_a_robot_is_one_however_long_what_it_claims_is(time: Time) -> None:
    """Each text is a robot of its own: who claims to be another one with a long name locks nobody out."""
    limiter = LoginLimiter(time, known_as=module.robot)
    first, second = (f"rover@lab#{key * 64}" for key in "ab")
    for _ in range(FAILURES):
        limiter.failed(first, "192.0.2.1")
    assert limiter.wait(first, "192.0.2.1") > 0
    assert limiter.wait(second, "192.0.2.1") == 0
    limiter.succeeded(first, "192.0.2.1")
    assert limiter.wait(first, "192.0.2.1") == 0


def test_guessing_names_is_no_way_around(time: Time) -> None:
    """A network has a limit over all accounts together, and others have their own."""
    limiter = LoginLimiter(time)
    for number in range(FAILURES_OF_NETWORK):
        limiter.failed(f"user{number}", "192.0.2.1")
    assert limiter.wait("new", "192.0.2.1") > 0
    assert limiter.wait(None, "192.0.2.1") > 0
    assert limiter.wait("new", "192.0.2.2") == 0


def test_success_forgets_the_failures_of_the_pair_only(time: Time) -> None:
    """The account starts anew; what the network did otherwise stays."""
    limiter = exhausted(time)
    limiter.succeeded("ann", "192.0.2.1")
    assert limiter.wait("ann", "192.0.2.1") == 0
    for number in range(FAILURES_OF_NETWORK - FAILURES + 1):
        limiter.failed(f"user{number}", "192.0.2.1")
    assert limiter.wait("bob", "192.0.2.1") > 0


def test_a_try_that_could_not_be_judged_is_taken_back(time: Time) -> None:
    """A database that is away locks nobody out."""
    limiter = LoginLimiter(time)
    for _ in range(3 * FAILURES_OF_NETWORK):
        limiter.failed("ann", "192.0.2.1")
        limiter.forgive("ann", "192.0.2.1")
    assert limiter.wait("ann", "192.0.2.1") == 0


def guessed(time: Time, account: str = "ann") -> LoginLimiter:
    """A limiter that has had all failures of an account, from many networks."""
    limiter = LoginLimiter(time, of_account=5)
    limiter.remember("ann", "198.51.100.7")
    for number in range(5):
        assert limiter.wait(account, f"192.0.2.{number}") == 0
        limiter.failed(account, f"192.0.2.{number}")
    return limiter


@pytest.mark.parametrize("account", ["ann", "nobody"])
def test_an_account_has_a_limit_over_all_networks(time: Time, account: str) -> None:
    """In a longer window, whether it is there or not; other accounts go on."""
    limiter = guessed(time, account)
    assert limiter.wait(account, "192.0.2.99") == ACCOUNT_WINDOW
    assert limiter.wait(account.upper(), "2001:db8::1") == ACCOUNT_WINDOW
    assert limiter.wait("bob", "192.0.2.99") == 0
    time.now += ACCOUNT_WINDOW
    assert limiter.wait(account, "192.0.2.99") == 0


def test_a_network_that_has_logged_in_is_not_locked_by_others(time: Time) -> None:
    """What fails there counts for it alone; a success there opens nothing to others."""
    limiter = guessed(time)
    for _ in range(FAILURES):
        assert limiter.wait("ann", "198.51.100.7") == 0
        limiter.failed("ann", "198.51.100.7")
    assert limiter.wait("ann", "198.51.100.7") == WINDOW
    time.now += WINDOW
    limiter.failed("ann", "198.51.100.7")
    limiter.succeeded("ann", "198.51.100.7")
    assert limiter.wait("ann", "198.51.100.7") == 0
    assert limiter.wait("ann", "192.0.2.99") > 0


def test_networks_remembered_of_an_account_are_bounded(time: Time) -> None:
    """The latest stay; what logs in again is among them."""
    limiter = guessed(time)
    for number in range(NETWORKS):
        limiter.remember("ann", f"203.0.113.{number}")
        limiter.remember("ann", "198.51.100.7")
    assert limiter.wait("ann", "203.0.113.0") > 0
    assert limiter.wait("ann", "203.0.113.1") == limiter.wait("ann", "198.51.100.7") == 0


def test_what_is_remembered_is_bounded(time: Time, monkeypatch: pytest.MonkeyPatch) -> None:
    """The longest unused pairs are forgotten."""
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
    """One address of IPv4, a /64 of IPv6, mapped addresses as what they are."""
    assert network_of(address) == network
