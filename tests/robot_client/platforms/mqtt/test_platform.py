"""The platform with a broker in memory: devices, values, commands, limits."""

from __future__ import annotations

import json
from collections.abc import Callable
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock
from twisted.logger import globalLogPublisher

from relay_protocol.errors import Invalid, NotFound, Refused, SwitchboardError, Unavailable
from robot_client.logs import LineObserver
from robot_client.platforms.mqtt import devices
from robot_client.platforms.mqtt.broker import MqttMessage
from robot_client.platforms.mqtt.devices import DeviceNames
from robot_client.platforms.mqtt.messages import BOOL, NUMBER, SET_BOOL, TEXT, TRIGGER, decode, encode
from robot_client.platforms.mqtt.platform import PROBLEMS, STOP_DEVICES, MqttPlatform
from robot_client.platforms.mqtt.settings import MqttSettings
from tests.worlds.memory_broker import MemoryBroker

LAMP = {
    "dev": {"ids": ["0x1"], "name": "Lamp"},
    "stat_t": "lamp/state",
    "cmd_t": "lamp/set",
    "avty_t": "lamp/there",
    "bri_cmd_t": "lamp/brightness/set",
}
COVER = {
    "dev": {"ids": ["0x2"], "name": "Blind"},
    "cmd_t": "blind/set",
    "pos_t": "blind/p",
    "set_pos_t": "blind/p/set",
}


class GatewayWorld:
    """A running platform."""

    def __init__(self, names: Path | None = None, **options: Any) -> None:
        self.clock = Clock()
        self.broker = MemoryBroker()
        self.alerts: list[tuple[str, str, bool]] = []
        self.platform = MqttPlatform(
            MqttSettings(**options), self.broker, DeviceNames(names), self.clock, lambda: 1
        )
        self.platform.on_alert = self._alert
        self.platform.start()
        self.broker.connect()

    def _alert(self, level: str, text: str, kind: str = "", about: str = "", over: bool = False) -> None:
        self.alerts.append((level, text, over))

    def settle(self) -> None:
        for _ in range(20):
            self.clock.advance(0.05)

    def discover(self, component: str, config: dict[str, Any], name: str = "e", retain: bool = True) -> None:
        self.broker.send(f"homeassistant/{component}/{name}/config", json.dumps(config), retain)
        self.settle()

    def value(self, topic: str, type: str) -> Any:
        known = self.platform.value(topic, type)
        return None if known is None else decode(type, known[1])

    def problems(self) -> str:
        return str(self.value(PROBLEMS, TEXT))

    def call(self, service: str, type: str, body: bytes = b"\0\1\0\0\0", check: Any = None) -> bool:
        results: list[Any] = []
        answered: Deferred[bytes] = self.platform.call(service, type, body, 5.0, check)
        answered.addBoth(results.append)
        if not isinstance(results[0], bytes):
            results[0].raiseException()
        return results[0][4] == 1


@pytest.fixture
def world() -> GatewayWorld:
    return GatewayWorld()


def test_device_is_a_node_with_topics_and_services(world: GatewayWorld) -> None:
    world.discover("light", LAMP)
    graph = world.platform.graph()
    assert graph.nodes == {"/gateway", "/lamp"}
    assert {name: each.types for name, each in graph.topics.items() if name.startswith("/lamp")} == {
        "/lamp/available": [BOOL],
        "/lamp/e": [BOOL],
        "/lamp/e/set": [BOOL],
        "/lamp/e/brightness/set": [NUMBER],
    }
    assert graph.topics["/lamp/e"].publishers == ["/lamp"]
    assert graph.topics["/lamp/e/set"].subscribers == ["/lamp"]
    assert graph.services["/lamp/e/switch"].types == [SET_BOOL]
    endpoints = world.platform.endpoints
    assert endpoints("/lamp/e", "topic") == endpoints("/lamp/e/switch", "service") == {b"/lamp"}
    assert endpoints("/lamp/e/set", "topic") == endpoints("/none", "service") == frozenset()


