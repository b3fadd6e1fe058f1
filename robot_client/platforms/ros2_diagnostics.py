"""What the robot's own diagnostics say is wrong, told as alerts."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rclpy.serialization import deserialize_message

from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import LABEL
from robot_client.alerts import OnAlert
from robot_client.platforms.base import GraphView, OnSample
from robot_client.platforms.ros2_types import Types

TOPIC = "/diagnostics"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
KIND = "diagnostics"

NAMES = 256
"""Most names whose state is followed; further ones are passed over."""

RATE = 20.0
BURST = 40.0
"""Messages looked at: a second in the long run, and at once. Reading one takes some time."""

TEXT = 400

_ERROR, _STALE = 2, 3
"""Of diagnostic_msgs/DiagnosticStatus."""


class Diagnostics:
    """Follows ``/diagnostics``: ERROR of a name is an alert, and STALE of one that was there; OK and WARN end it.

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
        self._levels: dict[str, int] = {}
        """As each name was last."""
        self._told: set[str] = set()
        """Names of which something is told that is not over."""
        self._tokens, self._filled = BURST, seconds()

    def look(self, view: GraphView) -> None:
        """Listen to them as soon as there are any."""
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
        before = self._levels.get(name)
        if before is None and len(self._levels) >= NAMES:
            return
        self._levels[name] = level
        if level == _ERROR and before != _ERROR:
            self._told.add(name)
            self._tell("error", text or f"{name} reports an error", KIND, name)
        elif level == _STALE and before not in (None, _STALE):
            self._told.add(name)
            self._tell("warning", text or f"{name} reports nothing any more", KIND, name)
        elif level < _ERROR and name in self._told:
            self._told.remove(name)
            self._tell("info", text or f"{name} is well again", KIND, name, True)

    def _has_time(self) -> bool:
        now = self._seconds()
        self._tokens = min(BURST, self._tokens + (now - self._filled) * RATE)
        self._filled = now
        if self._tokens < 1:
            return False
        self._tokens -= 1
        return True


def _number(level: Any) -> int:
    """The level, which rclpy has as a byte."""
    return level[0] if isinstance(level, bytes) and level else int(level or 0)
