"""Tickets for one use. A robot's new link presents one to join the channel or stream it was dialled for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from relay_protocol.limits import CHANNEL_TICKET_SECONDS
from relay_server.common.clock import Clock

T = TypeVar("T")


class Tickets(Generic[T]):
    """Open tickets with their owners. Only the latest ticket of an owner is valid.

    :param new_ticket: makes an unguessable text
    """

    def __init__(self, clock: Clock, new_ticket: Callable[[], str]) -> None:
        self._clock = clock
        self._new_ticket = new_ticket
        self._issued: dict[str, tuple[T, float]] = {}

    def __len__(self) -> int:
        """The number of open tickets."""
        return len(self._issued)

    def issue(self, owner: T) -> str:
        """A new ticket, valid for :data:`~relay_protocol.limits.CHANNEL_TICKET_SECONDS`."""
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
        """Spend a ticket. Returns its owner, or ``None`` if it is unknown, used or expired."""
        found = self._issued.pop(ticket, None)
        return None if found is None or found[1] < self._clock.seconds() else found[0]

    def withdraw(self, owner: T) -> None:
        """Invalidate the tickets of an owner."""
        self._issued = {ticket: held for ticket, held in self._issued.items() if held[0] is not owner}
