"""Robots announced on a broker: what is published, and what commands do."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from relay_protocol.errors import Invalid
from robot_client.apps.announce import (
    MAX_AGE,
    MAX_WAITING,
    SET_BOOL,
    STATUS,
    TRIGGER,
    AnnouncedService,
    Announcer,
    RelayError,
    robot_id,
)
from robot_client.apps.announce_process import check_url
from robot_client.platforms.mqtt.home_assistant import parse_config, parse_topic
from robot_client.platforms.mqtt.homie import HomieDevices


class MemoryApi:
    """A relay's API."""

    def __init__(self) -> None:
        self.listed = [robot("rover")]
        self.offered = [AnnouncedService("/dock/start", TRIGGER), AnnouncedService("/lamp", SET_BOOL)]
        self.done: list[tuple[Any, ...]] = []
        self.error = ""
        self.broken = ""

    def robots(self) -> list[dict[str, Any]]:
        return self.listed

    def services(self, robot: str) -> list[AnnouncedService]:
        if robot == self.broken:
            raise RelayError("the robot does not answer")
        return self.offered

    def stop(self, robot: str) -> None:
        self._do("stop", robot)

    def call(self, robot: str, service: str, args: dict[str, Any]) -> None:
        self._do("call", robot, service, args)

    def _do(self, *what: Any) -> None:
        if self.error:
            raise RelayError(self.error)
        self.done.append(what)


def robot(name: str, **fields: Any) -> dict[str, Any]:
    return {"name": name, "platform": "ros2", "state": "online", "battery": 0.5, "stopped": None, **fields}


class AnnouncedWorld:
    """An announcer with a broker that keeps what is retained."""

    def __init__(self) -> None:
        self.api = MemoryApi()
        self.retained: dict[str, str] = {}
        self.count = 0
        self.now = 0.0
        self.pending: list[tuple[bool, Callable[[], None]]] = []
        self.announcer = Announcer(
            self.api,
            self,
            "homeassistant",
            "homie",
            lambda *work: self.pending.append(work),
            lambda: self.now,
        )
        self.announcer.connected()
        self.announcer.poll()

    def publish(self, topic: str, payload: str, qos: int = 0, retain: bool = False) -> None:
        assert retain
        self.count += 1
        self.retained[topic] = payload

    def command(self, topic: str, payload: str, retained: bool = False) -> None:
        self.announcer.received(topic, payload, retained)
        self.run()

    def run(self) -> None:
        pending, self.pending = self.pending, []
        for _, function in pending:
            function()

    def config(self) -> dict[str, Any]:
        return dict(json.loads(self.retained["homeassistant/device/switchboard_rover/config"]))


@pytest.fixture
def world() -> AnnouncedWorld:
    return AnnouncedWorld()


def test_a_robot_whose_services_are_not_known_holds_up_no_other(world: AnnouncedWorld) -> None:
    world.api.listed = [robot("broken"), robot("new")]
    world.api.broken = "broken"
    world.announcer.poll()
    assert world.retained["homeassistant/device/switchboard_new/config"]
    assert "service_" not in world.retained["homeassistant/device/switchboard_broken/config"]


def test_robot_is_a_device_of_home_assistant(world: AnnouncedWorld) -> None:
    config = world.config()
    kinds = {key: (each["p"], each.get("dev_cla")) for key, each in config["cmps"].items()}
    assert kinds == {
        "online": ("binary_sensor", "connectivity"),
        "stopped": ("binary_sensor", "problem"),
        "battery": ("sensor", "battery"),
        "stop": ("button", None),
        "service_dock_start": ("button", None),
        "service_lamp": ("switch", None),
    }
    assert config["avty_t"] == STATUS
    where = parse_topic("homeassistant/device/rover/config", "homeassistant")
    assert where is not None
    part = parse_config(where, json.dumps(config).encode())
    assert part.problems == []
    assert {each.topic for each in part.calls} == {
        f"switchboard/rover/{each}/set" for each in ("stop", "service_dock_start", "service_lamp")
    }
    values = {each: world.retained[f"switchboard/rover/{each}"] for each in ("online", "stopped", "battery")}
    assert values == {"online": "ON", "stopped": "OFF", "battery": "50"}
    assert world.retained[STATUS] == "online"


def test_robot_is_a_device_of_homie(world: AnnouncedWorld) -> None:
    devices = HomieDevices("homie")
    for topic, payload in world.retained.items():
        devices.handle(topic.replace("switchboard-rover", "rover"), payload.encode())
    ((_, part),) = devices.take_changed()
    assert part is not None and part.problems == []
    found = {each.name: each.command is not None for each in part.elements}
    assert found == {
        "robot/online": False,
        "robot/stopped": False,
        "robot/battery": False,
        "robot/stop": True,
        "robot/service_dock_start": True,
        "robot/service_lamp": True,
    }


