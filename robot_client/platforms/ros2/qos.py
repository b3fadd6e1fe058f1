"""Quality of service matched to who is there."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

from rclpy.duration import Duration
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
    qos_profile_services_default,
)

from relay_protocol import limits
from relay_protocol.errors import Invalid
from relay_protocol.link import QoS

DEPTH = 512
"""Messages the middleware keeps for us: half a second at 1000 a second, while other processes have the processor."""

MAX_DEPTH = 1000

QUEUE_SIZE = 100
"""Messages a publisher keeps for its subscribers when nobody says how many."""

MAX_QUEUE_SIZE = 10_000

_UNKNOWN = "_NODE_NAME_UNKNOWN_"
_NAMELESS = "a participant without a ROS node"

_TIMES = ("deadline", "liveliness_lease_duration")
"""What is to be no longer than a subscriber asks for."""

_INFINITE = 2**63 - 1
"""Nanoseconds that stand for no limit (``RMW_DURATION_INFINITE``)."""


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
    """The profile to publish with: it serves every subscriber, but for what is asked for otherwise.

    A subscriber is served by what is at least as strict as it asks for: reliable, durable, with a deadline and a lease
    of liveliness that are no longer (DDS 1.4, 2.2.3, requested and offered).

    :param queue_size: messages kept for subscribers that are slow; the usual below 1. Latched is the last one alone
    :raises Invalid: a wish that can't be met
    """
    if asked is not None and asked.history == "keep_all":
        # The reactor would wait in publish() for as long as one subscriber takes nothing.
        raise Invalid("qos: what is published keeps the last messages (history keep_last), not all of them")
    durable = latch or any(each.durability == DurabilityPolicy.TRANSIENT_LOCAL for each in subscribers)
    profile = QoSProfile(
        depth=1 if latch else _queue(queue_size),
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if durable else DurabilityPolicy.VOLATILE,
    )
    for name in _TIMES:
        times = [getattr(each, name).nanoseconds for each in subscribers]
        shortest = min((each for each in times if 0 < each < _INFINITE), default=0)
        if shortest:
            setattr(profile, name, Duration(nanoseconds=shortest))
    if any(each.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC for each in subscribers):
        profile.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC
    return _override(profile, asked)


def mismatch(publisher: QoSProfile, subscription: QoSProfile) -> str:
    """Why a subscription gets nothing of a publisher, in the middleware's words; empty when it does."""
    compatible, reason = qos_check_compatible(_explicit(publisher), _explicit(subscription))
    if compatible != QoSCompatibility.ERROR:
        return ""
    parts = [each.removeprefix("ERROR:").strip() for each in reason.split(";")]
    return "; ".join(each for each in parts if each) or "their qualities of service do not fit"


def lossy(servers: Sequence[Any]) -> bool:
    """Whether a service answers without sending again what was lost (best effort)."""
    return any(each.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for each in servers)


def for_service(lossy: bool) -> QoSProfile:
    """The profile of a service's client: the usual, or one that hears a service of best effort."""
    profile = copy.copy(qos_profile_services_default)
    if lossy:
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    return profile


def unsafe_service(servers: Sequence[Any]) -> str:
    """Why a service that is there is not called, because of its quality of service; empty where there is no reason."""
    if any(each.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for each in servers):
        return (
            "it asks for durability transient_local, by which a service that starts again carries old requests out "
            "again; let it be volatile"
        )
    return ""


def _explicit(profile: QoSProfile) -> QoSProfile:
    """The same with no limit of time spelled out, as in the graph: to the middleware's check 0 is something else."""
    found = copy.copy(profile)
    for name in _TIMES:
        if not 0 < getattr(found, name).nanoseconds < _INFINITE:
            setattr(found, name, Duration(nanoseconds=_INFINITE))
    return found


def unmatched(publishers: Sequence[Any], subscriptions: Sequence[Any], ours: QoSProfile) -> list[str]:
    """The nodes that don't hear us, or that we don't hear, with the reasons, sorted.

    :param publishers: what the graph tells of theirs, where ours is a subscription
    :param subscriptions: what the graph tells of theirs, where ours is a publisher
    """
    found = [(each, mismatch(each.qos_profile, ours)) for each in publishers]
    found += [(each, mismatch(ours, each.qos_profile)) for each in subscriptions]
    told = {f"{_name(each)}: {reason}"[: limits.NAME] for each, reason in found if reason}
    return sorted(told)[: limits.FACTS]


def named(nodes: list[str]) -> list[str]:
    """Without those whose name is not known; of a node that has just come that lasts for a moment."""
    return [each for each in nodes if not each.startswith(_NAMELESS)]


def _name(info: Any) -> str:
    if info.node_name == _UNKNOWN:
        return _NAMELESS
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


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
