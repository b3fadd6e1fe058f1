"""Parses the quality of service of clients (SPEC 1.2, ``qos``) into the form that robots receive."""

from __future__ import annotations

from typing import Any

from msgspec.structs import force_setattr

from relay_protocol import link

POLICIES = {
    "history": ("keep_last", "keep_all"),
    "reliability": ("reliable", "best_effort", "best_available"),
    "durability": ("volatile", "transient_local", "best_available"),
}
"""Values of each policy. ``system_default`` is accepted as well, and means the same as no value."""

UNLIMITED_SECONDS = 1e9
"""A duration this long or longer means no limit. ROS 2 writes infinite durations as 2**63 - 1 nanoseconds."""

_SYSTEM_DEFAULT = "system_default"
_TIMES = {"deadline": ("infinite", "best_available"), "lifespan": ("infinite",)}
_LARGEST_DEPTH = 2**31 - 1


class QoS(link.QoS, frozen=True, kw_only=True):
    """:class:`relay_protocol.link.channel.QoS` that accepts every spelling clients use for its values.

    :raises ValueError: an unknown value; msgspec adds the path to it
    """

    history: Any = None
    depth: Any = None
    reliability: Any = None
    durability: Any = None
    deadline: Any = None
    lifespan: Any = None

    def __post_init__(self) -> None:
        """Normalise every value."""
        for name in POLICIES:
            force_setattr(self, name, _policy(name, getattr(self, name)))
        force_setattr(self, "depth", _depth(self.depth))
        for name in _TIMES:
            force_setattr(self, name, _seconds(name, getattr(self, name)))


def _policy(name: str, value: Any) -> str | None:
    if value is None:
        return None
    policy = value.lower() if isinstance(value, str) else ""
    if policy == _SYSTEM_DEFAULT:
        return None
    if policy not in POLICIES[name]:
        raise ValueError(
            f"qos: {name} must be {', '.join(POLICIES[name])} or {_SYSTEM_DEFAULT}, not {_shown(value)}"
        )
    return policy


def _depth(value: Any) -> int | None:
    """A depth of 0 means the middleware's default, as in ROS 2."""
    if value is None:
        return None
    if not _is_number(value) or value != value // 1 or not 0 <= value <= _LARGEST_DEPTH:
        raise ValueError(
            f"qos: depth must be a whole number of messages, 0 for the default, not {_shown(value)}"
        )
    return int(value) or None


def _seconds(name: str, value: Any) -> float | None:
    """A duration of 0 means no value, as in ROS 2."""
    if value is None or (isinstance(value, str) and value.lower() in _TIMES[name]):
        return None
    if isinstance(value, dict):
        # ROS 1 wrote secs and nsecs, ROS 2 writes sec and nanosec.
        parts = [value.get("secs", value.get("sec")), value.get("nsecs", value.get("nanosec"))]
        given = [each for each in parts if each is not None]
        numbers = given and all(_is_number(each) and each >= 0 for each in given)
        seconds = (parts[0] or 0) + (parts[1] or 0) / 1e9 if numbers else None
    else:
        seconds = value if _is_number(value) and value >= 0 else None
    if seconds is None:
        words = " or ".join(f"'{each}'" for each in _TIMES[name])
        raise ValueError(
            f"qos: {name} must be a time in seconds, an object with sec and nanosec, or {words}, not {_shown(value)}"
        )
    return seconds if 0 < seconds < UNLIMITED_SECONDS else None


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= 2**64


def _shown(value: Any) -> str:
    if isinstance(value, str):
        return f"'{value[:40]}'"
    return str(value)[:40] if _is_number(value) else f"a value of type {type(value).__name__}"
