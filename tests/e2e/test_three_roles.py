"""Three Roles and three platforms: a game pad by MQTT drives a ROS 2 robot, whose state an ICPI program
shows.

The pad's own gauge shows it too, and a service switches its light. This is the proof of concept of FIERRo.
"""

from __future__ import annotations

import itertools
import json
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import paho.mqtt.client as paho
import pytest
from paho.mqtt.enums import CallbackAPIVersion

from tests.worlds.mosquitto import PASSWORD, USER, Mosquitto
from tests.worlds.mqtt_gateway import gateway
from tests.worlds.processes import Process, running
from tests.worlds.relay_process import Relay
from tests.worlds.robot_process import Robot
from tests.worlds.waiting import wait_for

EXAMPLES = Path("docs/examples")
ROLES = {
    "pad-drive-rover.rdf": "Pad-Drive-Rover",
    "rover-report-gauge.rdf": "Rover-Report-Gauge",
    "display-show-rover.rdf": "Display-Show-Rover",
}
PAD = {
    "dev": {"ids": ["pad"], "name": "Pad"},
    "o": {"name": "game pad"},
    "~": "pad",
    "cmps": {
        "stick_x": {"p": "sensor", "stat_t": "~/x", "stat_cla": "measurement"},
        "needle": {"p": "number", "stat_t": "~/needle", "cmd_t": "~/needle/set", "min": -5, "max": 5},
        "light": {"p": "switch", "stat_t": "~/light", "cmd_t": "~/light/set"},
    },
}
PUSHED = 0.3


class Pad:
    """A game pad that sends its stick ten times a second, and confirms values of its gauge and light."""

    def __init__(self, broker: Mosquitto) -> None:
        self.received: dict[str, str] = {}
        self.stick = 0.0
        self._ended = threading.Event()
        self._client = paho.Client(CallbackAPIVersion.VERSION2)
        self._client.username_pw_set(USER, PASSWORD)
        self._client.on_message = self._set
        self._client.connect("127.0.0.1", broker.port)
        self._client.loop_start()
        self._client.subscribe("pad/+/set")
        self._client.publish("homeassistant/device/pad/config", json.dumps(PAD), retain=True)
        self._sending = threading.Thread(target=self._send, daemon=True)
        self._sending.start()

    def _set(self, client: Any, data: Any, message: paho.MQTTMessage) -> None:
        payload = message.payload.decode()
        self.received[message.topic] = payload
        client.publish(message.topic.removesuffix("/set"), payload, retain=True)

    def _send(self) -> None:
        # A stick trembles: all values differ.
        for tremble in itertools.cycle((0.0, 0.001)):
            if self._ended.wait(0.1):
                return
            self._client.publish("pad/x", f"{self.stick + tremble if self.stick else 0.0:g}")

    def stop(self) -> None:
        """Ends it."""
        self._ended.set()
        self._sending.join()
        self._client.loop_stop()
        self._client.disconnect()


class World:
    """A relay; the gateway ``home`` and the ROS 2 robot ``rover``, both of ann; and ann's program ``display``."""

    def __init__(self, folder: Path) -> None:
        self.broker = Mosquitto(folder / "broker")
        self.pad = Pad(self.broker)
        self.relay = Relay(folder)
        self.token = self.relay.user("ann")
        self.gateway = gateway(self.relay, self.broker, folder, "home")
        self.rover = Robot(self.relay, "rover", sim_options=("--world", "room", "--no-depth", "--no-battery"))
        for robot in ("home", "rover"):
            self.relay.cli("right", "grant", "ann", robot, "operator")
        url = f"ws://127.0.0.1:{self.relay.http_port}/icpi"
        command = [sys.executable, str(EXAMPLES / "icpi_display.py"), url, "display"]
        command += ["Display-Show-Rover", "SPEED_NOW"]
        self.display = Process(command, folder, "display", {**os.environ, "SWITCHBOARD_TOKEN": self.token})
        self.ann = httpx.Client(
            base_url=f"http://127.0.0.1:{self.relay.http_port}/api/v1",
            headers={"Authorization": f"Bearer {self.token}"},
            timeout=60,
        )

    def shown(self) -> list[float]:
        """Speeds that the program has shown."""
        lines = [line.split() for line in self.display.said().splitlines()]
        return [float(line[2]) for line in lines if line[:2] == ["SPEED_NOW", "ok"]]

    def run(self, role: str, order: str = "") -> dict[str, Any]:
        """Starts or stops a Role; returns its state."""
        method, path = ("POST", f"/run/{order}") if order else ("GET", "/run")
        answer = self.ann.request(method, f"/roles/{role}{path}")
        assert answer.status_code == 200, answer.text
        return dict(answer.json())

    def comes_up(self, role: str) -> None:
        """Starts a Role until all its parts are up: robots and topics may be discovered later."""

        def up() -> bool:
            state = self.run(role)
            if state["state"] in ("stopped", "partial", "ended"):
                self.run(role, "start")
            return state["state"] == "running"

        try:
            wait_for(f"{role} is up", up)
        except AssertionError as error:
            raise AssertionError(self.run(role)) from error

    def stop(self) -> None:
        self.ann.close()
        for each in (self.display, self.rover, self.gateway, self.relay, self.pad, self.broker):
            each.stop()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    made = World(tmp_path_factory.mktemp("roles"))
    with running(made):
        yield made


def test_a_pad_drives_a_robot_whose_state_is_shown_elsewhere(world: World) -> None:
    wait_for("the program is registered", lambda: "registered ok display" in world.display.said())
    for file, name in ROLES.items():
        assert world.relay.cli("role", "load", str(EXAMPLES / "roles" / file))[0]["name"] == name
    for name in ROLES.values():
        world.comes_up(name)
    assert world.run("Pad-Drive-Rover")["parts"][0]["element"] == "STICK_X → SPEED"
    world.pad.stick = PUSHED
    wait_for("the robot moves", world.rover.moving)
    wait_for("the program shows it", lambda: any(each > PUSHED / 2 for each in world.shown()))
    gauge = world.pad.received
    wait_for("the gauge shows it", lambda: float(gauge.get("pad/needle/set", 0)) > PUSHED / 2)
    wait_for("the light is on", lambda: gauge.get("pad/light/set") == "ON")
    stopped = world.run("Pad-Drive-Rover", "stop")
    assert stopped["state"] == "stopped"
    wait_for("the robot stands still", lambda: not world.rover.moving())
    wait_for("the program shows that", lambda: abs(world.shown()[-1]) < 0.01)
    pipes = {each["name"]: each for each in world.ann.get("/pipes").json()["pipes"]}
    assert sorted(each["moves"] for each in pipes.values()) == [False, False]
    assert all(each["latency_ms"] > 0 for each in pipes.values())
    for name in ROLES.values():
        assert world.run(name, "stop")["state"] == "stopped"
