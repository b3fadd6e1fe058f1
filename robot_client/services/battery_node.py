"""The service ``battery`` in the graph."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import BatteryState

from relay_protocol.errors import Unavailable
from robot_client.services import battery
from robot_client.services.battery import ChargeState, Gauge
from robot_client.services.health import InputWatch, Level, ServiceFinding

SILENT = 10.0
"""Seconds without a message after which it says so."""


class SysfsBattery:
    """Publishes what Linux tells of the machine's battery.

    :param folder: of the power supplies, or of one
    :param gauge: judges it
    :param period: seconds between two readings
    :raises Unavailable: there is no battery
    """

    def __init__(self, node: Any, folder: Path, gauge: Gauge, period: float) -> None:
        self._node = node
        self._root = folder
        self._folder = battery.supply(folder)
        self._gauge = gauge
        self._state = ChargeState()
        self._trouble = ""
        self._publisher = node.create_publisher(BatteryState, "battery_state", 10)
        node.create_timer(period, self._read)
        self._read()

    def finding(self) -> ServiceFinding:
        """How full it is."""
        if self._trouble:
            return ServiceFinding(Level.ERROR, self._trouble)
        return self._gauge.finding(self._state)

    def close(self) -> None:
        """Nothing is left to do."""

    def _read(self) -> None:
        try:
            # Looked for each time: a battery that is changed comes back in a folder of another name.
            self._folder = battery.supply(self._root)
        except Unavailable as error:
            self._trouble = str(error)
            return
        self._trouble = ""
        self._state = battery.of_facts(battery.read(self._folder))
        message = _message(self._state._replace(share=self._gauge.share(self._state)))
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.location = self._folder.name
        self._publisher.publish(message)


class TopicBattery:
    """Says of a battery that another node publishes when it is low.

    :param topic: of type sensor_msgs/BatteryState
    :param gauge: judges it
    """

    def __init__(self, node: Any, topic: str, gauge: Gauge) -> None:
        self._gauge = gauge
        self._state = ChargeState()
        self._fresh = InputWatch(topic, SILENT, time.monotonic)
        node.create_subscription(BatteryState, topic, self._came, qos_profile_sensor_data)

    def finding(self) -> ServiceFinding:
        """How full it is."""
        return self._fresh.trouble() or self._gauge.finding(self._state)

    def close(self) -> None:
        """Nothing is left to do."""

    def _came(self, message: BatteryState) -> None:
        self._fresh.came()
        self._state = _state(message)


def _state(message: BatteryState) -> ChargeState:
    health = message.power_supply_health
    return ChargeState(
        volts=message.voltage,
        amperes=message.current,
        celsius=message.temperature,
        charge=message.charge,
        capacity=message.capacity,
        design=message.design_capacity,
        share=message.percentage,
        status=message.power_supply_status,
        health=health if health in battery.HEALTH.values() else 0,
        # Many bases leave out that there is one.
        present=message.present or message.voltage > 0,
    )


def _message(state: ChargeState) -> BatteryState:
    message = BatteryState()
    message.voltage = state.volts
    message.current = state.amperes
    message.temperature = state.celsius
    message.charge = state.charge
    message.capacity = state.capacity
    message.design_capacity = state.design
    message.percentage = state.share
    message.power_supply_status = state.status
    message.power_supply_health = state.health
    message.power_supply_technology = state.technology
    message.present = state.present
    message.serial_number = state.serial
    return message
