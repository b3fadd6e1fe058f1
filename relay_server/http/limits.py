"""Limits of requests and connections: rates, time, and connections of one address (SPEC 5)."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Awaitable, Callable, Coroutine, Hashable
from functools import partial
from typing import Any, TypeVar, cast

from twisted.internet.defer import CancelledError, Deferred
from twisted.web.server import Request

from relay_protocol.errors import SwitchboardError, Unavailable
from relay_protocol.limits import CLIENT_MESSAGE, FUNCTION_BODY, MIB, UNFINISHED_MESSAGES
from relay_server.auth.login_limiter import network_of
from relay_server.common.clock import Timer, cancel
from relay_server.common.token_bucket import Buckets
from relay_server.common.unfinished import UnfinishedBytes

UNAUTHENTICATED = 2000
"""Most unauthenticated connections of all networks."""

UNSENT_BYTES = 32 * MIB
"""Most bytes of answers that wait for the clients of one network."""

LARGE_OF_NETWORK = 2 * FUNCTION_BODY
LARGE_OF_ALL = 4 * FUNCTION_BODY
LARGE_UNKNOWN = FUNCTION_BODY
"""Most bytes of large bodies that are under way: of known senders of one network, of all known ones, and of all unknown
ones."""


class Slot:
    """The place of one unauthenticated connection. It is released when the client authenticates or disconnects.

    :param release: called once
    """

    def __init__(self, release: Callable[[], None]) -> None:
        self._release: Callable[[], None] | None = release

    def release(self) -> None:
        """Free the place. A second call has no effect."""
        release, self._release = self._release, None
        if release is not None:
            release()


class ConnectionLimits:
    """Counts connections per network (see :func:`relay_server.auth.login_limiter.network_of`), and those that are
    unauthenticated.

    :param most: connections that one network may hold at a time; 0 for no limit
    :param unauthenticated: unauthenticated connections of all networks
    """

    def __init__(self, most: int, unauthenticated: int = UNAUTHENTICATED) -> None:
        self._most = most
        self._free_slots = unauthenticated
        self._counts: Counter[str] = Counter()

    def enter(self, address: str) -> bool:
        """Count a connection; false if its network has too many. In both cases :meth:`leave` must follow."""
        network = network_of(address)
        self._counts[network] += 1
        return not self._most or self._counts[network] <= self._most

    def leave(self, address: str) -> None:
        """Count a connection as closed."""
        network = network_of(address)
        self._counts[network] -= 1
        if self._counts[network] <= 0:
            del self._counts[network]

    def unauthenticated(self) -> Slot | None:
        """A place for an unauthenticated connection; ``None`` if all are taken."""
        if self._free_slots <= 0:
            return None
        self._free_slots -= 1
        return Slot(self._released)

    def _released(self) -> None:
        self._free_slots += 1


class UncountedConnections(ConnectionLimits):
    """For the listener of the cluster: one relay has a connection for each websocket that it forwards."""

    def __init__(self) -> None:
        super().__init__(0)

    def enter(self, address: str) -> bool:
        """Count nothing."""
        return True

    def leave(self, address: str) -> None:
        """Nothing was counted."""


class SharedBytes(bytes):
    """Bytes that the relay holds anyway while it runs, so an answer that waits for its client costs no memory."""


class LargeBodyLimits:
    """Counts the bytes of large bodies that are under way, by network. Those of unknown senders count apart, so that
    they leave room for others."""

    def __init__(self) -> None:
        self._of: dict[tuple[bool, str], int] = {}

    def enter(self, address: str, length: int, *, known: bool) -> Callable[[], None] | None:
        """Count a body; returns what ends it, or ``None`` if too many bytes are under way.

        :param known: whether the sender's token is known to be valid
        """
        key = known, network_of(address)
        of_network, of_all = (LARGE_OF_NETWORK, LARGE_OF_ALL) if known else (LARGE_UNKNOWN, LARGE_UNKNOWN)
        counted = self._of.get(key, 0)
        total = sum(each for (of_known, _), each in self._of.items() if of_known == known)
        if counted + length > of_network or total + length > of_all:
            return None
        self._of[key] = counted + length
        return partial(self._ended, key, length)

    def _ended(self, key: tuple[bool, str], length: int) -> None:
        self._of[key] -= length
        if not self._of[key]:
            del self._of[key]


class Unsent:
    """Counts bytes of answers that wait for their clients, per network.

    :param most: bytes of one network; above it, the connection of the network that has waited longest is cut
    """

    def __init__(self, most: int = UNSENT_BYTES) -> None:
        self._most = most
        self._waiting: defaultdict[str, dict[Any, int]] = defaultdict(dict)

    def add(self, address: str, channel: Any, size: int) -> None:
        """Count the bytes of a connection that accepts nothing. Earlier bytes of it must have been removed.

        A connection without bytes is not counted, since cutting it would free nothing.
        """
        if size <= 0:
            return
        waiting = self._waiting[network_of(address)]
        waiting[channel] = size
        while sum(waiting.values()) > self._most:
            oldest = next(iter(waiting))
            del waiting[oldest]
            oldest.transport.abortConnection()

    def remove(self, address: str, channel: Any) -> None:
        """Count no bytes of this connection: it accepts them, or is closed."""
        network = network_of(address)
        waiting = self._waiting.get(network, {})
        waiting.pop(channel, None)
        if not waiting:
            self._waiting.pop(network, None)


BURST_SECONDS = 10.0
"""The requests of this time may come at once."""

KEPT = 10_000
"""Most users, and most networks, that are counted; those that sent nothing for longest are dropped first."""


YOU = "you"
YOUR_NETWORK = "your network"


class TooManyRequests(SwitchboardError):
    """Further requests are refused for ``retry_after`` seconds."""

    code = "too_many_requests"

    def __init__(self, sender: str, retry_after: float) -> None:
        super().__init__(f"too many requests from {sender}; try again in {int(retry_after) + 1} s")
        self.retry_after = retry_after


class TooManyStreams(SwitchboardError):
    """A user has the maximum number of streams open."""

    code = "too_many_streams"

    def __init__(self, most: int) -> None:
        super().__init__(
            f"you have {most} streams open (events, topics, cameras, pages of the portal), the most that one user may "
            "have; close one of them first"
        )


class RequestLimits:
    """Counts each request once, and puts the remaining number into its answer. Counts open streams, and bytes of
    websocket messages that are unfinished.

    :param rate: requests per second of one user or network in the long run; 0 for no limit
    :param seconds: a monotonic clock
    :param answer_seconds: time limit of a request (:mod:`relay_server.http.limits`); 0 for no limit
    :param streams: streams that one user may have open, including websockets of pages and cameras; 0 for no limit
    :param largest_message: bytes of the largest websocket message
    """

    def __init__(
        self,
        rate: float,
        seconds: Callable[[], float],
        streams: int = 0,
        answer_seconds: float = 0.0,
        largest_message: int = CLIENT_MESSAGE,
    ) -> None:
        self.unfinished = UnfinishedBytes(UNFINISHED_MESSAGES * largest_message)
        self.answer_seconds = answer_seconds
        self._rate = rate
        self._most_streams = streams
        self._streams: Counter[int] = Counter()
        self._burst = max(1.0, rate * BURST_SECONDS)
        self._users = Buckets(rate, self._burst, KEPT, seconds)
        self._networks = Buckets(rate, self._burst, KEPT, seconds)

    def of_user(self, request: Request, user: int) -> None:
        """Count the request for its authenticated user.

        :raises TooManyRequests: the user has sent too many
        """
        self._count(request, self._users, user, "user", YOU)

    def of_network(self, request: Request) -> None:
        """Count the request for the network of its sender.

        :raises TooManyRequests: too many came from that network
        """
        network = network_of(getattr(request.getClientAddress(), "host", "local"))
        self._count(request, self._networks, network, "network", YOUR_NETWORK)

    def stream(self, user: int) -> Callable[[], None]:
        """Count a stream that a user opens. Returns a function to be called once, when the stream ends.

        :raises TooManyStreams: the user has too many already
        """
        if 0 < self._most_streams <= self._streams[user]:
            raise TooManyStreams(self._most_streams)
        self._streams[user] += 1

        def end() -> None:
            self._streams[user] -= 1
            if not self._streams[user]:
                del self._streams[user]

        return end

    def answer_streams(self, request: Request, user: int) -> None:
        """The same for a stream that is the answer to a request, and ends with it.

        :raises TooManyStreams: as :meth:`stream`
        :raises Unavailable: the client has disconnected, so the end of the stream could not be noticed
        """
        if request._disconnected:
            raise Unavailable("the client has disconnected")
        end = self.stream(user)
        request.notifyFinish().addBoth(lambda _: end())

    def handshake(self, address: str) -> Callable[[int], None]:
        """Count a websocket's handshake for its network, before its credentials are looked up.

        Returns a function that counts it for a user instead. It is to be called once, when the user is known, and
        raises the same error.

        :raises TooManyRequests: too many came from that network
        """
        if self._rate <= 0:
            return lambda user: None
        network = self._networks.of(network_of(address))
        if not network.take():
            raise TooManyRequests(YOUR_NETWORK, network.wait)

        def count_for_user(user: int) -> None:
            network.give_back()
            bucket = self._users.of(user)
            if not bucket.take():
                raise TooManyRequests(YOU, bucket.wait)

        return count_for_user

    def _count(self, request: Request, buckets: Buckets, key: Hashable, name: str, sender: str) -> None:
        if self._rate <= 0 or request.__dict__.get("counted"):
            # A stream authenticates its reader again and again.
            return
        request.counted = True
        bucket = buckets.of(key)
        passes = bucket.take()
        whole = math.ceil((self._burst - bucket.left) / self._rate)
        policy = f'"{name}";q={int(self._burst)};w={math.ceil(self._burst / self._rate)}'
        request.setHeader("ratelimit-policy", policy)
        request.setHeader("ratelimit", f'"{name}";r={int(bucket.left)};t={whole}')
        if not passes:
            raise TooManyRequests(sender, bucket.wait)


T = TypeVar("T")

ROBOT_SECONDS = 15.0
"""Additional time of a request about a robot: the robot may have to open a channel first, and then to answer."""


class NoAnswer(Unavailable):
    """A request was not answered in time."""

    code = "no_answer"

    def __init__(self, seconds: float) -> None:
        super().__init__(
            f"no answer within {seconds:g} s: the database or the robot does not answer. The request may still have "
            "been carried out: check before you send it again, or send it with an Idempotency-Key"
        )


def extend_time_limit(request: Request, seconds: float) -> None:
    """Extend the time limit of a request by these seconds."""
    request.__dict__["extended"] = request.__dict__.get("extended", 0.0) + seconds


async def in_time(request: Request, work: Awaitable[T]) -> T:
    """Run the work of a request, and cancel it at the time limit. An answer that has begun may continue for ever.

    :raises NoAnswer: the time limit was reached
    """
    reactor, limit = request.site.reactor, request.site.limits.answer_seconds
    running: Deferred[T] = Deferred.fromCoroutine(cast("Coroutine[Deferred[Any], Any, T]", work))
    began = reactor.seconds()
    timer: Timer | None = None
    late = False

    def check() -> None:
        nonlocal timer, late
        left = began + limit + request.__dict__.get("extended", 0.0) - reactor.seconds()
        if left > 0:
            timer = reactor.callLater(left, check)
        elif not request.startedWriting:
            late = True
            running.cancel()

    if limit > 0:
        timer = reactor.callLater(limit, check)
    try:
        return await running
    except CancelledError:
        if late:
            raise NoAnswer(reactor.seconds() - began) from None
        raise
    finally:
        cancel(timer)
