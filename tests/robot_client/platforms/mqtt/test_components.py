"""Each component of Home Assistant's discovery: which topics and services it becomes, and what they read and write."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from relay_protocol.errors import Invalid
from robot_client.platforms.mqtt import templates
from robot_client.platforms.mqtt.devices import DeviceNames, DeviceRegistry, ProblemList
from robot_client.platforms.mqtt.home_assistant import ConfigTopic, parse_config, parse_topic
from robot_client.platforms.mqtt.messages import BOOL, NUMBER, SET_BOOL, TEXT, TRIGGER
from robot_client.platforms.mqtt.model import DevicePart, Element

DEVICE = {"identifiers": ["0x1"], "name": "Lamp"}


def discover(component: str, config: dict[str, Any]) -> DevicePart:
    payload = json.dumps({"device": DEVICE, **config}).encode()
    return parse_config(ConfigTopic(component, "", "e"), payload)


def element(part: DevicePart, name: str) -> Element:
    return next(each for each in part.elements if each.name == name)


STATES = [
    ("sensor", {"stat_t": "s", "unit_of_meas": "°C"}, "e", NUMBER, "21.5", 21.5),
    ("sensor", {"stat_t": "s", "stat_cla": "measurement"}, "e", NUMBER, "3", 3.0),
    ("sensor", {"stat_t": "s"}, "e", TEXT, "hello", "hello"),
    (
        "sensor",
        {"stat_t": "s", "unit_of_meas": "%", "val_tpl": "{{ value_json.h | float }}"},
        "e",
        NUMBER,
        '{"h":"4"}',
        4.0,
    ),
    (
        "sensor",
        {"stat_t": "s", "dev_cla": "timestamp", "stat_cla": "x"},
        "e",
        TEXT,
        "2026-01-01",
        "2026-01-01",
    ),
    ("binary_sensor", {"stat_t": "s"}, "e", BOOL, "ON", True),
    (
        "binary_sensor",
        {"stat_t": "s", "pl_on": True, "pl_off": False, "val_tpl": "{{ value_json.contact }}"},
        "e",
        BOOL,
        '{"contact":false}',
        False,
    ),
    ("switch", {"stat_t": "s", "cmd_t": "c", "stat_on": "1", "stat_off": "0"}, "e", BOOL, "1", True),
    (
        "light",
        {"stat_t": "s", "cmd_t": "c", "stat_val_tpl": "{{ value_json.state }}"},
        "e",
        BOOL,
        '{"state":"OFF"}',
        False,
    ),
    ("light", {"cmd_t": "c", "bri_stat_t": "s", "bri_cmd_t": "b"}, "e/brightness", NUMBER, "128", 128.0),
    (
        "light",
        {"schema": "json", "stat_t": "s", "cmd_t": "c", "brightness": True},
        "e/brightness",
        NUMBER,
        '{"brightness":7}',
        7.0,
    ),
    ("light", {"schema": "json", "stat_t": "s", "cmd_t": "c"}, "e", BOOL, '{"state":"ON"}', True),
    ("light", {"schema": "json", "stat_t": "s", "cmd_t": "c"}, "e", BOOL, '{"color":1}', None),
    ("climate", {"temp_stat_t": "s", "temp_cmd_t": "c"}, "e/temperature", NUMBER, "19", 19.0),
    ("climate", {"curr_temp_t": "s"}, "e/current_temperature", NUMBER, "20.25", 20.25),
    (
        "climate",
        {"mode_stat_t": "s", "mode_cmd_t": "c", "modes": ["off", "heat"]},
        "e/mode",
        TEXT,
        "heat",
        "heat",
    ),
    ("climate", {"act_t": "s"}, "e/action", TEXT, "heating", "heating"),
    ("number", {"stat_t": "s", "cmd_t": "c"}, "e", NUMBER, "5", 5.0),
    ("select", {"stat_t": "s", "cmd_t": "c", "ops": ["a", "b"]}, "e", TEXT, "b", "b"),
    ("text", {"stat_t": "s", "cmd_t": "c"}, "e", TEXT, "x", "x"),
    ("cover", {"pos_t": "s", "set_pos_t": "c"}, "e/position", NUMBER, "40", 40.0),
    ("cover", {"stat_t": "s", "cmd_t": "c"}, "e", TEXT, "opening", "opening"),
    ("lock", {"stat_t": "s", "cmd_t": "c"}, "e/locked", BOOL, "LOCKED", True),
    ("lock", {"stat_t": "s", "cmd_t": "c"}, "e/locked", BOOL, "JAMMED", None),
    ("fan", {"pct_stat_t": "s", "pct_cmd_t": "c", "cmd_t": "c"}, "e/percentage", NUMBER, "50", 50.0),
    ("event", {"stat_t": "s"}, "e", TEXT, '{"event_type":"press"}', '{"event_type":"press"}'),
]


@pytest.mark.parametrize(("component", "config", "name", "type", "payload", "value"), STATES)
def test_state_of_a_component(
    component: str, config: dict[str, Any], name: str, type: str, payload: str, value: object
) -> None:
    part = discover(component, config)
    found = element(part, name)
    assert (found.type, part.problems) == (type, [])
    assert found.source is not None
    assert found.source.topic == "s"
    assert found.source.value(payload.encode()) == value


COMMANDS = [
    ("switch", {"cmd_t": "c"}, "e", True, "ON"),
    ("switch", {"cmd_t": "c", "pl_off": "0"}, "e", False, "0"),
    ("light", {"cmd_t": "c", "bri_cmd_t": "c"}, "e/brightness", 128.0, "128"),
    (
        "light",
        {"schema": "json", "cmd_t": "c", "brightness": True},
        "e/brightness",
        7.0,
        '{"state":"ON","brightness":7}',
    ),
    ("light", {"schema": "json", "cmd_t": "c"}, "e/json", '{"color":{"r":1}}', '{"color":{"r":1}}'),
    ("climate", {"temp_cmd_t": "c"}, "e/temperature", 20.5, "20.5"),
    ("climate", {"mode_cmd_t": "c", "mode_cmd_tpl": "m={{ value | upper }}"}, "e/mode", "heat", "m=HEAT"),
    ("number", {"cmd_t": "c", "cmd_tpl": '{"n": {{ value * 10 }}}'}, "e", 2.5, '{"n": 25.0}'),
    ("select", {"cmd_t": "c", "ops": ["a", "b"]}, "e", "a", "a"),
    ("text", {"cmd_t": "c"}, "e", "hello", "hello"),
    ("cover", {"set_pos_t": "c"}, "e/position", 100.0, "100"),
    ("cover", {"tilt_cmd_t": "c"}, "e/tilt", 10.0, "10"),
]


@pytest.mark.parametrize(("component", "config", "name", "value", "payload"), COMMANDS)
def test_command_of_a_component(
    component: str, config: dict[str, Any], name: str, value: object, payload: str
) -> None:
    command = element(discover(component, config), name).command
    assert command is not None
    assert (command.topic, command.payload(value)) == ("c", payload)


REFUSED = [
    ("number", {"cmd_t": "c", "min": 0, "max": 10}, "e", 11.0),
    ("number", {"cmd_t": "c"}, "e", float("nan")),
    ("select", {"cmd_t": "c", "ops": ["a", "b"]}, "e", "z"),
    ("text", {"cmd_t": "c", "max": 3}, "e", "long"),
    ("cover", {"set_pos_t": "c"}, "e/position", 101.0),
    ("climate", {"mode_cmd_t": "c", "modes": ["off"]}, "e/mode", "on"),
    ("light", {"schema": "json", "cmd_t": "c"}, "e/json", "no json"),
]


@pytest.mark.parametrize(("component", "config", "name", "value"), REFUSED)
def test_value_that_a_device_does_not_take(
    component: str, config: dict[str, Any], name: str, value: object
) -> None:
    command = element(discover(component, config), name).command
    assert command is not None
    with pytest.raises(Invalid):
        command.payload(value)


CALLS = [
    ("switch", {"cmd_t": "c"}, {"e/switch": (SET_BOOL, "ON")}),
    ("light", {"cmd_t": "c"}, {"e/switch": (SET_BOOL, "ON")}),
    ("button", {"cmd_t": "c"}, {"e/press": (TRIGGER, "PRESS")}),
    ("button", {"cmd_t": "c", "pl_prs": "go"}, {"e/press": (TRIGGER, "go")}),
    ("scene", {"cmd_t": "c"}, {"e/press": (TRIGGER, "ON")}),
    (
        "cover",
        {"cmd_t": "c", "pl_stop": None},
        {"e/open_cover": (TRIGGER, "OPEN"), "e/close_cover": (TRIGGER, "CLOSE")},
    ),
    (
        "lock",
        {"cmd_t": "c", "pl_open": "OPEN"},
        {"e/lock": (TRIGGER, "LOCK"), "e/unlock": (TRIGGER, "UNLOCK"), "e/open": (TRIGGER, "OPEN")},
    ),
    ("climate", {"pow_cmd_t": "c"}, {"e/power": (SET_BOOL, "ON")}),
]


@pytest.mark.parametrize(("component", "config", "services"), CALLS)
def test_services_of_a_component(
    component: str, config: dict[str, Any], services: dict[str, tuple[str, str]]
) -> None:
    calls = discover(component, config).calls
    assert {each.name: (each.type, each.payload(True)) for each in calls} == services
    assert {each.topic for each in calls} == {"c"}


def test_commands_of_a_cover_are_never_retained() -> None:
    """The broker would give them to a cover that comes back, maybe after a stop."""
    part = discover("cover", {"cmd_t": "c", "set_pos_t": "p", "tilt_cmd_t": "t", "ret": True})
    commands = [each.command for each in part.elements if each.command is not None]
    assert len(commands) == 2
    assert not any(each.retain for each in (*commands, *part.calls))
    switch = discover("switch", {"cmd_t": "c", "ret": True})
    assert any(each.command is not None and each.command.retain for each in switch.elements)


def test_entities_of_one_name_are_numbered_and_still_move() -> None:
    """Motion is known by the end of a name: of topics and services of both."""
    registry = DeviceRegistry(DeviceNames(None), ProblemList())
    for node in ("left", "right"):
        topic = f"homeassistant/cover/{node}/blind/config"
        config = {
            "dev": {"ids": ["b1"], "name": "Blinds"},
            "cmd_t": f"b/{node}/set",
            "set_pos_t": f"b/{node}/position",
            "tilt_cmd_t": f"b/{node}/tilt",
        }
        where = parse_topic(topic, "homeassistant")
        assert where is not None
        registry.set_part(topic, parse_config(where, json.dumps(config).encode()))
    (device,) = (each for each in registry.flush().devices.values() if each is not None)
    assert set(device.calls) == {
        f"/blinds/{entity}/{order}_cover"
        for entity in ("blind", "blind_2")
        for order in ("open", "close", "stop")
    }
    assert {name for name, each in device.elements.items() if each.command is not None} == {
        f"/blinds/{entity}/{part}" for entity in ("blind", "blind_2") for part in ("position", "tilt")
    }


def test_stop_of_a_cover_is_called_at_a_stop() -> None:
    calls = discover("cover", {"cmd_t": "c"}).calls
    assert [each.name for each in calls if each.stops] == ["e/stop_cover"]


def test_device_form_with_abbreviations_and_base() -> None:
    payload = {
        "~": "zigbee/lamp",
        "dev": {"ids": "0x2", "name": "Desk lamp"},
        "o": {"name": "bridge"},
        "qos": 1,
        "avty_t": "~/there",
        "cmps": {
            "power": {"p": "switch", "stat_t": "~/state", "cmd_t": "~/set"},
            "signal": {"p": "sensor", "stat_t": "rssi/~", "unit_of_meas": "dBm"},
            "gone": {"p": "sensor"},
            "laser": {"p": "vacuum", "cmd_t": "~/x"},
        },
    }
    part = parse_config(ConfigTopic("device", "", "lamp"), json.dumps(payload).encode())
    assert (part.key, part.name) == ("device:0x2", "Desk lamp")
    power = element(part, "power")
    assert power.source is not None and power.source.topic == "zigbee/lamp/state"
    assert power.command is not None and (power.command.topic, power.command.qos) == ("zigbee/lamp/set", 1)
    signal = element(part, "signal")
    assert signal.source is not None and signal.source.topic == "rssi/zigbee/lamp"
    assert [each.name for each in part.elements] == ["power", "signal"]
    assert part.problems == ["'laser': the component 'vacuum' is not supported"]
    assert [source.topic for each in part.availability for source in each.sources] == ["zigbee/lamp/there"]


def test_template_that_is_not_understood_is_a_problem_and_the_command_stays() -> None:
    part = discover("switch", {"stat_t": "s", "cmd_t": "c", "val_tpl": "{% for x in value %}{% endfor %}"})
    assert element(part, "e").source is None
    assert element(part, "e").command is not None
    assert "uses 'For', which is not supported" in part.problems[0]


def test_availability_list_with_mode() -> None:
    listed = [
        {"t": "a", "pl_avail": "1", "pl_not_avail": "0"},
        {"topic": "b", "val_tpl": "{{ value_json.state }}"},
    ]
    (found,) = discover("sensor", {"stat_t": "s", "avty": listed, "avty_mode": "all"}).availability
    assert found.mode == "all"
    assert [
        each.value(body) for each, body in zip(found.sources, (b"1", b'{"state":"offline"}'), strict=True)
    ] == [
        True,
        False,
    ]


def test_entity_without_a_device_is_one() -> None:
    part = parse_config(ConfigTopic("sensor", "node", "temp"), b'{"stat_t":"s"}')
    assert (part.key, part.name) == ("topic:node/temp", "node/temp")


def test_connections_identify_a_device() -> None:
    part = parse_config(ConfigTopic("sensor", "", "t"), b'{"stat_t":"s","dev":{"cns":[["mac","02:5b"]]}}')
    assert part.key == "device:02:5b"


@pytest.mark.parametrize(
    ("topic", "found"),
    [
        ("homeassistant/sensor/x/config", ConfigTopic("sensor", "", "x")),
        ("homeassistant/sensor/node/x/config", ConfigTopic("sensor", "node", "x")),
        ("homeassistant/sensor/x/state", None),
        ("homeassistant/status", None),
        ("other/sensor/x/config", None),
    ],
)
def test_topics_of_discovery(topic: str, found: ConfigTopic | None) -> None:
    assert parse_topic(topic, "homeassistant") == found


@pytest.mark.parametrize(
    "payload",
    [
        b"no json",
        b"[1]",
        b'"x"',
        b"\xff\xfe",
        b"[" * 100_000,
        b'{"stat_t": 5}',
        b'{"stat_t": "a/#"}',
        b'{"stat_t": ""}',
        b'{"stat_t":"s","dev":{}}',
        b'{"stat_t":"s","dev":{"ids":[[[]]]}}',
        b'{"stat_t":"s","avty":[1]}',
        b'{"stat_t":"' + b"s" * 2000 + b'"}',
        b"x" * 300_000,
    ],
)
def test_hostile_configuration_is_refused_with_a_reason(payload: bytes) -> None:
    try:
        part = parse_config(ConfigTopic("sensor", "", "x"), payload)
    except Invalid as error:
        assert len(str(error)) < 500
    else:
        assert part.elements == [] and part.problems


def _device(template: Callable[[int], str], shared: dict[str, Any] | None = None) -> DevicePart:
    """A device of 50 sensors.

    :param shared: keys that all of them inherit
    """
    cmps = {f"s{each}": {"p": "sensor", "stat_t": "s", "val_tpl": template(each)} for each in range(50)}
    payload = json.dumps({"dev": DEVICE, **(shared or {}), "cmps": cmps}).encode()
    return parse_config(ConfigTopic("device", "", "x"), payload)


def test_templates_of_one_message_have_6000_words_together() -> None:
    """A long template takes long to parse, and a message has room for many."""
    part = _device(lambda number: "{{" + "+".join(["a"] * 500) + f"+{number}" + "}}")
    assert len(part.elements) == 5  # each has 1005 words and signs
    assert "may have 6000 words and signs together" in part.problems[0]
    assert len(part.problems) == 20


def test_usual_templates_are_all_read() -> None:
    part = _device(lambda number: f"{{{{ value_json.values.s{number} | float | round(2) }}}}")
    assert (len(part.elements), part.problems) == (50, [])


@pytest.mark.parametrize("template", ["{{" + "+".join(["a"] * 500) + "}}", "{{" + "a+" * 500 + "}}"])
def test_a_template_that_components_inherit_is_parsed_once(
    template: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a message of 80 KiB with 200 components has 8 MiB of templates. The second one is not valid."""
    parsed: list[str] = []
    parse = templates.Template
    monkeypatch.setattr(templates, "Template", lambda source: (parsed.append(source), parse(source))[1])
    _device(lambda _: template, {"avty": [{"t": f"a{each}", "val_tpl": template} for each in range(10)]})
    assert parsed == [template]
