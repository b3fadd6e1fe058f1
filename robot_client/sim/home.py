"""A simulated home: lamp, blind and door contact by Home Assistant discovery, a thermostat by Homie 4.

``python -m robot_client.sim.home --broker 127.0.0.1:1883``
"""

from __future__ import annotations

import json
import os
import signal
import threading
from typing import Any

import click
import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion

from relay_protocol.command_output import OutputCommand
from robot_client.platforms.mqtt.settings import PASSWORD_VARIABLE, MqttSettings

TICK = 0.1
"""Seconds between two steps of what moves and warms."""

BLIND_SPEED = 20.0
"""Percent a second."""

DOOR_SECONDS = 30.0
"""Seconds between two changes of the door."""

THERE = "home/there"
_AVAILABLE = {"avty_t": THERE}

CONFIGS: dict[str, dict[str, Any]] = {
    "homeassistant/device/lamp/config": {
        "dev": {"ids": ["sim-lamp"], "name": "Lamp"},
        "o": {"name": "Simulated home"},
        "~": "home/lamp",
        **_AVAILABLE,
        "cmps": {
            "light": {
                "p": "light",
                "stat_t": "~/state",
                "cmd_t": "~/set",
                "bri_stat_t": "~/brightness",
                "bri_cmd_t": "~/brightness/set",
                "bri_scl": 100,
            },
            "power": {"p": "sensor", "stat_t": "~/power", "unit_of_meas": "W", "stat_cla": "measurement"},
        },
    },
    "homeassistant/cover/blind/config": {
        "dev": {"ids": ["sim-blind"], "name": "Blind"},
        "~": "home/blind",
        **_AVAILABLE,
        "stat_t": "~/state",
        "cmd_t": "~/set",
        "pos_t": "~/position",
        "set_pos_t": "~/position/set",
    },
    "homeassistant/binary_sensor/door/contact/config": {
        "dev": {"ids": ["sim-door"], "name": "Door"},
        "dev_cla": "door",
        **_AVAILABLE,
        "stat_t": "home/door",
        "val_tpl": "{{ 'OFF' if value_json.contact else 'ON' }}",
    },
    "homeassistant/sensor/door/battery/config": {
        "dev": {"ids": ["sim-door"], "name": "Door"},
        **_AVAILABLE,
        "stat_t": "home/door",
        "unit_of_meas": "%",
        "val_tpl": "{{ value_json.battery }}",
    },
}

THERMOSTAT = {
    "$homie": "4.0.0",
    "$name": "Thermostat",
    "$nodes": "heating",
    "heating/$name": "Heating",
    "heating/$properties": "target,measured,mode",
    "heating/target/$datatype": "float",
    "heating/target/$format": "5:30",
    "heating/target/$settable": "true",
    "heating/measured/$datatype": "float",
    "heating/mode/$datatype": "enum",
    "heating/mode/$format": "off,eco,comfort",
    "heating/mode/$settable": "true",
    "$state": "ready",
}