def test_retained_state_arrives_and_a_late_subscriber_gets_it(world: GatewayWorld) -> None:
    world.broker.send("lamp/state", "ON", retain=True)
    world.discover("light", LAMP)
    got: list[bytes] = []
    world.platform.subscribe("/lamp/e", "", None, got.append, lambda: None)
    world.settle()
    world.broker.send("lamp/state", "OFF")
    world.settle()
    assert [decode(BOOL, each) for each in got] == [True, False]


def test_latched_samples_can_be_requested_again(world: GatewayWorld) -> None:
    world.discover("light", LAMP)
    world.broker.send("lamp/state", "ON")
    world.settle()
    subscription = world.platform.subscribe("/lamp/e", BOOL, None, lambda _: None, lambda: None)
    world.settle()
    got: list[object] = []
    subscription.request_latched(lambda stamp, body: got.append((stamp, body)), lambda: got.append("end"))
    world.settle()
    assert got == [(subscription.stamp, encode(BOOL, True)), "end"]
    assert subscription.stamps_id


def test_subscription_before_the_device_is_there(world: GatewayWorld) -> None:
    changes: list[int] = []
    got: list[bytes] = []
    subscription = world.platform.subscribe(
        "/lamp/e", "std_msgs/Bool", None, got.append, lambda: changes.append(subscription.publishers)
    )
    world.discover("light", LAMP)
    world.broker.send("lamp/state", "ON")
    world.settle()
    assert (changes, got) == ([1], [encode(BOOL, True)])


@pytest.mark.parametrize(("payload", "there"), [("online", True), ("offline", False), ("x", False)])
def test_availability(world: GatewayWorld, payload: str, there: bool) -> None:
    world.discover("light", LAMP)
    world.broker.send("lamp/there", payload)
    world.settle()
    assert world.value("/lamp/available", BOOL) is there


@pytest.mark.parametrize(
    ("mode", "messages", "there"),
    [
        ("all", ["a 1"], False),
        ("all", ["a 1", "b 1"], True),
        ("any", ["a 1", "b 0"], True),
        ("any", ["a 0"], False),
        ("latest", ["a 1", "b 0"], False),
        ("latest", ["b 0", "a 1"], True),
    ],
)
def test_availability_of_several_topics(
    world: GatewayWorld, mode: str, messages: list[str], there: bool
) -> None:
    avty = [{"t": each, "pl_avail": "1", "pl_not_avail": "0"} for each in "ab"]
    world.discover(
        "sensor", {"dev": {"ids": "x", "name": "D"}, "stat_t": "s", "avty": avty, "avty_mode": mode}
    )
    for each in messages:
        world.broker.send(*each.split())
        world.settle()
    assert world.value("/d/available", BOOL) is there


def test_no_devices_without_the_broker(world: GatewayWorld) -> None:
    world.discover("light", LAMP)
    world.broker.send("lamp/there", "online", retain=True)
    world.settle()
    world.broker.lose()
    assert world.value("/lamp/available", BOOL) is False
    assert world.value("/gateway/connected", BOOL) is False
    with pytest.raises(Unavailable):
        world.call("/lamp/e/switch", SET_BOOL)
    world.broker.connect()
    world.settle()
    assert world.value("/lamp/available", BOOL) is True
    assert [(level, over) for level, _, over in world.alerts] == [("error", False), ("info", True)]


def test_device_is_not_there_before_it_says_so_to_a_broker_that_restarted(world: GatewayWorld) -> None:
    world.discover("light", LAMP)
    world.broker.send("lamp/there", "online")
    world.settle()
    world.broker.lose()
    world.broker.connect()
    world.settle()
    assert world.value("/lamp/available", BOOL) is False
    world.broker.send("lamp/there", "online")
    world.settle()
    assert world.value("/lamp/available", BOOL) is True


def test_birth_message_asks_devices_to_announce_themselves(world: GatewayWorld) -> None:
    assert world.broker.published == [("homeassistant/status", "online", 0, False)]
    assert GatewayWorld(birth=False).broker.published == []


def test_empty_configuration_removes_the_device(world: GatewayWorld) -> None:
    world.discover("light", LAMP)
    world.broker.send("homeassistant/light/e/config", "", retain=True)
    world.settle()
    assert world.platform.graph().nodes == {"/gateway"}
    assert not {"lamp/state", "lamp/there"} & world.broker.subscribed
    assert world.platform.value("/lamp/e", BOOL) is None


