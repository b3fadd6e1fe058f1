"""The bus between the relays of a cluster: messages by subject, requests, and leases.

Messages are delivered at most once. A request carries all that its receiver needs, and repeating it does no harm.
"""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable
from typing import Protocol

from twisted.internet.defer import Deferred

from relay_protocol.errors import Invalid, SwitchboardError, Unavailable
from relay_server.common.clock import Clock
from relay_server.common.concurrency import with_timeout

LEASE_SECONDS = 15.0
"""Seconds until the lease of a relay that has died ends. Writes of leases stop for about 6 s when a server of three is
lost, so it must be much longer."""

LARGEST = 512 * 1024
"""Most bytes of a message."""

Receive = Callable[[str, bytes], "bytes | Awaitable[bytes] | None"]
"""Called with the subject and body of a message. For a request it returns the reply, now or later. A
:class:`SwitchboardError` that it raises reaches the sender as :class:`RequestRefused`."""

OnState = Callable[[bool], None]
"""Called with whether the bus is connected, at each change."""

_WORD = r"[A-Za-z0-9_-]{1,64}"
_SUBJECT = re.compile(rf"{_WORD}(\.{_WORD}){{0,7}}\Z")
_PATTERN = re.compile(rf"({_WORD}|\*)(\.({_WORD}|\*)){{0,7}}(\.>)?\Z")


class NoResponder(Unavailable):
    """No relay has subscribed to the subject of a request."""


class RequestRefused(Unavailable):
    """The receiver of a request has refused it, with the reason."""


class LeaseUnavailable(Unavailable):
    """Another relay has the lease."""


class BusLease(Protocol):
    """A lease that this relay has. It is renewed until it is released.

    :ivar on_lost: called once if it could not be renewed in time, or another relay has taken it
    """

    on_lost: Callable[[], None]

    async def release(self) -> None:
        """End it, so that another relay can have it now. Does nothing if it was lost."""


class ClusterBus(Protocol):
    """See the module. All methods are called, and all callbacks are made, in the reactor's thread."""

    connected: bool

    async def start(self) -> None:
        """Connect. If no server answers, it is tried again for ever and :attr:`connected` is false meanwhile."""

    async def stop(self) -> None:
        """Disconnect; leases that were not released end by themselves."""

    def publish(self, subject: str, body: bytes) -> None:
        """Send a message to all that have subscribed, this relay included. It is lost while the bus is disconnected.

        :raises Invalid: the subject can't be used, or the body is longer than :data:`LARGEST`
        """

    def subscribe(self, pattern: str, receive: Receive, queue: str = "") -> Callable[[], None]:
        """Receive messages and requests.

        :param pattern: a subject; ``*`` stands for one token, ``>`` at the end for one or more
        :param queue: of all subscriptions with the same pattern and queue, one receives each message
        :returns: a function that ends the subscription
        :raises Invalid: the pattern can't be used
        """

    async def request(self, subject: str, body: bytes, timeout: float) -> bytes:
        """Send a request to one subscriber, and wait for its reply.

        :param timeout: seconds
        :raises NoResponder: there is no subscriber
        :raises RequestRefused: the receiver raised a :class:`SwitchboardError`
        :raises Unavailable: no reply in time, or the bus is disconnected
        """

    async def lease(self, key: str, value: bytes) -> BusLease:
        """Acquire a lease.

        :param value: differs from that of all other relays
        :raises LeaseUnavailable: another has it
        :raises Unavailable: the bus does not answer; whether the lease is free is not known
        """

    async def leases(self, prefix: str) -> dict[str, bytes]:
        """Values of the current leases below a prefix, by key.

        :raises Unavailable: the bus does not answer
        """

    def on_state(self, listener: OnState) -> None:
        """Notify of each change of :attr:`connected`."""


def check_subject(subject: str) -> None:
    """:raises Invalid: it is not of one to eight tokens of letters, digits, ``_`` and ``-``, joined by dots"""
    if not _SUBJECT.match(subject):
        raise Invalid(
            f"'{subject[:80]}' is not a subject: tokens of letters, digits, _ and -, joined by dots"
        )


def check_pattern(pattern: str) -> None:
    """:raises Invalid: as :func:`check_subject`, where a token may be ``*`` and the last one ``>``"""
    if not _PATTERN.match(pattern):
        raise Invalid(f"'{pattern[:80]}' is not a pattern of subjects, as robots.*.stop or robots.>")


def check_body(body: bytes) -> None:
    """:raises Invalid: it is longer than :data:`LARGEST`"""
    if len(body) > LARGEST:
        raise Invalid(f"a message of {len(body)} bytes is too long for the bus; it takes {LARGEST}")


