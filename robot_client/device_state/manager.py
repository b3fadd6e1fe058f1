"""The device manager: measures the device once a cycle, and says which components are critical.

Programs on the robot read that from ``device.json`` in the daemon's state folder, which is replaced as a whole. The
relay gets it as a message, programs of the robot's graph as a topic, and people as alerts.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from relay_protocol import link
from robot_client.alerts import AlertCondition, OnAlert
from robot_client.device_state.readings import DeviceReadings
from robot_client.device_state.rules import DISK, MEMORY, RULES, CriticalComponents
from robot_client.device_state.settings import DeviceSettings
from robot_client.offload.device import STATE_FILE, DeviceState, publish

DEVICE = "device"
"""Kind of alerts about the device."""


class DeviceManager:
    """Measures the device.

    :param folder: the daemon's state folder
    :param send: sends a message to the relay, if the robot is registered
    :param publish: publishes the state in the robot's graph
    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        settings: DeviceSettings,
        readings: DeviceReadings,
        folder: Path,
        *,
        send: Callable[[link.Message], None],
        publish: Callable[[link.DeviceReport], None],
        alert: OnAlert,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self.cycle_seconds = settings.cycle_seconds
        self._readings = readings
        self._rules = CriticalComponents(settings)
        self._where = settings.where
        self._folder = folder
        self._send = send
        self._publish = publish
        self._wall = wall
        self._registered = False
        self._state: link.DeviceReport | None = None
        self._alerts = {each: AlertCondition(alert, DEVICE, each) for each in RULES}
        self._unwritable = AlertCondition(alert, DEVICE, STATE_FILE)

    @property
    def full(self) -> bool:
        """Whether memory or disk is critical."""
        return self._state is not None and any(self._state.critical.get(each) for each in (MEMORY, DISK))

    def registered(self) -> None:
        """The control link is open: report the state."""
        self._registered = True
        if self._state is not None:
            self._send(self._state)

    def link_lost(self) -> None:
        """The control link is lost."""
        self._registered = False

    def measure(self) -> None:
        """Measure, and report; to be called once a cycle."""
        readings = self._readings.read()
        critical = self._rules.measured(readings)
        self._state = link.DeviceReport(at=self._wall(), readings=readings, critical=critical)
        self._write_state(self._state)
        if self._registered:
            self._send(self._state)
        for component, is_critical in critical.items():
            self._update_alert(component, is_critical, readings.get(component))
        self._publish(self._state)

    def _update_alert(self, component: str, is_critical: bool, value: float | None) -> None:
        condition = self._alerts[component]
        if is_critical and condition.text:
            # One alert while it lasts, whatever the value is meanwhile.
            return
        rule, limit = RULES[component], self._rules.limit(component)
        text = ""
        if is_critical and value is not None:
            side = "at or below" if rule.too_low else "at or above"
            unit = f" {rule.unit}" if rule.unit else ""
            text = f"{component} is critical: {value:g}{unit}, {side} {limit:g}{unit}"
        condition.update(text, f"{component} is not critical any more")

    def _write_state(self, state: link.DeviceReport) -> None:
        published = DeviceState(
            at=state.at, critical=state.critical, readings=state.readings, where=self._where
        )
        try:
            publish(self._folder, published)
        except OSError as error:
            self._unwritable.update(
                f"the daemon can't write into its state folder {self._folder}: {error.strerror}", ""
            )
        else:
            self._unwritable.update("", "the daemon can write into its state folder again")
