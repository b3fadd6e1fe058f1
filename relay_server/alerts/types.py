"""The vocabulary of alerts (SPEC section 1.10): kinds, levels, channels, limits. Imports nothing of ours."""

from __future__ import annotations

import enum
import re

OFFLINE = "offline"
BATTERY = "battery"
DIAGNOSTICS = "diagnostics"
STOP = "stop"
MODULE = "module"
CONTROL = "control"
STALE = "stale"
ROBOT = "robot"
FLOOD = "flood"
AUDIT = "audit"
KEY = "key"

KINDS = (OFFLINE, BATTERY, DIAGNOSTICS, STOP, MODULE, CONTROL, STALE, ROBOT, FLOOD, AUDIT, KEY)

OURS = frozenset({OFFLINE, BATTERY, STOP, CONTROL, STALE, FLOOD, AUDIT, KEY})
"""What only the relay tells: a robot's word of such a kind is one of kind :data:`ROBOT`."""

SINGLE = frozenset({OFFLINE, BATTERY, STOP, CONTROL, AUDIT, KEY})
"""What a robot can have one of at most: no flood of others hides it."""

RESERVED = frozenset({MODULE})
RESERVE = 16
"""What a flood of others does not hide either, of so many parts: that a process has died, by which the robot is
guarded, seen or reached."""

LEVELS = ("info", "warning", "error")
"""From the least to the worst."""

CHANNELS = ("portal", "webhook", "apprise")

OPEN = 300
"""Most alerts of one robot that last at a time."""

BURST = OPEN
RATE = 1.0
"""New alerts of one robot: so many at once, and so many a second in the long run."""

REJOIN_SECONDS = 300.0
"""What comes back within this time is the alert that was there before."""

NEWS_SECONDS = 60.0
"""What comes and goes is news no more often than this."""

SHOWN_SECONDS = 600.0
SHOWN = 100
"""What is over is told to pages for so long, and so many alerts at most."""

SHOWN_OVER = 25
"""So many of these are what was over last, however much lasts."""

ENDLESS_SECONDS = 86400.0
"""What nobody tells the end of is over so long after it was told last."""

FLOOD_SECONDS = 60.0
"""A flood is over when so long nothing came that found no room."""

TEXT = 500
"""Longest text of an alert, in characters."""

KEPT_SECONDS = 90 * 86400.0
"""What is over is kept in the table for so long."""

_KIND = re.compile(r"[a-z][a-z0-9_-]{0,31}\Z")


class AlertEvent(str, enum.Enum):
    """What has become of an alert, where that is worth telling."""

    BEGUN = "begun"
    WORSE = "worse"
    OVER = "over"


def endless(kind: str) -> bool:
    """Whether alerts of this kind may have no end of their own: to acknowledge one ends it."""
    return kind in (CONTROL, ROBOT, AUDIT, KEY) or kind not in KINDS


def from_robot(kind: str, about: str) -> tuple[str, str]:
    """Under what kind and part a robot's own alert is filed."""
    if kind in OURS or not _KIND.match(kind):
        return ROBOT, about or kind
    return kind, about


def severity(level: str) -> int:
    """How bad a level is. A word that is none counts as a warning: nothing a robot tells may get lost by it."""
    return LEVELS.index(level) if level in LEVELS else LEVELS.index("warning")


def known_level(level: str) -> str:
    """A level as it is kept."""
    return LEVELS[severity(level)]
