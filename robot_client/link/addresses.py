"""The addresses of the relays that a robot may connect to."""

from __future__ import annotations

from collections.abc import Iterator

from relay_protocol.errors import Invalid
from robot_client.link.tls import split_address


class RelayAddresses:
    """One or several addresses, of which one is in use. Relays of a cluster serve the same robots.

    :param text: ``host:port``, or several with commas between them
    :raises Invalid: one can't be used, or there is none
    """

    def __init__(self, text: str) -> None:
        self._all = [each.strip() for each in text.split(",") if each.strip()]
        if not self._all:
            raise Invalid("the address of the relay is missing; write host:port")
        for each in self._all:
            split_address(each)
        self._at = 0

    def __iter__(self) -> Iterator[str]:
        return iter(self._all)

    @property
    def current(self) -> str:
        """The address in use, ``host:port``."""
        return self._all[self._at]

    def advance(self) -> None:
        """Use the next one, after the last the first."""
        self._at = (self._at + 1) % len(self._all)
