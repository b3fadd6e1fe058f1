"""What clients that offer services and actions were asked to do, and have not answered."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TypeVar

from relay_protocol import rosbridge
from relay_protocol.errors import Refused, Unavailable
from relay_server.channel.offers import Offer, Provider
from relay_server.clock import Clock, Timer, cancel
from relay_server.outbox import CONTROL_BYTES

WAITING = 256
"""Calls and goals that may wait for one client."""

WAITING_BYTES = CONTROL_BYTES // 4 * 3
"""Their arguments together. A client that reads slowly is not cut for what others ask of it."""

PLACE_SECONDS = 30.0
"""What nobody waits for any more keeps its place for so long, or until it is answered: it may not be read yet."""


class Errand(ABC):
    """One call or goal on its way to the client that offers the service or action.

    :param id: unguessable; only the client that was asked knows it
    :param args: JSON
    """

    def __init__(self, id: str, offer: Offer, args: bytes) -> None:
        self.id = id
        self.offer = offer
        self.size = len(args)
        self.fading: Timer | None = None

    @abstractmethod
    def withdrawn(self, reason: str) -> None:
        """The client will never answer."""


E = TypeVar("E", bound=Errand)


class Errands:
    """All of one channel.

    :param new_id: makes an unguessable text
    """

    def __init__(self, clock: Clock, new_id: Callable[[], str]) -> None:
        self._clock = clock
        self.new_id = new_id
        self._of: dict[Provider, dict[str, Errand]] = {}

    def add(self, errand: Errand) -> None:
        """One more.

        :raises Unavailable: the client has too much to do
        """
        offer = errand.offer
        waiting = self._of.get(offer.member, {})
        if len(waiting) >= WAITING:
            raise Unavailable(f"{WAITING} calls and goals wait for the client that offers {offer.name}")
        if errand.size + sum(each.size for each in waiting.values()) > WAITING_BYTES:
            raise Unavailable(
                f"this is too large for the client that offers {offer.name}, with what waits for it already"
            )
        self._of.setdefault(offer.member, {})[errand.id] = errand

    def find(self, member: Provider, id: rosbridge.Id, kind: type[E]) -> E:
        """What this client was asked under this id.

        :raises Refused: nothing; others' ids are not told from unknown ones
        """
        errand = self._of.get(member, {}).get(str(id))
        if not isinstance(errand, kind):
            raise Refused(f"you were asked nothing under the id '{str(id)[:80]}', or it is over")
        return errand

    def remove(self, errand: Errand) -> None:
        """It is answered, or its time is over."""
        cancel(errand.fading)
        waiting = self._of.get(errand.offer.member, {})
        waiting.pop(errand.id, None)
        if not waiting:
            self._of.pop(errand.offer.member, None)

    def fade(self, errand: Errand) -> None:
        """Nobody waits for the answer any more."""
        if errand.fading is None and errand.id in self._of.get(errand.offer.member, {}):
            errand.fading = self._clock.callLater(PLACE_SECONDS, self.remove, errand)

    def offer_ended(self, offer: Offer, reason: str) -> None:
        """What the offering client was asked will not be answered."""
        for errand in list(self._of.get(offer.member, {}).values()):
            if errand.offer is offer:
                self.remove(errand)
                errand.withdrawn(reason)
