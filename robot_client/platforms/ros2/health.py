"""Health of the robot from its own topics: charge of the battery, and alerts from ``/diagnostics``."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from rclpy.serialization import deserialize_message

from relay_protocol.errors import SwitchboardError
from relay_protocol.limits import LABEL_LENGTH
from robot_client.alerts import MODULE, OnAlert
from robot_client.platforms.base import GraphView, OnSample
from robot_client.platforms.ros2.types import Types

BATTERY = "sensor_msgs/msg/BatteryState"
BATTERY_PART = "battery topic"
"""The part in alerts about the charge. No module has such a name."""

TOPIC = "/diagnostics"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
KIND = "diagnostics"

MAX_NAMES = 256
"""Most status names that are tracked; further ones are ignored."""

RATE = 20.0
BURST = 40.0
"""Messages that are read: per second on average, and at once. Reading one takes time."""

MAX_TEXT = 400
"""Characters of an alert."""

SILENT_SECONDS = 5.0
SILENT_PERIODS = 5.0
"""A name is silent if it has not reported for so many seconds, and for so many of its usual periods."""

MAX_GAPS = 8
MIN_GAPS = 3
"""Gaps between reports that are remembered, and that are needed to know the usual period."""

SAME_REPORT = 0.5
"""Seconds within which reports of a name count as one: an extra report after a change says nothing about
the period."""

LATE = 2.0
"""If a check comes more seconds after the one before, messages published meanwhile may still be unread."""

_OK, _ERROR, _STALE = 0, 2, 3
"""Of diagnostic_msgs/DiagnosticStatus."""


class BatteryReader:
    """Reads the first battery topic of the graph.

    :param subscribe: subscribes to a topic of type :data:`BATTERY`
    :param alert: receives an alert while the charge is out of range
    """

    def __init__(self, types: Types, subscribe: Callable[[str, OnSample], object], alert: OnAlert) -> None:
        self._types = types
        self._subscribe = subscribe
        self._alert = alert
        self._subscribed = False
        self._topic = ""
        self._out_of_range = False
        self._sample: bytes | None = None

    def update(self, view: GraphView) -> None:
        """Subscribe as soon as there is a topic; to be called periodically."""
        if self._subscribed:
            return
        names = (
            name for name, each in sorted(view.topics.items()) if BATTERY in each.types and "/_" not in name
        )
        topic = next(names, None)
        if topic is None or not view.topics[topic].publishers:
            return
        with suppress(SwitchboardError):  # the type is not installed
            self._subscribe(topic, self._on_message)
        self._topic, self._subscribed = topic, True

    def subscribe_again(self) -> None:
        """Forget the subscription, which the platform has closed."""
        self._subscribed = False

    def charge(self) -> float | None:
        """Charge, 0 to 1; ``None`` if unknown."""
        if self._sample is None:
            return None
        try:
            state: Any = deserialize_message(self._sample, self._types.message(BATTERY))
        except Exception:  # any node may publish anything there; rclpy's errors differ between releases
            self._sample = None
            return None
        charge = float(state.percentage)
        known = 0.0 <= charge <= 1.0
        # NaN is not measured (sensor_msgs/BatteryState), so it is neither in range nor out of it.
        if not math.isnan(charge):
            self._report_range(charge, out_of_range=not known)
        return charge if known else None

    def _report_range(self, charge: float, out_of_range: bool) -> None:
        """Raise or end the alert; it is not repeated for each further value."""
        if out_of_range == self._out_of_range:
            return
        self._out_of_range = out_of_range
        if out_of_range:
            text = (
                f"{self._topic} reports a charge of {charge:g}, which is not from 0 to 1; it counts as unknown. "
                "Publish 'percentage' as a fraction, and NaN when it is not measured"
            )
            self._alert("warning", text, MODULE, BATTERY_PART)
        else:
            text = f"the charge that {self._topic} reports is in range again"
            self._alert("info", text, MODULE, BATTERY_PART, over=True)

    def _on_message(self, body: bytes) -> None:
        self._sample = body


@dataclass
class _Status:
    """State of one name; times in seconds of the monotonic clock.

    :param last_report: time of the last report
    :param last_counted: time of the last report after a gap
    :param level: last level, ``None`` before the first report
    :param text: last text
    :param was_alive: whether it ever had another level than STALE
    :param alerted: whether an alert about it is active
    :param silent: whether it no longer reports
    """

    last_report: float
    last_counted: float
    level: int | None = None
    text: str = ""
    was_alive: bool = False
    alerted: bool = False
    silent: bool = False
    gaps: deque[float] = field(default_factory=lambda: deque(maxlen=MAX_GAPS))

    def report(self, now: float, level: int, text: str) -> int | None:
        """Store a report; returns the level to compare it with: the one before, or after a silence the
        normal one."""
        before = self.level
        if self.silent:
            before = _OK if self.was_alive else None
        if now - self.last_counted >= SAME_REPORT:
            self.gaps.append(now - self.last_counted)
            self.last_counted = now
        self.last_report, self.level, self.text, self.silent = now, level, text, False
        self.was_alive = self.was_alive or level != _STALE
        return before

    @property
    def silence_timeout(self) -> float | None:
        """Seconds after which it is silent; ``None`` while its usual period, the longest recent gap, is
        unknown."""
        return max(SILENT_SECONDS, SILENT_PERIODS * max(self.gaps)) if len(self.gaps) >= MIN_GAPS else None


class Diagnostics:
    """Raises alerts from ``/diagnostics``: for ERROR, and for STALE of a name that was alive; OK and WARN
    end them.

    A name that reported regularly and has stopped counts as STALE until it reports again: most likely its
    node has crashed. A Python node that dies by an exception leaves the graph like one that is ended on
    purpose. So silence is a warning, and an error only if there was one before. There is no alert for a
    name that reported too rarely to have a usual period. The end of a publisher is not used: a sample does
    not name its publisher.

    :param subscribe: subscribes to a topic of type :data:`DIAGNOSTICS`
    :param alert: receives the alerts
    :param seconds: a monotonic clock
    """

    def __init__(
        self,
        types: Types,
        subscribe: Callable[[str, OnSample], object],
        alert: OnAlert,
        seconds: Callable[[], float],
    ) -> None:
        self._types = types
        self._subscribe = subscribe
        self._alert = alert
        self._seconds = seconds
        self._subscribed = False
        self._statuses: dict[str, _Status] = {}
        self._tokens, self._filled = BURST, seconds()
        self._last_skipped = self._last_check = seconds()
        """When a message was last skipped, and when silence was last checked."""
        self._late = False

    def update(self, view: GraphView) -> None:
        """Subscribe as soon as the topic exists, and check for silence; to be called periodically."""
        self._check_silence()
        topic = view.topics.get(TOPIC)
        if self._subscribed or topic is None or not topic.publishers or DIAGNOSTICS not in topic.types:
            return
        with suppress(SwitchboardError):  # the type is not installed, so nothing can be read
            self._subscribe(TOPIC, self._on_message)
        self._subscribed = True

    def subscribe_again(self) -> None:
        """Forget the subscription, which the platform has closed."""
        self._subscribed = False

    def _on_message(self, body: bytes) -> None:
        if not self._may_read():
            return
        try:
            found: Any = deserialize_message(body, self._types.message(DIAGNOSTICS))
        except Exception:  # any node may publish anything there; rclpy's errors differ between releases
            return
        for each in found.status:
            self.on_status(str(each.name)[:LABEL_LENGTH], _number(each.level), str(each.message)[:MAX_TEXT])

    def on_status(self, name: str, level: int, text: str) -> None:
        """Handle the status of one name.

        :param level: of diagnostic_msgs/DiagnosticStatus
        """
        now = self._seconds()
        status = self._statuses.get(name)
        if status is None:
            if len(self._statuses) >= MAX_NAMES:
                return
            status = self._statuses[name] = _Status(now, now)
        before = status.report(now, level, text)
        if level == _ERROR and before != _ERROR:
            status.alerted = True
            self._alert("error", text or f"{name} reports an error", KIND, name)
        elif level == _STALE and before not in (None, _STALE):
            status.alerted = True
            self._alert("warning", text or f"{name} reports nothing any more", KIND, name)
        elif status.alerted and (level < _ERROR or before is None):
            status.alerted = False
            self._alert("info", text or f"{name} works again", KIND, name, True)

    def _check_silence(self) -> None:
        now = self._seconds()
        late, self._last_check = now - self._last_check > LATE, now
        # The daemon itself may have been suspended: messages from that time are read before a name counts as silent.
        self._late = late and not self._late
        if self._late:
            return
        for name, status in self._statuses.items():
            timeout = status.silence_timeout
            # A skipped message may have been of any name.
            since = max(status.last_report, self._last_skipped)
            if not status.silent and timeout is not None and now - since > timeout:
                status.silent = status.alerted = True
                level, text = _silence_alert(name, status)
                self._alert(level, text, KIND, name)

    def _may_read(self) -> bool:
        now = self._seconds()
        self._tokens = min(BURST, self._tokens + (now - self._filled) * RATE)
        self._filled = now
        if self._tokens < 1:
            self._last_skipped = now
            return False
        self._tokens -= 1
        return True


def _silence_alert(name: str, status: _Status) -> tuple[str, str]:
    """Level and text. After an ERROR the level stays, as its cause may still exist."""
    text = f"{name} reports nothing any more"
    if status.level != _ERROR:
        return "warning", text
    return "error", f"{text}; it was in ERROR: {status.text}"[:MAX_TEXT]


def _number(level: Any) -> int:
    """The level as a number; rclpy has it as a byte."""
    return level[0] if isinstance(level, bytes) and level else int(level or 0)
