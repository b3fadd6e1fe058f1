"""ROS nodes of the service ``battery``."""

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

SILENT_SECONDS = 10.0
"""Seconds without a message after which the input counts as silent."""


class SysfsBattery:
    """Publishes the battery of this machine as reported by Linux.

    :param folder: of the power supplies, or of one
    :param gauge: its limits
    :param period: seconds between two readings
    :raises Unavailable: there is no battery
    """

    def __init__(self, node: Any, folder: Path, gauge: Gauge, period: float) -> None:
        self._node = node
        self._root = folder
        self._folder = battery.supply(folder)
        self._gauge = gauge
        self._state = ChargeState()
        self._problem = ""
        self._publisher = node.create_publisher(BatteryState, "battery_state", 10)
        node.create_timer(period, self._read)
        self._read()

    def finding(self) -> ServiceFinding:
        """State of the battery."""
        if self._problem:
            return ServiceFinding(Level.ERROR, self._problem)
        return self._gauge.finding(self._state)

    def close(self) -> None:
        """Nothing to close."""

    def _read(self) -> None:
        try:
            # Searched each time: a replaced battery has another folder.
            self._folder = battery.supply(self._root)
        except Unavailable as error:
            self._problem = str(error)
            return
        self._problem = ""
        self._state = battery.parse_facts(battery.read(self._folder))
        message = _message(self._state._replace(share=self._gauge.share(self._state)))
        message.header.stamp = self._node.get_clock().now().to_msg()
        message.location = self._folder.name
        self._publisher.publish(message)


class TopicBattery:
    """Reports when a battery that another node publishes is low.

    :param topic: of type sensor_msgs/BatteryState
    :param gauge: its limits
    """

    def __init__(self, node: Any, topic: str, gauge: Gauge) -> None:
        self._gauge = gauge
        self._state = ChargeState()
        self._input = InputWatch(topic, SILENT_SECONDS, time.monotonic)
        node.create_subscription(BatteryState, topic, self._on_message, qos_profile_sensor_data)

    def finding(self) -> ServiceFinding:
        """State of the battery."""
        return self._input.problem() or self._gauge.finding(self._state)

    def close(self) -> None:
        """Nothing to close."""

    def _on_message(self, message: BatteryState) -> None:
        self._input.received()
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
        # Many bases do not set the field.
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