def timed_out(subject: str, timeout: float) -> str:
    """The message of the error for a request without a reply."""
    return f"no reply to {subject} within {timeout:g} s"


def no_responder(subject: str) -> NoResponder:
    """The error for a request without a receiver."""
    return NoResponder(f"no relay responds to {subject}")


class LocalBus:
    """The bus of a relay that is alone (:class:`ClusterBus`): everything stays in this process."""

    connected = True

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._subscriptions: list[_LocalSubscription] = []
        self._leases: dict[str, bytes] = {}
        self._turns = 0

    async def start(self) -> None:
        """Nothing to connect to."""

    async def stop(self) -> None:
        """Nothing to disconnect from."""

    def publish(self, subject: str, body: bytes) -> None:
        """See :meth:`ClusterBus.publish`."""
        check_subject(subject)
        check_body(body)
        for each in self._receivers(subject):
            self._clock.callLater(0, each.deliver, subject, body)

    def subscribe(self, pattern: str, receive: Receive, queue: str = "") -> Callable[[], None]:
        """See :meth:`ClusterBus.subscribe`."""
        check_pattern(pattern)
        subscription = _LocalSubscription(pattern, receive, queue)
        self._subscriptions.append(subscription)

        def end() -> None:
            if subscription in self._subscriptions:
                self._subscriptions.remove(subscription)
                subscription.ended = True

        return end

    async def request(self, subject: str, body: bytes, timeout: float) -> bytes:
        """See :meth:`ClusterBus.request`."""
        check_subject(subject)
        check_body(body)
        receivers = self._receivers(subject)
        if not receivers:
            raise no_responder(subject)
        return await with_timeout(
            self._clock, timeout, receivers[0].reply(subject, body), timed_out(subject, timeout)
        )

    async def lease(self, key: str, value: bytes) -> BusLease:
        """See :meth:`ClusterBus.lease`."""
        check_subject(key)
        if key in self._leases:
            raise LeaseUnavailable(f"another relay has the lease {key}")
        self._leases[key] = value
        return _LocalLease(self._leases, key)

    async def leases(self, prefix: str) -> dict[str, bytes]:
        """See :meth:`ClusterBus.leases`."""
        check_subject(prefix)
        return {key: value for key, value in self._leases.items() if key.startswith(prefix + ".")}

    def on_state(self, listener: OnState) -> None:
        """It never changes."""

    def _receivers(self, subject: str) -> list[_LocalSubscription]:
        """Those that receive a message: all without a queue, and one of each queue."""
        matching = [each for each in self._subscriptions if each.matches(subject)]
        groups: dict[tuple[str, str], list[_LocalSubscription]] = {}
        for each in matching:
            if each.queue:
                groups.setdefault((each.pattern, each.queue), []).append(each)
        self._turns += 1
        chosen = [group[self._turns % len(group)] for group in groups.values()]
        return [each for each in matching if not each.queue] + chosen


class _LocalSubscription:
    def __init__(self, pattern: str, receive: Receive, queue: str) -> None:
        self.pattern = pattern
        self.queue = queue
        self.ended = False
        self._receive = receive
        self._tokens = pattern.split(".")

    def matches(self, subject: str) -> bool:
        tokens = subject.split(".")
        if self._tokens[-1] == ">":
            if len(tokens) < len(self._tokens):
                return False
            tokens = [*tokens[: len(self._tokens) - 1], ">"]
        return len(tokens) == len(self._tokens) and all(
            expected in ("*", token) for expected, token in zip(self._tokens, tokens, strict=True)
        )

    def deliver(self, subject: str, body: bytes) -> None:
        if not self.ended:
            Deferred.fromCoroutine(self.reply(subject, body)).addErrback(lambda failure: None)

    async def reply(self, subject: str, body: bytes) -> bytes:
        return await reply_of(self._receive, subject, body)


class _LocalLease:
    def __init__(self, leases: dict[str, bytes], key: str) -> None:
        self.on_lost: Callable[[], None] = _nothing
        self._leases = leases
        self._key = key

    async def release(self) -> None:
        self._leases.pop(self._key, None)


async def reply_of(receive: Receive, subject: str, body: bytes) -> bytes:
    """The reply of a receiver to a message.

    :raises RequestRefused: it raised a :class:`SwitchboardError`
    """
    try:
        reply = receive(subject, body)
        if reply is None:
            return b""
        return reply if isinstance(reply, bytes) else await reply
    except SwitchboardError as error:
        raise RequestRefused(str(error)) from None


def _nothing() -> None:
    """Do nothing when a lease is lost."""