class SimulatedHome:
    """The devices' states, and what commands do to them."""

    def __init__(self, client: paho.Client) -> None:
        self._client = client
        self._lock = threading.Lock()
        self._lamp, self._brightness = False, 100.0
        self._blind, self._blind_target = 0.0, 0.0
        self._target, self._measured, self._mode = 20.0, 18.0, "comfort"
        self._closed, self._door_seconds = True, 0.0

    def announce(self) -> None:
        """Subscribe to commands, then publish what there is, and all states."""
        self._client.subscribe(
            [
                ("home/+/set", 1),
                ("home/+/+/set", 1),
                ("homie/thermostat/heating/+/set", 1),
                ("homeassistant/status", 0),
            ]
        )
        for topic, config in CONFIGS.items():
            self._publish(topic, json.dumps(config))
        for attribute, value in THERMOSTAT.items():
            self._publish(f"homie/thermostat/{attribute}", value)
        self._publish(THERE, "online")
        self.publish_states()

    def publish_states(self) -> None:
        """Publish all states."""
        self._publish("home/lamp/state", "ON" if self._lamp else "OFF")
        self._publish("home/lamp/brightness", f"{self._brightness:g}")
        self._publish("home/lamp/power", f"{self._brightness * 0.09 if self._lamp else 0.2:.1f}")
        self._publish_blind()
        self._publish("home/door", json.dumps({"contact": self._closed, "battery": 87}))
        self._publish("homie/thermostat/heating/target", f"{self._target:g}")
        self._publish("homie/thermostat/heating/mode", self._mode)
        self._publish("homie/thermostat/heating/measured", f"{self._measured:.2f}")

    def command(self, topic: str, payload: str) -> None:
        """Take a command; one that is no number where one is needed is ignored."""
        with self._lock:
            try:
                self._take(topic, payload)
            except ValueError:
                return
            self.publish_states()

    def _take(self, topic: str, payload: str) -> None:
        if topic == "home/lamp/set":
            self._lamp = payload == "ON"
        elif topic == "home/lamp/brightness/set":
            self._brightness = min(100.0, max(0.0, float(payload)))
            self._lamp = self._brightness > 0
        elif topic == "home/blind/set":
            self._blind_target = {"OPEN": 100.0, "CLOSE": 0.0}.get(payload, self._blind)
        elif topic == "home/blind/position/set":
            self._blind_target = min(100.0, max(0.0, float(payload)))
        elif topic.endswith("/target/set"):
            self._target = min(30.0, max(5.0, float(payload)))
        elif topic.endswith("/mode/set") and payload in ("off", "eco", "comfort"):
            self._mode = payload

    def step(self) -> None:
        """Let :data:`TICK` seconds pass."""
        with self._lock:
            if self._blind != self._blind_target:
                way = self._blind_target - self._blind
                self._blind += max(-BLIND_SPEED * TICK, min(BLIND_SPEED * TICK, way))
                self._publish_blind()
            wanted = {"off": 5.0, "eco": self._target - 3}.get(self._mode, self._target)
            before = round(self._measured, 1)
            self._measured += (wanted - self._measured) * TICK / 60
            if round(self._measured, 1) != before:
                self._publish("homie/thermostat/heating/measured", f"{self._measured:.2f}")
            self._door_seconds += TICK
            if self._door_seconds >= DOOR_SECONDS:
                self._door_seconds, self._closed = 0.0, not self._closed
                self._publish("home/door", json.dumps({"contact": self._closed, "battery": 87}))

    def _publish_blind(self) -> None:
        moving = "opening" if self._blind_target > self._blind else "closing"
        still = "open" if self._blind > 0 else "closed"
        self._publish("home/blind/state", moving if self._blind != self._blind_target else still)
        self._publish("home/blind/position", f"{self._blind:g}")

    def _publish(self, topic: str, payload: str) -> None:
        self._client.publish(topic, payload, qos=1, retain=True)


def connect(settings: MqttSettings, password: str | None, ready: threading.Event) -> SimulatedHome:
    """A home whose client's thread runs.

    :param ready: set when the devices are announced
    """
    client = paho.Client(CallbackAPIVersion.VERSION2)
    if settings.user:
        client.username_pw_set(settings.user, password)
    home = SimulatedHome(client)

    def connected(_client: Any, _data: Any, _flags: Any, code: Any, _properties: Any) -> None:
        if not code.is_failure:
            home.announce()
            ready.set()

    def received(_client: Any, _data: Any, message: Any) -> None:
        if message.topic == "homeassistant/status":
            home.publish_states()
        else:
            home.command(message.topic, message.payload.decode("utf-8", "replace"))

    client.on_connect = connected
    client.on_message = received
    client.will_set(THERE, "offline", qos=1, retain=True)
    client.connect_async(settings.host, settings.port)
    client.loop_start()
    return home


@click.command(cls=OutputCommand)
@click.option("--broker", default="127.0.0.1:1883", show_default=True, metavar="HOST:PORT")
@click.option("--user", default="", help=f"Name at the broker; the password is in {PASSWORD_VARIABLE}.")
def main(broker: str, user: str) -> None:
    """Simulate a home with a lamp, a blind, a door contact and a thermostat on an MQTT broker."""
    ready, ended = threading.Event(), threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: ended.set())
    home = connect(MqttSettings(broker=broker, user=user), os.environ.get(PASSWORD_VARIABLE), ready)
    while not ready.wait(TICK) and not ended.is_set():
        pass
    click.echo("READY")
    while not ended.wait(TICK):
        home.step()


if __name__ == "__main__":
    main()
