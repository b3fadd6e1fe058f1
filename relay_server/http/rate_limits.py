"""How many requests one user may send, and one network from which nobody is known (SPEC sections 1.13 and 5).

The headers are those of draft-ietf-httpapi-ratelimit-headers.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Hashable

from twisted.web.server import Request

from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.auth.login_limiter import network_of
from relay_server.common.token_bucket import Buckets

BURST_SECONDS = 10.0
"""What is allowed in so long may come at once."""

KEPT = 10_000
"""Users, and networks, whose requests are counted; the longest unseen are forgotten first."""


class TooManyRequests(SwitchboardError):
    """Further requests are refused for ``retry_after`` seconds."""

    code = "too_many_requests"

    def __init__(self, who: str, retry_after: float) -> None:
        super().__init__(f"too many requests of {who}; try again in {int(retry_after) + 1} s")
        self.retry_after = retry_after


class TooManyStreams(SwitchboardError):
    """A user has as many streams open as one may have."""

    code = "too_many_streams"

    def __init__(self, most: int) -> None:
        super().__init__(
            f"you have {most} streams open, as many as one user may (events, topics, cameras, pages of the portal); "
            "close one of them first"
        )


class RequestLimits:
    """Counts requests, each once, and tells in its answer what is left. Counts streams that are open.

    :param rate: requests a second of one user or network in the long run; 0 for as many as come
    :param seconds: a monotonic clock
    :param answer_seconds: a request is answered within that (:mod:`relay_server.http.time_limit`); 0 for no limit
    :param streams: answers without an end that one user may have open, websockets of pages and cameras among them; 0
        for as many as come
    """

    def __init__(
        self, rate: float, seconds: Callable[[], float], streams: int = 0, answer_seconds: float = 0.0
    ) -> None:
        self.answer_seconds = answer_seconds
        self._rate = rate
        self._most_streams = streams
        self._streams: Counter[int] = Counter()
        self._burst = max(1.0, rate * BURST_SECONDS)
        self._users = Buckets(rate, self._burst, KEPT, seconds)
        self._networks = Buckets(rate, self._burst, KEPT, seconds)

    def of_user(self, request: Request, user: int) -> None:
        """Count it for who has proved who he is.

        :raises TooManyRequests: he has sent too many
        """
        self._count(request, self._users, user, "user", "yours")

    def of_network(self, request: Request) -> None:
        """Count it for the network it comes from.

        :raises TooManyRequests: too many came from there
        """
        network = network_of(getattr(request.getClientAddress(), "host", "local"))
        self._count(request, self._networks, network, "network", "your network")

    def stream(self, user: int) -> Callable[[], None]:
        """Count a stream that a user opens; call what is returned once, when it ends.

        :raises TooManyStreams: they have too many already
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
        :raises Unavailable: the client has left: nothing would tell that the stream ends
        """
        if request._disconnected:
            raise Unavailable("the client has left")
        end = self.stream(user)
        request.notifyFinish().addBoth(lambda _: end())

    def handshake(self, address: str) -> Callable[[int], None]:
        """Count a websocket's handshake for its network, before anybody looks up what it proves.

        Returns what counts it for a user instead, to be called once when it is known whose it is; that raises the same.

        :raises TooManyRequests: too many came from there
        """
        if self._rate <= 0:
            return lambda user: None
        network = self._networks.of(network_of(address))
        if not network.take():
            raise TooManyRequests("your network", network.wait)

        def known(user: int) -> None:
            network.give_back()
            bucket = self._users.of(user)
            if not bucket.take():
                raise TooManyRequests("yours", bucket.wait)

        return known

    def _count(self, request: Request, buckets: Buckets, who: Hashable, name: str, words: str) -> None:
        if self._rate <= 0 or request.__dict__.get("counted"):
            # Whoever reads a stream is proved again and again.
            return
        request.counted = True
        bucket = buckets.of(who)
        passes = bucket.take()
        whole = math.ceil((self._burst - bucket.left) / self._rate)
        policy = f'"{name}";q={int(self._burst)};w={math.ceil(self._burst / self._rate)}'
        request.setHeader("ratelimit-policy", policy)
        request.setHeader("ratelimit", f'"{name}";r={int(bucket.left)};t={whole}')
        if not passes:
            raise TooManyRequests(words, bucket.wait)
