"""Quality of service as clients write it (SPEC 1.2, ``qos``), brought to the one form that goes to robots."""

from __future__ import annotations

from typing import Any

from msgspec.structs import force_setattr

from relay_protocol import link

WORDS = {
    "history": ("keep_last", "keep_all"),
    "reliability": ("reliable", "best_effort", "best_available"),
    "durability": ("volatile", "transient_local", "best_available"),
}
"""What a policy may be. ``system_default`` is known as well and counts as left out."""

FOREVER = 1e9
"""Seconds; a time this long or longer is no limit. ROS 2 writes its infinite durations as 2**63 - 1 nanoseconds."""

_SYSTEM_DEFAULT = "system_default"
_TIMES = {"deadline": ("infinite", "best_available"), "lifespan": ("infinite",)}
_LARGEST_DEPTH = 2**31 - 1


class QoS(link.QoS, frozen=True, kw_only=True):
    """:class:`relay_protocol.link.requests.QoS` that takes all the ways clients write its values in.

    :raises ValueError: a value that is none of those known; msgspec adds where it was
    """

    history: Any = None
    depth: Any = None
    reliability: Any = None
    durability: Any = None
    deadline: Any = None
    lifespan: Any = None

    def __post_init__(self) -> None:
        """One form for each value."""
        for name in WORDS:
            force_setattr(self, name, _word(name, getattr(self, name)))
        force_setattr(self, "depth", _depth(self.depth))
        for name in _TIMES:
            force_setattr(self, name, _seconds(name, getattr(self, name)))


def _word(name: str, value: Any) -> str | None:
    if value is None:
        return None
    word = value.lower() if isinstance(value, str) else ""
    if word == _SYSTEM_DEFAULT:
        return None
    if word not in WORDS[name]:
        raise ValueError(f"qos: {name} is {', '.join(WORDS[name])} or {_SYSTEM_DEFAULT}, not {_shown(value)}")
    return word


def _depth(value: Any) -> int | None:
    """A depth of 0 is the middleware's own, as in ROS 2."""
    if value is None:
        return None
    if not _is_number(value) or value != value // 1 or not 0 <= value <= _LARGEST_DEPTH:
        raise ValueError(f"qos: depth is a whole number of messages, 0 for the usual, not {_shown(value)}")
    return int(value) or None


def _seconds(name: str, value: Any) -> float | None:
    """A time of 0 is no time given, as in ROS 2."""
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
            f"qos: {name} is a time in seconds, an object with sec and nanosec, or {words}, not {_shown(value)}"
        )
    return seconds if 0 < seconds < FOREVER else None


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= 2**64


def _shown(value: Any) -> str:
    if isinstance(value, str):
        return f"'{value[:40]}'"
    return str(value)[:40] if _is_number(value) else f"a value of type {type(value).__name__}"