def test_gateway_takes_no_announced_robot_for_a_device(world: AnnouncedWorld) -> None:
    assert parse_topic("homeassistant/device/switchboard_rover/config", "homeassistant") is None
    devices = HomieDevices("homie")
    for topic, payload in world.retained.items():
        devices.handle(topic, payload.encode())
    assert devices.take_changed() == []


def test_gateways_are_not_announced(world: AnnouncedWorld) -> None:
    world.api.listed = [robot("home", platform="mqtt")]
    world.retained.clear()
    world.announcer.poll()
    assert not any(world.retained.values())


COMMANDS = [
    ("switchboard/rover/stop/set", "PRESS", ("stop", "rover")),
    ("homie/switchboard-rover/robot/stop/set", "true", ("stop", "rover")),
    ("switchboard/rover/service_dock_start/set", "PRESS", ("call", "rover", "/dock/start", {})),
    ("switchboard/rover/service_lamp/set", "ON", ("call", "rover", "/lamp", {"data": True})),
    ("switchboard/rover/service_lamp/set", "OFF", ("call", "rover", "/lamp", {"data": False})),
    ("homie/switchboard-rover/robot/service-lamp/set", "false", ("call", "rover", "/lamp", {"data": False})),
]


@pytest.mark.parametrize(("topic", "payload", "done"), COMMANDS)
def test_command_is_carried_out_once_unless_it_is_retained(
    world: AnnouncedWorld, topic: str, payload: str, done: tuple[Any, ...]
) -> None:
    world.command(topic, payload, retained=True)
    assert world.api.done == []
    world.command(topic, payload)
    assert world.api.done == [done]


@pytest.mark.parametrize(
    ("topic", "payload"),
    [
        ("switchboard/rover/stop/set", "false"),
        ("switchboard/rover/service_dock_start/set", "OFF"),
        ("switchboard/rover/service_lamp/set", "maybe"),
        ("switchboard/other/stop/set", "PRESS"),
        ("switchboard/rover/online/set", "ON"),
    ],
)
def test_other_words_do_nothing(world: AnnouncedWorld, topic: str, payload: str) -> None:
    world.command(topic, payload)
    assert world.api.done == []


def test_late_command_is_dropped_and_a_late_stop_is_not(world: AnnouncedWorld) -> None:
    world.announcer.received("switchboard/rover/service_lamp/set", "ON", False)
    world.announcer.received("switchboard/rover/stop/set", "PRESS", False)
    world.now += MAX_AGE + 1
    world.run()
    assert world.api.done == [("stop", "rover")]


def test_flood_of_commands_is_bounded_and_leaves_room_for_a_stop(world: AnnouncedWorld) -> None:
    for _ in range(MAX_WAITING * 3):
        world.announcer.received("switchboard/rover/service_lamp/set", "ON", False)
    world.announcer.received("switchboard/rover/stop/set", "PRESS", False)
    assert [stop for stop, _ in world.pending].count(False) == MAX_WAITING
    assert world.pending[-1][0] is True


def test_refusal_of_the_relay_does_not_end_it(world: AnnouncedWorld) -> None:
    world.api.error = "the relay answers 403"
    world.command("switchboard/rover/stop/set", "PRESS")
    world.api.error = ""
    world.command("switchboard/rover/stop/set", "PRESS")
    assert world.api.done == [("stop", "rover")]


def test_only_changes_are_published_and_all_of_it_to_a_broker_that_is_back(world: AnnouncedWorld) -> None:
    whole = world.count
    world.announcer.poll()
    assert world.count == whole
    world.api.listed = [robot("rover", state="offline", stopped={"by": "ann"})]
    world.announcer.poll()
    assert world.retained["switchboard/rover/online"] == "OFF"
    assert world.retained["switchboard/rover/stopped"] == "ON"
    assert world.count == whole + 4, "for Home Assistant and for Homie"
    world.announcer.connected()
    world.announcer.poll()
    assert world.count == 2 * whole + 4


def test_robot_that_is_gone_is_removed(world: AnnouncedWorld) -> None:
    world.api.listed = []
    world.announcer.poll()
    assert {topic for topic, payload in world.retained.items() if payload} == {STATUS}
    world.command("switchboard/rover/stop/set", "PRESS")
    assert world.api.done == []


def test_ids_of_different_robots_differ() -> None:
    names = ["a-b", "a_b", "a@b", "A-b", "x" * 80, "x" * 81]
    assert len({robot_id(each) for each in names}) == len(names)


@pytest.mark.parametrize("url", ["http://relay.example.org", "relay.example.org", "file:///etc", "https://"])
def test_address_that_would_leak_the_token_is_refused(url: str) -> None:
    with pytest.raises(Invalid):
        check_url(url)


@pytest.mark.parametrize("url", ["https://relay.example.org", "http://127.0.0.1:9090"])
def test_address_that_is_allowed(url: str) -> None:
    check_url(url)