def test_entities_of_one_device_come_together(world: GatewayWorld) -> None:
    world.discover("light", LAMP)
    world.discover("sensor", {"dev": LAMP["dev"], "stat_t": "lamp/p", "unit_of_meas": "W"}, "power")
    assert {"/lamp/e", "/lamp/power"} <= set(world.platform.graph().topics)
    world.broker.send("homeassistant/light/e/config", "")
    world.settle()
    topics = set(world.platform.graph().topics)
    assert "/lamp/power" in topics and "/lamp/e" not in topics


def test_same_name_is_given_once_and_stays_after_a_restart(tmp_path: Path) -> None:
    file = tmp_path / "devices.json"
    first = GatewayWorld(file)
    first.discover("light", LAMP)
    other = {**LAMP, "dev": {"ids": ["0x9"], "name": "Lamp"}}
    again = GatewayWorld(file)
    again.discover("light", other, "other")
    again.discover("light", LAMP)
    assert again.platform.graph().nodes == {"/gateway", "/lamp", "/lamp_2"}
    again.discover("light", {**LAMP, "dev": {"ids": ["0x3"], "name": "gateway"}}, "fake")
    assert "/gateway_2" in again.platform.graph().nodes


def test_only_the_devices_that_are_allowed() -> None:
    world = GatewayWorld(devices=["bl*"])
    world.discover("light", LAMP)
    world.discover("cover", COVER, "b")
    assert world.platform.graph().nodes == {"/gateway", "/blind"}


def publish(world: GatewayWorld, topic: str, type: str, value: object) -> None:
    world.platform.advertise(topic, type, False, None).publish(encode(type, value))


def test_commands_are_published(world: GatewayWorld) -> None:
    world.discover("light", {**LAMP, "ret": True, "qos": 1})
    world.broker.published.clear()
    publish(world, "/lamp/e/set", BOOL, True)
    publish(world, "/lamp/e/brightness/set", NUMBER, 99.0)
    assert world.call("/lamp/e/switch", SET_BOOL, b"\0\1\0\0\0")
    assert world.broker.published == [
        ("lamp/set", "ON", 1, True),
        ("lamp/brightness/set", "99", 1, True),
        ("lamp/set", "OFF", 1, True),
    ]


def test_command_that_is_not_taken_is_a_problem(world: GatewayWorld) -> None:
    world.discover("light", LAMP)
    publish(world, "/lamp/e/brightness/set", NUMBER, 1000.0)
    assert "1000 is outside of 0 to 255" in world.problems()
    publish(world, "/lamp/e/brightness/set", NUMBER, 1.0)
    assert "1000" not in world.problems()


@pytest.mark.parametrize(
    ("topic", "type", "error"),
    [
        ("/lamp/e", BOOL, Invalid),
        ("/lamp/e/set", NUMBER, Invalid),
        ("/other/e/set", BOOL, NotFound),
        ("/lamp/#", BOOL, Invalid),
        ("/" + "a" * 300, BOOL, Invalid),
    ],
)
def test_topics_that_take_no_commands(
    world: GatewayWorld, topic: str, type: str, error: type[SwitchboardError]
) -> None:
    world.discover("light", LAMP)
    with pytest.raises(error):
        world.platform.advertise(topic, type, False, None)


@pytest.mark.parametrize(
    ("service", "type"), [("/lamp/e/switch", TRIGGER), ("/lamp/e/none", ""), ("/lamp", ""), ("no name", "")]
)
def test_services_that_do_not_exist(world: GatewayWorld, service: str, type: str) -> None:
    world.discover("light", LAMP)
    with pytest.raises(SwitchboardError):
        world.call(service, type)


def test_call_is_checked_before_it_is_sent(world: GatewayWorld) -> None:
    world.discover("cover", COVER)
    world.broker.published.clear()

    def refuse() -> None:
        raise Refused("no control")

    with pytest.raises(Refused):
        world.call("/blind/e/open_cover", TRIGGER, check=refuse)
    assert world.broker.published == []


