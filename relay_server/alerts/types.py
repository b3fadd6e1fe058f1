"""The vocabulary of alerts (SPEC 1.10): kinds, levels, channels, limits. Imports nothing of ours."""

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
DEVICE = "device"
FILES = "files"

KINDS = (OFFLINE, BATTERY, DIAGNOSTICS, STOP, MODULE, CONTROL, STALE, ROBOT, FLOOD, AUDIT, KEY, DEVICE, FILES)

RELAY_KINDS = frozenset({OFFLINE, BATTERY, STOP, CONTROL, STALE, FLOOD, AUDIT, KEY})
"""Kinds that only the relay raises: an alert that a robot reports with such a kind is stored as :data:`ROBOT`."""

SINGLE = frozenset({OFFLINE, BATTERY, STOP, CONTROL, AUDIT, KEY})
"""Kinds of which a robot has one alert at most; the limit of open alerts does not apply to them."""

RESERVED = frozenset({MODULE})
RESERVE = 16
"""The limit does not apply to this many alerts of these kinds either: the death of a process that guards the robot,
shows it or connects it must not be lost among others."""

LEVELS = ("info", "warning", "error")
"""From the mildest to the worst."""

CHANNELS = ("portal", "webhook", "apprise")

MAX_OPEN = 300
"""Open alerts of one robot."""

BURST = MAX_OPEN
RATE = 1.0
"""New alerts of one robot: at once, and per second in the long run."""

REJOIN_SECONDS = 300.0
"""An alert that comes back within this time after its end is the same alert."""

NEWS_SECONDS = 60.0
"""Shortest time between two notifications of an alert that comes and goes."""

SHOWN_SECONDS = 600.0
MAX_SHOWN = 100
"""How long pages show an ended alert, and how many alerts they show."""

MAX_SHOWN_OVER = 25
"""Ended alerts among these for which there is always room."""

ENDLESS_SECONDS = 86400.0
"""An alert without an end of its own ends so long after its last report."""

FLOOD_SECONDS = 60.0
"""A flood ends when no alert was over the limit for so long."""

MAX_TEXT = 500
"""Longest text of an alert, in characters."""

RETENTION_SECONDS = 90 * 86400.0
"""How long ended alerts stay in the database."""

_KIND = re.compile(r"[a-z][a-z0-9_-]{0,31}\Z")


class AlertEvent(str, enum.Enum):
    """A change of an alert that users are notified of."""

    BEGUN = "begun"
    WORSE = "worse"
    OVER = "over"


def endless(kind: str) -> bool:
    """Whether alerts of this kind may have no end of their own; then acknowledging one ends it."""
    return kind in (CONTROL, ROBOT, AUDIT, KEY) or kind not in KINDS


def from_robot(kind: str, about: str) -> tuple[str, str]:
    """The kind and part (``about``) under which a robot's own alert is stored."""
    if kind in RELAY_KINDS or not _KIND.match(kind):
        return ROBOT, about or kind
    return kind, about


def severity(level: str) -> int:
    """A level as a number, 0 is the mildest. An unknown level counts as a warning, so that no alert gets lost."""
    return LEVELS.index(level) if level in LEVELS else LEVELS.index("warning")


def known_level(level: str) -> str:
    """The level, or ``warning`` if it is unknown."""
    return LEVELS[severity(level)]
