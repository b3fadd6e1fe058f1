"""Moments, spans of time and sizes for people."""

from __future__ import annotations

import math
import re
from datetime import datetime, timezone

from relay_protocol.errors import Invalid

_DURATION = re.compile(r"([0-9]{1,9})([smhdw])\Z")
_UNITS = {"s": 1, "m": 60, "h": 3600, "d": 86400, "w": 7 * 86400}
_LONGEST = 10 * 365 * 86400


def moment(at: float | None) -> str:
    """Unix seconds as UTC, to the second; a dash for none."""
    if at is None:
        return "–"
    return datetime.fromtimestamp(at, timezone.utc).strftime("%Y-%m-%d %H:%M:%SZ")


def duration(seconds: float) -> str:
    """A span of time, in its two largest units."""
    left, parts = int(seconds), []
    for unit in reversed(_UNITS):
        count, left = divmod(left, _UNITS[unit])
        if count:
            parts.append(f"{count} {unit}")
    return " ".join(parts[:2]) or "0 s"


def file_size(size: int) -> str:
    """Bytes in the units disks are sold in, never less than there are."""
    for unit, name in ((10**9, "GB"), (10**6, "MB")):
        if size >= unit:
            return f"{math.ceil(size * 10 / unit) / 10:g} {name}"
    return f"{math.ceil(size / 1000)} kB"


def parse_duration(text: str) -> int:
    """Seconds of ``90s``, ``15m``, ``1h``, ``7d`` or ``2w``.

    :raises Invalid: anything else, nothing at all, or over ten years
    """
    found = _DURATION.match(text)
    seconds = int(found[1]) * _UNITS[found[2]] if found else 0
    if not 0 < seconds <= _LONGEST:
        raise Invalid(f"'{text}' is no time span; write 90s, 15m, 1h, 7d or 2w (at most ten years)")
    return seconds
