"""What the robot's own diagnostics say is wrong, told as alerts."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from rclpy.serialization import deserialize_message

from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import LABEL
from robot_client.alerts import OnAlert
from robot_client.platforms.base import GraphView, OnSample
from robot_client.platforms.ros2.types import Types

TOPIC = "/diagnostics"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
KIND = "diagnostics"

NAMES = 256
"""Most names whose state is followed; further ones are passed over."""

RATE = 20.0
BURST = 40.0
"""Messages looked at: a second in the long run, and at once. Reading one takes some time."""

TEXT = 400

SILENT = 5.0
PERIODS = 5.0
"""A name is silent that reports nothing for so many seconds, and for so many of its usual periods."""

GAPS = 8
KNOWN = 3
"""Gaps between reports that are remembered, and from how many on the usual period is known."""

ONE = 0.5
"""Seconds within which all reports of a name are one: what is said when something changes tells nothing of a period."""

LATE = 2.0
"""Seconds after a look; if the next one comes later, what was published meanwhile may still wait to be read."""

_OK, _ERROR, _STALE = 0, 2, 3
"""Of diagnostic_msgs/DiagnosticStatus."""


@dataclass
class _Part:
    """What is known of one name; times in seconds of the monotonic clock.

    :param heard: when it reported last
    :param counted: when it did so last after a gap
    :param level: as it was last, ``None`` before it reported
    :param text: its words then
    :param there: whether it was ever anything but STALE
    :param told: whether something is told of it that is not over
    :param silent: whether it reports nothing any more
    """

    heard: float
    counted: float
    level: int | None = None
    text: str = ""
    there: bool = False
    told: bool = False
    silent: bool = False
    gaps: deque[float] = field(default_factory=lambda: deque(maxlen=GAPS))

    def reports(self, now: float, level: int, text: str) -> int | None:
        """Take a report; the level to compare it with: the one before, after a silence the one that is usual."""
        before = self.level
        if self.silent:
            before = _OK if self.there else None
        if now - self.counted >= ONE:
            self.gaps.append(now - self.counted)
            self.counted = now
        self.heard, self.level, self.text, self.silent = now, level, text, False
        self.there = self.there or level != _STALE
        return before

    @property
    def patience(self) -> float | None:
        """Seconds after which it is silent; ``None`` while its usual period, the longest of late, is not known."""
        return max(SILENT, PERIODS * max(self.gaps)) if len(self.gaps) >= KNOWN else None


class Diagnostics:
    """Follows ``/diagnostics``: ERROR of a name is an alert, and STALE of one that was there; OK and WARN end it.

    A name that reported regularly and has ceased is STALE, too, until it reports again: most likely its node has
    crashed. Whether it was ended in an orderly way nobody can tell, for a Python node that dies by an exception leaves
    the graph like one that is ended; so it is a warning, and an error only where it was one before. Of a name that was
    heard too seldom to have a usual period nothing is told, nor when its publisher leaves: a sample does not say whose
    it is.

    :param listen: subscribes to a topic of type :data:`DIAGNOSTICS`
    :param tell: is told of what begins and what is over
    :param seconds: a monotonic clock
    """

    def __init__(
        self,
        types: Types,
        listen: Callable[[str, OnSample], object],
        tell: OnAlert,
        seconds: Callable[[], float],
    ) -> None:
        self._types = types
        self._listen = listen
        self._tell = tell
        self._seconds = seconds
        self._listening = False
        self._parts: dict[str, _Part] = {}
        self._tokens, self._filled = BURST, seconds()
        self._missed = self._looked = seconds()
        """When a message was last passed over, and when silence was last looked for."""
        self._late = False

    def look(self, view: GraphView) -> None:
        """Listen to them as soon as there are any, and see who is silent; to be called again and again."""
        self._look_for_silence()
        topic = view.topics.get(TOPIC)
        if self._listening or topic is None or not topic.publishers or DIAGNOSTICS not in topic.types:
            return
        with suppress(SwitchboardError):  # no such type here; nothing can be read then
            self._listen(TOPIC, self._heard)
        self._listening = True

    def _heard(self, body: bytes) -> None:
        if not self._has_time():
            return
        try:
            found: Any = deserialize_message(body, self._types.message(DIAGNOSTICS))
        except Exception:  # any node may publish anything there; rclpy's errors differ between releases
            return
        for status in found.status:
            self.status(str(status.name)[:LABEL], _number(status.level), str(status.message)[:TEXT])

    def status(self, name: str, level: int, text: str) -> None:
        """One part of the robot tells how it is."""
        now = self._seconds()
        part = self._parts.get(name)
        if part is None:
            if len(self._parts) >= NAMES:
                return
            part = self._parts[name] = _Part(now, now)
        before = part.reports(now, level, text)
        if level == _ERROR and before != _ERROR:
            part.told = True
            self._tell("error", text or f"{name} reports an error", KIND, name)
        elif level == _STALE and before not in (None, _STALE):
            part.told = True
            self._tell("warning", text or f"{name} reports nothing any more", KIND, name)
        elif part.told and (level < _ERROR or before is None):
            part.told = False
            self._tell("info", text or f"{name} is well again", KIND, name, True)

    def _look_for_silence(self) -> None:
        now = self._seconds()
        late, self._looked = now - self._looked > LATE, now
        # The daemon itself may have stood still: what came meanwhile is read before anybody is called silent.
        self._late = late and not self._late
        if self._late:
            return
        for name, part in self._parts.items():
            patience = part.patience
            # What was passed over may have been anybody's.
            since = max(part.heard, self._missed)
            if not part.silent and patience is not None and now - since > patience:
                part.silent = part.told = True
                self._tell(*_silence(name, part), KIND, name)

    def _has_time(self) -> bool:
        now = self._seconds()
        self._tokens = min(BURST, self._tokens + (now - self._filled) * RATE)
        self._filled = now
        if self._tokens < 1:
            self._missed = now
            return False
        self._tokens -= 1
        return True


def _silence(name: str, part: _Part) -> tuple[str, str]:
    """Level and words for one that is silent. What was wrong may still be, so that is not called milder."""
    words = f"{name} reports nothing any more"
    if part.level != _ERROR:
        return "warning", words
    return "error", f"{words}; it was in ERROR: {part.text}"[:TEXT]


def _number(level: Any) -> int:
    """The level, which rclpy has as a byte."""
    return level[0] if isinstance(level, bytes) and level else int(level or 0)
