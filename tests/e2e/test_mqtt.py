"""A simulated home on a real Mosquitto, behind the gateway and a real relay."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import paho.mqtt.publish
import paho.mqtt.subscribe
import pytest

from robot_client.platforms.mqtt.settings import PASSWORD_VARIABLE
from tests.worlds.file_modes import open_to_others
from tests.worlds.mosquitto import PASSWORD, USER, Mosquitto
from tests.worlds.mqtt_gateway import gateway
from tests.worlds.processes import BIN, Process
from tests.worlds.relay_process import Relay
from tests.worlds.small_robot import SmallRobot
from tests.worlds.sync_client import Client
from tests.worlds.waiting import wait_for

HOME = "home"


class MqttHome:
    """Relay, broker, simulated home and gateway."""

    def __init__(self, folder: Path) -> None:
        self.broker = Mosquitto(folder / "broker")
        self.relay = Relay(folder)
        environment = {**os.environ, PASSWORD_VARIABLE: PASSWORD}
        devices = [
            sys.executable,
            "-m",
            "robot_client.sim.home",
            "--broker",
            self.broker.address,
            "--user",
            USER,
        ]
        self.devices = Process(devices, folder, "devices", environment)
        self.state = folder / "gateway"
        self.gateway = gateway(self.relay, self.broker, folder, HOME)
        self.operator, self.stranger = self.relay.user("operator"), self.relay.user("stranger")
        self.relay.cli("right", "grant", "operator", HOME, "operator", "--deny", "*:/door/*")
        self.wait_topics({"/lamp/light", "/thermostat/heating/target", "/blind/blind/position"})

    @contextmanager
    def connected(self) -> Iterator[Client]:
        with self.relay.connect(HOME, self.operator) as client:
            client.send(op="set_level", level="error")
            yield client

    def wait_topics(self, names: set[str]) -> None:
        wait_for(f"{names} are there", lambda: names <= self.topics())

    def topics(self) -> set[str]:
        with self.connected() as client:
            return set(client.call("/rosapi/topics")["values"]["topics"])

    def publish(self, topic: str, payload: str | bytes) -> None:
        """Publishes as a device."""
        self.publish_all([(topic, payload)])

    def publish_all(self, messages: list[tuple[str, str | bytes]]) -> None:
        paho.mqtt.publish.multiple(
            [{"topic": topic, "payload": payload, "retain": True} for topic, payload in messages],
            "127.0.0.1",
            self.broker.port,
            auth={"username": USER, "password": PASSWORD},
        )

    def press(self, topic: str) -> None:
        """Sends the message of a Home Assistant button."""
        auth = {"username": USER, "password": PASSWORD}
        paho.mqtt.publish.single(topic, "PRESS", 1, hostname="127.0.0.1", port=self.broker.port, auth=auth)

    def retained(self, topic: str) -> str:
        """A topic's retained message, once there is one."""
        auth = {"username": USER, "password": PASSWORD}
        message = paho.mqtt.subscribe.simple(topic, 1, hostname="127.0.0.1", port=self.broker.port, auth=auth)
        return str(message.payload.decode())

    def stop(self) -> None:
        for each in (self.gateway, self.devices, self.relay, self.broker):
            each.stop()


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MqttHome]:
    made = MqttHome(tmp_path_factory.mktemp("home"))
    yield made
    made.stop()


def test_files_of_the_gateway_are_closed_to_others(home: MqttHome) -> None:
    """The names of devices, the enrolment, and what is stored of a stop."""
    assert (home.state / "devices.json").exists()
    assert open_to_others(home.state) == {}


def wait_value(client: Client, topic: str, value: Any) -> None:
    """Waits until a topic has a value; the last one arrives at once."""
    wait_until(client, topic, lambda found: found == value)


def wait_until(client: Client, topic: str, condition: Callable[[Any], bool]) -> None:
    """Waits until a topic's value meets a condition."""
    client.send(op="subscribe", topic=topic, id=topic)
    while not condition(client.until(op="publish", topic=topic)["msg"]["data"]):
        pass
    client.send(op="unsubscribe", topic=topic, id=topic)


def test_lamp_is_seen_and_switched_by_rosbridge_and_http(home: MqttHome) -> None:
    with home.connected() as client:
        assert client.call("/lamp/light/switch", {"data": True})["values"]["success"]
        wait_value(client, "/lamp/light", True)
        client.send(
            op="publish", topic="/lamp/light/brightness/set", type="std_msgs/Float64", msg={"data": 40}
        )
        wait_value(client, "/lamp/light/brightness", 40.0)
    base = f"http://127.0.0.1:{home.relay.http_port}/api/v1/robots/{HOME}"
    with httpx.Client(
        base_url=base, headers={"Authorization": f"Bearer {home.operator}"}, timeout=60
    ) as http:
        assert http.get("topics/lamp/power", params={"wait": 30}).json()["value"] == {"data": 3.6}
        answer = http.post("services/lamp/light/switch", json={"args": {"data": False}})
        assert answer.status_code == 200, answer.text
    with home.connected() as client:
        wait_value(client, "/lamp/light", False)


