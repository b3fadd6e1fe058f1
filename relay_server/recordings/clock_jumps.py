"""Finds jumps of a robot's clock in the stamps of its samples, which may arrive late."""

from __future__ import annotations

from relay_server.common.clock import Clock

FORWARD_SECONDS = 10.0
"""Least jump forward that is found: a sample that was late by less looks the same."""

BACK_SECONDS = 0.5
"""Least jump back that is found."""


class ClockJumps:
    """The stamps of one robot, by topic. Samples of a topic arrive in the order of their stamps.

    :param clock: whose seconds never jump
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._latest: dict[str, float] = {}
        self._least_lag: float | None = None
        """Least seconds between a stamp and its arrival, on different clocks."""

    def seconds(self, topic: str, stamp: int) -> float:
        """How far the clock has jumped before a sample; 0: it has not.

        :param stamp: nanoseconds
        """
        now = stamp / 1e9
        lag = self._clock.seconds() - now
        latest, least = self._latest.get(topic, now), self._least_lag
        self._latest[topic] = now
        if now < latest - BACK_SECONDS:
            self._latest = {topic: now}
            self._least_lag = lag
            return now - latest
        if least is not None and lag < least - FORWARD_SECONDS:
            self._least_lag = lag
            return least - lag
        self._least_lag = lag if least is None else min(least, lag)
        return 0.0
