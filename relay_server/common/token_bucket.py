"""A token bucket: so many at once, so many a second after that."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable


class TokenBucket:
    """Allows bursts, bounds the rate in the long run.

    :param rate: tokens a second
    :param burst: tokens it holds at most
    :param seconds: a clock; one that is set back stands still for the bucket
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
        """Seconds until one more may pass; 0 when it may now."""
        return self.wait_for(1)

    def wait_for(self, cost: float) -> float:
        """The same for what takes so many tokens."""
        self._fill()
        return max(0.0, (cost - self._tokens) / self._rate)

    @property
    def left(self) -> float:
        """Tokens it holds now."""
        self._fill()
        return self._tokens

    def take(self, cost: float = 1) -> bool:
        """Whether one more may pass now; if so it is counted.

        :param cost: tokens that it takes
        """
        self._fill()
        if self._tokens < cost:
            return False
        self._tokens -= cost
        return True

    def give_back(self) -> None:
        """What was taken for one counts elsewhere."""
        self._tokens = min(self._burst, self._tokens + 1)

    def _fill(self) -> None:
        now = self._seconds()
        self._tokens = min(self._burst, self._tokens + max(0.0, now - self._at) * self._rate)
        self._at = now


class Buckets:
    """A bucket for each of those who take from one; the longest unused are forgotten first.

    :param rate: as of :class:`TokenBucket`, for each
    :param most: buckets that are kept
    """

    def __init__(self, rate: float, burst: float, most: int, seconds: Callable[[], float]) -> None:
        self._rate = rate
        self._burst = burst
        self._most = most
        self._seconds = seconds
        self._buckets: OrderedDict[Hashable, TokenBucket] = OrderedDict()

    def take(self, who: Hashable) -> bool:
        """As :meth:`TokenBucket.take`."""
        return self.of(who).take()

    def of(self, who: Hashable) -> TokenBucket:
        """The bucket of one of them."""
        bucket = self._buckets.get(who)
        if bucket is None:
            bucket = self._buckets[who] = TokenBucket(self._rate, self._burst, self._seconds)
        self._buckets.move_to_end(who)
        while len(self._buckets) > self._most:
            self._buckets.popitem(last=False)
        return bucket