def test_homie_thermostat_is_set(home: MqttHome) -> None:
    with home.connected() as client:
        topic = "/thermostat/heating/target/set"
        client.send(op="publish", topic=topic, type="std_msgs/Float64", msg={"data": 23.5})
        wait_value(client, "/thermostat/heating/target", 23.5)
        client.send(op="publish", topic=topic, type="std_msgs/Float64", msg={"data": 99})
        problem = "99 is outside of 5 to 30"
        wait_until(client, "/gateway/problems", lambda found: problem in found)


def test_rights_are_by_names_of_devices(home: MqttHome) -> None:
    assert not [each for each in home.topics() if each.startswith("/door")]
    url = f"http://127.0.0.1:{home.relay.http_port}/api/v1/robots/{HOME}/topics/door/contact"
    status = {
        token: httpx.get(url, headers={"Authorization": f"Bearer {token}"}, timeout=60).status_code
        for token in (home.operator, home.stranger)
    }
    assert set(status.values()) <= {403, 404}


def test_blind_is_motion_and_a_stop_keeps_it_still(home: MqttHome) -> None:
    with home.connected() as client:
        wait_for("it opens", lambda: client.call("/blind/blind/open_cover")["result"])
        wait_until(client, "/blind/blind/position", lambda found: found > 0)
        assert client.call("/relay/stop")["result"]
        wait_value(client, "/blind/blind", "open")
        assert not client.call("/blind/blind/open_cover")["result"]
        assert client.call("/lamp/light/switch", {"data": True})["values"]["success"], "lights are no motion"
        assert client.call("/relay/resume")["result"]


def test_robot_is_announced_and_obeys_buttons(home: MqttHome, tmp_path: Path) -> None:
    robot = SmallRobot(home.relay, "rover", {"/beep": _beep}).comes()
    home.relay.cli("right", "grant", "operator", "rover", "operator")
    settings = tmp_path / "announce.toml"
    settings.write_text(f'[mqtt]\nbroker = "{home.broker.address}"\nuser = "{USER}"\n')
    command = [str(BIN / "switchboard-mqtt"), "--announce", f"http://127.0.0.1:{home.relay.http_port}"]
    environment = {**os.environ, PASSWORD_VARIABLE: PASSWORD, "SWITCHBOARD_TOKEN": home.operator}
    announcer = Process([*command, "--config", str(settings)], tmp_path, "announcer", environment)
    try:
        config = home.retained("homeassistant/device/switchboard_rover/config")
        assert {"online", "stop", "service_beep"} <= set(json.loads(config)["cmps"])
        assert home.retained("switchboard/rover/online") == "ON"
        home.press("switchboard/rover/service_beep/set")
        wait_for("it beeps", lambda: robot.heard)
        home.press("switchboard/rover/stop/set")
        wait_for("it is stopped", lambda: robot.stopped)
        assert not [each for each in home.topics() if "rover" in each]
    finally:
        announcer.stop()
        robot.goes()
    assert home.operator not in announcer.log.read_text()


def _beep(robot: SmallRobot, args: Any) -> dict[str, Any]:
    robot.heard.append(args)
    return {"success": True, "message": ""}


def test_ten_thousand_devices_and_garbage_disturb_nothing(home: MqttHome) -> None:
    config = '{"dev":{"ids":"flood-%d"},"stat_t":"flood/%d"}'
    flood: list[tuple[str, str | bytes]] = [
        (f"homeassistant/sensor/flood/n{number}/config", config % (number, number))
        for number in range(10_000)
    ]
    flood += [
        ("homeassistant/light/garbage/config", b"\xff\x00 no json"),
        ("homeassistant/light/huge/config", b'{"x":"' + b"x" * 400_000 + b'"}'),
        ("home/lamp/brightness", b"\xff" * 300_000),
    ]
    home.publish_all(flood)
    with home.connected() as client:
        wait_until(client, "/gateway/problems", lambda found: "there are 1000 devices" in found)
        for on in (True, False):
            assert client.call("/lamp/light/switch", {"data": on})["values"]["success"]
            wait_value(client, "/lamp/light", on)
    home.publish_all([(topic, b"") for topic, _ in flood])
    wait_for("they are gone", lambda: len(home.topics()) < 100)


def test_broker_that_restarts_is_found_again(home: MqttHome) -> None:
    with home.connected() as client:
        wait_value(client, "/lamp/available", True)
        home.broker.stop()
        wait_value(client, "/lamp/available", False)
        wait_value(client, "/gateway/connected", False)
        assert "not connected" in str(client.call("/lamp/light/switch", {"data": True})["values"])
        home.broker.start()
        wait_value(client, "/lamp/available", True)
        assert client.call("/lamp/light/switch", {"data": True})["values"]["success"]
        wait_value(client, "/lamp/light", True)


def test_password_is_in_no_log(home: MqttHome) -> None:
    written = home.gateway.log.read_text() + home.gateway.said() + home.relay.log
    assert PASSWORD not in written
    assert "connected to the MQTT broker" in written
