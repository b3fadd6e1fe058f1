"""The ways on which messages leave: webhooks, and whatever apprise can do where the administrator allows it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractAsyncContextManager, nullcontext
from typing import Any

from relay_db.queries import AlertRuleRecord
from relay_protocol.errors import Invalid
from relay_server.alerts import egress, email
from relay_server.alerts.egress import EgressPolicy, NameResolver, parse_networks
from relay_server.alerts.email import Mailing
from relay_server.alerts.message import NotificationMessage, Undelivered
from relay_server.alerts.webhook import Webhooks


class Transports:
    """All of them.

    :param reactor: Twisted's
    :param wall: Unix time in seconds
    :param special: networks that may be reached though they are special ones, or the machine's own
    :param schemes: beginnings of apprise's URLs that may be used
    :param never: networks that may not be reached though they are neither
    :raises Invalid: a network or a scheme that is none
    """

    def __init__(
        self,
        reactor: Any,
        wall: Callable[[], float],
        special: Sequence[str],
        schemes: Sequence[str],
        never: Sequence[str] = (),
    ) -> None:
        fence = EgressPolicy(egress.local_networks, parse_networks(special), parse_networks(never))
        check_schemes(schemes)
        self._names = NameResolver(reactor)
        self._webhooks = Webhooks(reactor, self._names.addresses, fence, wall)
        self._mailing = Mailing(reactor, self._names.addresses, schemes, fence) if schemes else None

    @property
    def channels(self) -> tuple[str, ...]:
        """What a rule may have here."""
        return ("portal", "webhook", *(("apprise",) if self._mailing is not None else ()))

    @property
    def schemes(self) -> list[str]:
        """Beginnings of apprise's URLs that may be used."""
        return [] if self._mailing is None else self._mailing.schemes

    def start(self, relay: str) -> None:
        """Start the threads.

        :param relay: the relay's name, for those who are told
        """
        self._webhooks.relay = relay
        self._names.start()
        if self._mailing is not None:
            self._mailing.start()

    def stop(self) -> None:
        """Finish what is under way; blocks for as long as that takes."""
        self._names.stop()
        if self._mailing is not None:
            self._mailing.stop()

    async def check(self, channel: str, url: str) -> None:
        """Whether a rule may send there.

        :raises Invalid: it may not, in words
        """
        if channel == "webhook":
            self._webhooks.check(url)
        elif channel == "apprise" and self._mailing is not None:
            await self._mailing.check(url)

    def room(self, rule: AlertRuleRecord, doubtful: bool) -> AbstractAsyncContextManager[None]:
        """What a message of a rule has to wait for, and keeps while it is sent.

        :param doubtful: the one before did not arrive
        """
        if rule.channel == "webhook" or self._mailing is None:
            return nullcontext()
        return self._mailing.room(doubtful)

    async def send(self, rule: AlertRuleRecord, message: NotificationMessage) -> None:
        """Deliver one message, within :meth:`room`.

        :raises Undelivered: it was not taken
        """
        if rule.channel == "webhook":
            await self._webhooks.send(rule, message)
        elif self._mailing is not None:
            await self._mailing.send(rule, message)
        else:
            raise Undelivered("this relay does not send by apprise any more", again=False)


def check_schemes(schemes: Sequence[str]) -> None:
    """Whether these are schemes that may be allowed.

    :raises Invalid: they are not, or apprise is not there
    """
    for each in schemes:
        if not each.isalnum() or each in email.NEVER:
            raise Invalid(f"'{each}' is no scheme of apprise that a relay can allow; write one as mailtos")
    if schemes and not email.available():
        raise Invalid("apprise is not installed: install the extra 'alerts', or allow no schemes")
