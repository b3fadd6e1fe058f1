"""Quality of service that matches the publishers and subscribers of the graph."""

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
"""Depth of subscriptions: half a second at 1000 messages a second, while other processes have the
processor."""

MAX_DEPTH = 1000

QUEUE_SIZE = 100
"""Default depth of publishers."""

MAX_QUEUE_SIZE = 10_000

_UNKNOWN = "_NODE_NAME_UNKNOWN_"
_NAMELESS = "a participant without a ROS node"

_TIMES = ("deadline", "liveliness_lease_duration")
"""Policies that must not be longer than a subscriber requests."""

_INFINITE = 2**63 - 1
"""Nanoseconds that mean no limit (``RMW_DURATION_INFINITE``)."""


class Match(NamedTuple):
    """Publishers of a topic.

    :param reliable: whether all are reliable
    :param latched: whether some keep messages for late joiners
    :param publishers: their number
    :param all_latched: whether all keep messages
    """

    reliable: bool
    latched: bool
    publishers: int
    all_latched: bool


def match(publishers: Sequence[QoSProfile]) -> Match:
    """Combine the profiles of all publishers."""
    if not publishers:
        return Match(False, False, 0, False)
    latched = [each.durability == DurabilityPolicy.TRANSIENT_LOCAL for each in publishers]
    return Match(
        all(each.reliability == ReliabilityPolicy.RELIABLE for each in publishers),
        any(latched),
        len(publishers),
        all(latched),
    )


def for_subscription(found: Match, requested: QoS | None) -> QoSProfile:
    """Profile of a subscription that all publishers match."""
    profile = QoSProfile(
        depth=DEPTH,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE if found.reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if found.all_latched else DurabilityPolicy.VOLATILE,
    )
    return _override(profile, requested)


def for_latched() -> QoSProfile:
    """Profile of a subscription for the samples that latched publishers keep."""
    return QoSProfile(
        depth=MAX_DEPTH,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


def for_publisher(
    subscribers: Sequence[QoSProfile], latch: bool, requested: QoS | None, queue_size: int = 0
) -> QoSProfile:
    """Profile of a publisher that all subscribers match, except for policies that the client requests.

    A subscriber matches if the offer is at least as strict as its request: reliable, durable, and with a
    deadline and a liveliness lease that are not longer (DDS 1.4, 2.2.3).

    :param queue_size: depth; below 1 the default. A latched publisher keeps only the last message
    :raises Invalid: a requested policy is not possible
    """
    if requested is not None and requested.history == "keep_all":
        # publish() would block the reactor while a subscriber reads nothing.
        raise Invalid("qos: publishers need history keep_last; keep_all could block the robot's daemon")
    durable = latch or any(each.durability == DurabilityPolicy.TRANSIENT_LOCAL for each in subscribers)
    profile = QoSProfile(
        depth=1 if latch else _depth(queue_size),
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
    return _override(profile, requested)


def mismatch(publisher: QoSProfile, subscription: QoSProfile) -> str:
    """Why a subscription does not match a publisher, as the middleware explains it; empty if it does."""
    compatible, reason = qos_check_compatible(_explicit(publisher), _explicit(subscription))
    if compatible != QoSCompatibility.ERROR:
        return ""
    parts = [each.removeprefix("ERROR:").strip() for each in reason.split(";")]
    return "; ".join(each for each in parts if each) or "their qualities of service are incompatible"


def is_best_effort(servers: Sequence[Any]) -> bool:
    """Whether a service has reliability best effort."""
    return any(each.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT for each in servers)


def for_service(best_effort: bool) -> QoSProfile:
    """Profile of a service client: the default, or one that matches a best-effort service."""
    profile = copy.copy(qos_profile_services_default)
    if best_effort:
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    return profile


def unsafe_service(servers: Sequence[Any]) -> str:
    """Why a service must not be called, because of its quality of service; empty if it may."""
    if any(each.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for each in servers):
        return (
            "it requests durability transient_local, so a restarted service would execute old requests "
            "again; set it to volatile"
        )
    return ""


def _explicit(profile: QoSProfile) -> QoSProfile:
    """The same profile with unlimited times written as infinite: the middleware's check treats 0
    differently."""
    found = copy.copy(profile)
    for name in _TIMES:
        if not 0 < getattr(found, name).nanoseconds < _INFINITE:
            setattr(found, name, Duration(nanoseconds=_INFINITE))
    return found


def unmatched(publishers: Sequence[Any], subscriptions: Sequence[Any], ours: QoSProfile) -> list[str]:
    """Nodes whose endpoints do not match ours, with the reasons, sorted.

    :param publishers: their endpoints, if ours is a subscription
    :param subscriptions: their endpoints, if ours is a publisher
    """
    found = [(each, mismatch(each.qos_profile, ours)) for each in publishers]
    found += [(each, mismatch(ours, each.qos_profile)) for each in subscriptions]
    described = {f"{_name(each)}: {reason}"[: limits.NAME] for each, reason in found if reason}
    return sorted(described)[: limits.LIST_ITEMS]


def with_known_names(nodes: list[str]) -> list[str]:
    """Without nodes of unknown name; the name of a new node is unknown for a moment."""
    return [each for each in nodes if not each.startswith(_NAMELESS)]


def _name(info: Any) -> str:
    if info.node_name == _UNKNOWN:
        return _NAMELESS
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


def _depth(size: int) -> int:
    return min(size, MAX_QUEUE_SIZE) if size > 0 else QUEUE_SIZE


def _override(profile: QoSProfile, requested: QoS | None) -> QoSProfile:
    if requested is None:
        return profile
    for name, policies in (
        ("history", HistoryPolicy),
        ("reliability", ReliabilityPolicy),
        ("durability", DurabilityPolicy),
    ):
        value = getattr(requested, name)
        if value is not None:
            setattr(profile, name, _policy(name, policies, value))
    if requested.depth is not None:
        if not 0 < requested.depth <= MAX_DEPTH:
            raise Invalid(f"qos: depth is {requested.depth}; it must be 1 to {MAX_DEPTH}")
        profile.depth = requested.depth
    for name in ("deadline", "lifespan"):
        seconds = getattr(requested, name)
        if seconds is not None:
            if not 0 < seconds < 1e9:
                raise Invalid(f"qos: {name} is {seconds}; it must be a time in seconds above 0")
            setattr(profile, name, Duration(nanoseconds=int(seconds * 1e9)))
    return profile


_VALUES = {
    "history": ("keep_last", "keep_all"),
    "reliability": ("reliable", "best_effort", "best_available"),
    "durability": ("volatile", "transient_local", "best_available"),
}


def _policy(name: str, policies: Any, value: str) -> Any:
    # BEST_AVAILABLE came with Iron.
    if value not in _VALUES[name] or not hasattr(policies, value.upper()):
        raise Invalid(f"qos: {name} is '{value}'; it must be one of {', '.join(_VALUES[name])}")
    return getattr(policies, value.upper())
