"""Tickets of one use, with which a robot's new link says what it was asked to come for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from relay_protocol.limits import CHANNEL_TICKET_SECONDS
from relay_server.common.clock import Clock

T = TypeVar("T")


class Tickets(Generic[T]):
    """Who or what each ticket is for; of one and the same only the latest ticket is good.

    :param new_ticket: makes an unguessable text
    """

    def __init__(self, clock: Clock, new_ticket: Callable[[], str]) -> None:
        self._clock = clock
        self._new_ticket = new_ticket
        self._issued: dict[str, tuple[T, float]] = {}

    def __len__(self) -> int:
        """How many are kept."""
        return len(self._issued)

    def issue(self, owner: T) -> str:
        """A new ticket, good for :data:`~relay_protocol.limits.CHANNEL_TICKET_SECONDS`."""
        now = self._clock.seconds()
        self._issued = {
            ticket: (held, until)
            for ticket, (held, until) in self._issued.items()
            if held is not owner and until >= now
        }
        ticket = self._new_ticket()
        self._issued[ticket] = (owner, now + CHANNEL_TICKET_SECONDS)
        return ticket

    def redeem(self, ticket: str) -> T | None:
        """What the ticket is for, and the ticket is spent; ``None`` when it is unknown, used or too old."""
        found = self._issued.pop(ticket, None)
        return None if found is None or found[1] < self._clock.seconds() else found[0]

    def withdraw(self, owner: T) -> None:
        """What was issued for it is not good any more."""
        self._issued = {ticket: held for ticket, held in self._issued.items() if held[0] is not owner}
