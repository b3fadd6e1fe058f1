"""The transports of messages: webhooks, and Apprise if the administrator allows it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractAsyncContextManager, nullcontext
from typing import Any

from relay_db.queries import AlertRuleRecord
from relay_server.alerts import egress
from relay_server.alerts.apprise import AppriseTransport
from relay_server.alerts.egress import EgressPolicy, NameResolver, parse_networks
from relay_server.alerts.schemas import NotificationMessage, Undelivered
from relay_server.alerts.webhook import WebhookTransport


class Transports:
    """All transports.

    :param reactor: Twisted's
    :param wall: Unix time in seconds
    :param allowed: special or local networks that may be reached
    :param schemes: schemes of Apprise's URLs that may be used
    :param denied: further networks that may not be reached
    :raises Invalid: a network or a scheme is not valid
    """

    def __init__(
        self,
        reactor: Any,
        wall: Callable[[], float],
        allowed: Sequence[str],
        schemes: Sequence[str],
        denied: Sequence[str] = (),
    ) -> None:
        policy = EgressPolicy(egress.local_networks, parse_networks(allowed), parse_networks(denied))
        self._resolver = NameResolver(reactor)
        self._webhooks = WebhookTransport(reactor, self._resolver.addresses, policy, wall)
        self._apprise = (
            AppriseTransport(reactor, self._resolver.addresses, schemes, policy) if schemes else None
        )

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels that rules may have here."""
        return ("portal", "webhook", *(("apprise",) if self._apprise is not None else ()))

    @property
    def schemes(self) -> list[str]:
        """The schemes of Apprise's URLs that may be used."""
        return [] if self._apprise is None else self._apprise.schemes

    def start(self, relay: str) -> None:
        """Start the threads.

        :param relay: the relay's name, for messages
        """
        self._webhooks.relay = relay
        self._resolver.start()
        if self._apprise is not None:
            self._apprise.start()

    def stop(self) -> None:
        """End the threads; blocks until they have ended."""
        self._resolver.stop()
        if self._apprise is not None:
            self._apprise.stop()

    async def check(self, channel: str, url: str) -> None:
        """Check an address.

        :raises Invalid: it is not valid or not allowed
        """
        if channel == "webhook":
            self._webhooks.check(url)
        elif channel == "apprise" and self._apprise is not None:
            await self._apprise.check(url)

    def slot(self, rule: AlertRuleRecord, failing: bool) -> AbstractAsyncContextManager[None]:
        """A context that a message waits for, and holds while it is sent.

        :param failing: the rule's last message did not arrive
        """
        if rule.channel == "webhook" or self._apprise is None:
            return nullcontext()
        return self._apprise.slot(failing)

    async def send(self, rule: AlertRuleRecord, message: NotificationMessage) -> None:
        """Deliver one message, within :meth:`slot`.

        :raises Undelivered: it was not accepted
        """
        if rule.channel == "webhook":
            await self._webhooks.send(rule, message)
        elif self._apprise is not None:
            await self._apprise.send(rule, message)
        else:
            raise Undelivered("this relay no longer sends through Apprise", again=False)
