"""Token buckets: they allow bursts and bound the rate in the long run."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable


class TokenBucket:
    """One token bucket.

    :param rate: tokens per second
    :param burst: most tokens it holds
    :param seconds: a clock; when it is set back, no tokens are added
    """

    __slots__ = ("_at", "_burst", "_rate", "_seconds", "_tokens")

    def __init__(self, rate: float, burst: float, seconds: Callable[[], float]) -> None:
        self._rate = rate
        self._burst = burst
        self._seconds = seconds
        self._tokens = burst
        self._at = seconds()

    @property
    def wait(self) -> float:
        """Seconds until one token is there; 0 if there is one now."""
        return self.wait_for(1)

    def wait_for(self, cost: float) -> float:
        """Seconds until ``cost`` tokens are there."""
        self._fill()
        return max(0.0, (cost - self._tokens) / self._rate)

    @property
    def left(self) -> float:
        """Tokens now."""
        self._fill()
        return self._tokens

    def take(self, cost: float = 1) -> bool:
        """Take ``cost`` tokens if they are there; returns whether they were."""
        self._fill()
        if self._tokens < cost:
            return False
        self._tokens -= cost
        return True

    def give_back(self) -> None:
        """Return one token."""
        self._tokens = min(self._burst, self._tokens + 1)

    def _fill(self) -> None:
        now = self._seconds()
        self._tokens = min(self._burst, self._tokens + max(0.0, now - self._at) * self._rate)
        self._at = now


class Buckets:
    """A token bucket per key. The longest unused are forgotten first.

    :param rate: of each bucket, tokens per second
    :param burst: of each bucket
    :param most: buckets kept
    """

    def __init__(self, rate: float, burst: float, most: int, seconds: Callable[[], float]) -> None:
        self._rate = rate
        self._burst = burst
        self._most = most
        self._seconds = seconds
        self._buckets: OrderedDict[Hashable, TokenBucket] = OrderedDict()

    def take(self, key: Hashable) -> bool:
        """Take one token of this key; see :meth:`TokenBucket.take`."""
        return self.of(key).take()

    def of(self, key: Hashable) -> TokenBucket:
        """The bucket of a key."""
        bucket = self._buckets.get(key)
        if bucket is None:
            bucket = self._buckets[key] = TokenBucket(self._rate, self._burst, self._seconds)
        self._buckets.move_to_end(key)
        while len(self._buckets) > self._most:
            self._buckets.popitem(last=False)
        return bucket