def test_stop_stops_all_covers(world: GatewayWorld) -> None:
    world.discover("cover", COVER)
    world.discover("light", LAMP, "l")
    world.broker.published.clear()
    assert world.call(STOP_DEVICES, TRIGGER)
    assert world.broker.published == [("blind/set", "STOP", 0, False)]


def test_a_stop_reaches_the_covers_behind_one_that_can_not_be_sent(
    world: GatewayWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b", "c"):
        device = {"ids": [name], "name": name}
        world.discover("cover", {**COVER, "device": device, "command_topic": f"{name}/set"}, name)
    publish, sent = world.broker.publish, list[str]()

    def failing(topic: str, *args: Any, **more: Any) -> None:
        if topic == "b/set":
            raise Unavailable("the MQTT broker takes no messages now")
        publish(topic, *args, **more)
        sent.append(topic)

    monkeypatch.setattr(world.broker, "publish", failing)
    with pytest.raises(Unavailable, match="1 of 3 covers were sent no stop"):
        world.call(STOP_DEVICES, TRIGGER)
    assert sent == ["a/set", "c/set"]


def test_what_the_broker_refuses_is_a_problem_until_the_next_connection(world: GatewayWorld) -> None:
    world.broker.listener.on_refused("the broker refuses a command: Not authorized")
    assert "Not authorized" in world.problems()
    world.broker.lose()
    world.broker.connect()
    assert "Not authorized" not in world.problems()


def test_a_message_without_the_value_of_an_element_is_no_problem(world: GatewayWorld) -> None:
    """Devices publish some of their values at a time."""
    world.discover("sensor", {"name": "b", "uniq_id": "b", "stat_t": "zig", "val_tpl": "{{ value_json.battery }}",
                              "unit_of_meas": "%", "dev": {"ids": ["zig"], "name": "Zig"}})  # fmt: skip
    world.broker.send("zig", '{"battery": 50}')
    world.settle()
    world.broker.send("zig", '{"linkquality": 7}')
    world.settle()
    assert world.value("/zig/e", NUMBER) == 50
    assert "zig" not in world.problems()


def test_state_that_can_not_be_read_is_a_problem_until_one_can(world: GatewayWorld) -> None:
    world.discover("light", LAMP)
    for bad in (b"maybe", b"\xff\xff", b"x" * 70_000):
        world.broker.send("lamp/state", bad)
        world.settle()
        assert "/lamp/e" in world.problems()
        assert world.value("/lamp/e", BOOL) is None
    world.broker.send("lamp/state", b"ON")
    world.settle()
    assert "/lamp/e" not in world.problems()
    assert world.value("/lamp/e", BOOL) is True


def test_configuration_that_is_no_json_is_a_problem_and_disturbs_nothing_else(world: GatewayWorld) -> None:
    world.broker.send("homeassistant/light/bad/config", b"\x00\xffno json")
    world.discover("light", LAMP)
    assert "homeassistant/light/bad/config" in world.problems()
    assert "/lamp" in world.platform.graph().nodes


def test_ten_thousand_devices_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "MAX_DEVICES", 50)
    world = GatewayWorld()
    world.discover("light", LAMP)
    for number in range(500):
        config = {"dev": {"ids": f"d{number}", "name": f"D{number}"}, "stat_t": f"s/{number}"}
        world.broker.send(f"homeassistant/sensor/d{number}/config", json.dumps(config))
    world.settle()
    assert len(world.platform.graph().nodes) == 51
    assert "there are 50 devices, the most there may be" in world.problems()
    assert len(world.problems()) < 100_000
    world.broker.send("lamp/state", "ON")
    world.settle()
    assert world.value("/lamp/e", BOOL) is True


def test_a_device_whose_every_state_is_a_problem_does_not_fill_the_log(world: GatewayWorld) -> None:
    """30 lines a minute."""
    log = StringIO()
    observer = LineObserver(log, False)
    globalLogPublisher.addObserver(observer)
    try:
        world.discover("light", LAMP)
        for number in range(100):
            world.broker.send("lamp/state", f"neither {number}")
            world.settle()
    finally:
        globalLogPublisher.removeObserver(observer)
    assert len([each for each in log.getvalue().splitlines() if "neither" in each]) == 30
    assert "neither 99" in world.problems()


