"""Quality of service matched to who is there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from relay_protocol.errors import Invalid
from relay_protocol.link import QoS

DEPTH = 512
"""Messages the middleware keeps for us: half a second at 1000 a second, while other processes have the processor."""

MAX_DEPTH = 1000

QUEUE_SIZE = 100
"""Messages a publisher keeps for its subscribers when nobody says how many."""

MAX_QUEUE_SIZE = 10_000


class Match(NamedTuple):
    """What a subscription has to know of its publishers.

    :param reliable: all of them send again what was lost
    :param latched: some of them keep messages for late joiners
    :param publishers: how many there are
    :param all_latched: whether all of them keep messages
    """

    reliable: bool
    latched: bool
    publishers: int
    all_latched: bool


def match(publishers: Sequence[QoSProfile]) -> Match:
    """What suits all these publishers; none yet: the usual."""
    if not publishers:
        return Match(False, False, 0, False)
    latched = [each.durability == DurabilityPolicy.TRANSIENT_LOCAL for each in publishers]
    return Match(
        all(each.reliability == ReliabilityPolicy.RELIABLE for each in publishers),
        any(latched),
        len(publishers),
        all(latched),
    )


def for_subscription(found: Match, asked: QoS | None) -> QoSProfile:
    """The profile to listen with."""
    profile = QoSProfile(
        depth=DEPTH,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE if found.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if found.all_latched else DurabilityPolicy.VOLATILE,
    )
    return _override(profile, asked)


def for_recall() -> QoSProfile:
    """The profile to get with what latched publishers keep."""
    return QoSProfile(
        depth=MAX_DEPTH,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def for_publisher(
    subscribers: Sequence[QoSProfile], latch: bool, asked: QoS | None, queue_size: int = 0
) -> QoSProfile:
    """The profile to publish with: reliable serves every subscriber; durable if asked or if all want it.

    :param queue_size: messages kept for subscribers that are slow; the usual below 1. Latched is the last one alone
    :raises Invalid: a wish that can't be met
    """
    if asked is not None and asked.history == "keep_all":
        # The reactor would wait in publish() for as long as one subscriber takes nothing.
        raise Invalid("qos: what is published keeps the last messages (history keep_last), not all of them")
    durable = latch or (
        bool(subscribers) and all(each.durability == DurabilityPolicy.TRANSIENT_LOCAL for each in subscribers)
    )
    profile = QoSProfile(
        depth=1 if latch else _queue(queue_size),
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if durable else DurabilityPolicy.VOLATILE,
    )
    return _override(profile, asked)


def _queue(size: int) -> int:
    return min(size, MAX_QUEUE_SIZE) if size > 0 else QUEUE_SIZE


def _override(profile: QoSProfile, asked: QoS | None) -> QoSProfile:
    if asked is None:
        return profile
    for name, policies in (
        ("history", HistoryPolicy),
        ("reliability", ReliabilityPolicy),
        ("durability", DurabilityPolicy),
    ):
        wish = getattr(asked, name)
        if wish is not None:
            setattr(profile, name, _policy(name, policies, wish))
    if asked.depth is not None:
        if not 0 < asked.depth <= MAX_DEPTH:
            raise Invalid(f"qos: depth is 1 to {MAX_DEPTH}")
        profile.depth = asked.depth
    for name in ("deadline", "lifespan"):
        seconds = getattr(asked, name)
        if seconds is not None:
            if not 0 < seconds < 1e9:
                raise Invalid(f"qos: {name} is a time in seconds above 0")
            setattr(profile, name, Duration(nanoseconds=int(seconds * 1e9)))
    return profile


_WISHES = {
    "history": ("keep_last", "keep_all"),
    "reliability": ("reliable", "best_effort", "best_available"),
    "durability": ("volatile", "transient_local", "best_available"),
}


def _policy(name: str, policies: Any, wish: str) -> Any:
    # BEST_AVAILABLE came with Iron.
    if wish not in _WISHES[name] or not hasattr(policies, wish.upper()):
        raise Invalid(f"qos: {name} is {', '.join(_WISHES[name])}, not '{wish}'")
    return getattr(policies, wish.upper())
