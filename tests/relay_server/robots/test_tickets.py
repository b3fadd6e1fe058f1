"""Tickets: valid once, for a time, and only the latest of an owner."""

from __future__ import annotations

import itertools

import pytest
from twisted.internet.task import Clock

from relay_protocol.limits import CHANNEL_TICKET_SECONDS
from relay_server.robots.tickets import Tickets


@pytest.fixture
def clock() -> Clock:
    """A clock of the test."""
    return Clock()


@pytest.fixture
def tickets(clock: Clock) -> Tickets[str]:
    """No tickets issued."""
    counter = itertools.count(1)
    return Tickets(clock, lambda: f"ticket-{next(counter)}")


def test_a_ticket_is_good_once(tickets: Tickets[str]) -> None:
    """A used ticket counts as unknown."""
    ticket = tickets.issue("rover")
    assert tickets.redeem("invented") is None
    assert tickets.redeem(ticket) == "rover"
    assert tickets.redeem(ticket) is None
    assert not len(tickets)


def test_a_ticket_grows_old(clock: Clock, tickets: Tickets[str]) -> None:
    """It is valid up to its last moment; expired ones are removed."""
    good, old = tickets.issue("rover"), tickets.issue("arm")
    clock.advance(CHANNEL_TICKET_SECONDS)
    assert tickets.redeem(good) == "rover"
    clock.advance(0.1)
    assert tickets.redeem(old) is None
    tickets.issue("rover")
    clock.advance(CHANNEL_TICKET_SECONDS + 1)
    tickets.issue("arm")
    assert len(tickets) == 1


def test_only_the_latest_ticket_of_an_owner_is_good(tickets: Tickets[str]) -> None:
    """A new ticket, or a withdrawal, invalidates earlier ones; those of other owners stay."""
    other = tickets.issue("arm")
    first = tickets.issue("rover")
    second = tickets.issue("rover")
    assert tickets.redeem(first) is None
    tickets.withdraw("rover")
    assert tickets.redeem(second) is None
    assert tickets.redeem(other) == "arm"