def test_too_many_elements_of_one_device(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "MAX_DEVICE_ITEMS", 5)
    world = GatewayWorld()
    cmps = {f"s{each}": {"p": "sensor", "stat_t": f"s/{each}"} for each in range(6)}
    world.broker.send("homeassistant/device/x/config", json.dumps({"dev": {"ids": "x"}, "cmps": cmps}))
    world.settle()
    assert world.platform.graph().nodes == {"/gateway"}
    assert "more than 5 elements" in world.problems()


def test_too_many_sources_of_availability_of_one_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """All of them are read by one message."""
    monkeypatch.setattr(devices, "MAX_DEVICE_ITEMS", 5)
    world = GatewayWorld()
    cmps = {
        f"s{each}": {"p": "sensor", "stat_t": "s", "avty": [{"t": f"a/{each}"}, {"t": f"b/{each}"}]}
        for each in range(3)
    }
    world.broker.send("homeassistant/device/x/config", json.dumps({"dev": {"ids": "x"}, "cmps": cmps}))
    world.settle()
    assert world.platform.graph().nodes == {"/gateway"}
    assert "more than 5 sources of its availability" in world.problems()


def test_other_work_gets_its_turn_during_a_flood(
    world: GatewayWorld, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.discover("light", LAMP)
    # Each reading of the clock takes a millisecond.
    seconds: Callable[[], float] = world.clock.seconds

    def slow() -> float:
        world.clock.rightNow += 0.001
        return seconds()

    monkeypatch.setattr(world.clock, "seconds", slow)
    pending = [("lamp/state", b"ON")] * 1000
    monkeypatch.setattr(world.broker, "take", lambda: _message(pending))
    world.platform.on_waiting()
    assert 0 < len(pending) < 1000


def _message(pending: list[tuple[str, bytes]]) -> MqttMessage | None:
    return MqttMessage(*pending.pop()) if pending else None


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=10), inner, max_size=3),
    max_leaves=10,
)
WORDS = "~ dev ids cns cmps p stat_t cmd_t val_tpl avty avty_mode ops min max qos ret bri_scl schema pos_open pl_on e"
KEYS = st.sampled_from(WORDS.split())
CONFIGS = st.dictionaries(KEYS, JSON | st.dictionaries(KEYS, JSON, max_size=4), max_size=8)


@settings(max_examples=150, deadline=None)
@given(
    component=st.sampled_from(
        ["device", "sensor", "light", "cover", "climate", "lock", "number", "select", "text", "x"]
    ),
    config=CONFIGS.map(lambda each: json.dumps(each).encode()) | st.binary(max_size=200),
    state=st.binary(max_size=50),
)
def test_no_payload_breaks_the_gateway(component: str, config: bytes, state: bytes) -> None:
    world = GatewayWorld()
    world.broker.send(f"homeassistant/{component}/hostile/config", config)
    world.broker.send("homie/5/hostile/$description", config)
    world.broker.send("homie/5/hostile/$state", state)
    world.settle()
    for topic in list(world.broker.subscribed):
        if "+" not in topic:
            world.broker.send(topic, state)
    world.discover("light", LAMP)
    world.broker.send("lamp/state", "ON")
    world.settle()
    lamp = next(name for name in world.platform.graph().nodes if name.startswith("/lamp"))
    assert world.value(f"{lamp}/e", BOOL) is True


def test_names_that_can_not_be_saved_are_reported_and_saved_later(tmp_path: Path) -> None:
    taken = tmp_path / "names.new"
    taken.mkdir()
    world = GatewayWorld(tmp_path / "names.json")
    world.discover("switch", {"name": "Lamp", "unique_id": "lamp", "command_topic": "l/set"}, "lamp")
    assert "the names of devices can't be kept for the next start: Is a directory" in world.problems()
    taken.rmdir()
    world.discover("switch", {"name": "Fan", "unique_id": "fan", "command_topic": "f/set"}, "fan")
    assert "can't be kept" not in world.problems()
    assert {"lamp", "fan"} <= set(json.loads((tmp_path / "names.json").read_bytes()).values())
