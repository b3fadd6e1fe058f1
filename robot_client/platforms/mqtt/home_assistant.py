"""Home Assistant's MQTT discovery: from a configuration payload to the part of a device that it describes.

Both forms are read: one message for a device (``<prefix>/device/<id>/config`` with ``components``), and one for each
entity (``<prefix>/<component>/[<node>/]<object>/config``). Source: https://www.home-assistant.io/integrations/mqtt,
"MQTT Discovery", and the page of each component.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import msgspec

from relay_protocol.errors import Invalid
from robot_client.platforms.mqtt.messages import BOOL, NUMBER, SET_BOOL, TEXT, TRIGGER
from robot_client.platforms.mqtt.model import (
    ANNOUNCED,
    AvailabilitySource,
    DeviceCall,
    DevicePart,
    Element,
    PartAvailability,
    StateCommand,
    StateSource,
    check_mqtt_topic,
    constant,
    read_bool,
    read_number,
    read_text,
    slug,
    write_bool,
    write_number,
    write_option,
    write_text,
)
from robot_client.platforms.mqtt.templates import Template, TemplateParser

MAX_CONFIG = 256 * 1024
"""Bytes of a discovery message."""

MAX_COMPONENTS = 200
"""Entities in one discovery message."""

MAX_OPTIONS = 200
MAX_AVAILABILITY = 10
MAX_PROBLEMS = 20

BIRTH = "online"
"""The payload of ``<prefix>/status`` that asks devices to announce themselves again."""

_SUFFIXES = {
    "t": "topic",
    "tpl": "template",
    "cmd_t": "command_topic",
    "cmd_tpl": "command_template",
    "stat_t": "state_topic",
    "stat_tpl": "state_template",
    "val_tpl": "value_template",
}
_FULL_STATE = ("cmd_t", "cmd_tpl", "stat_t", "stat_tpl", "val_tpl")


def _family(short: str, full: str, suffixes: Sequence[str] = _FULL_STATE) -> dict[str, str]:
    """Abbreviations of keys that begin alike: ``bri_cmd_t`` is ``brightness_command_topic``."""
    return {f"{short}_{each}": f"{full}_{_SUFFIXES[each]}" for each in suffixes}


ABBREVIATIONS = {
    **_SUFFIXES,
    **_family("act", "action", ("t", "tpl")),
    **_family("bri", "brightness"),
    **_family("clr_temp", "color_temp"),
    **_family("curr_temp", "current_temperature", ("t", "tpl")),
    **_family("curr_hum", "current_humidity", ("t", "tpl")),
    **_family("fan_mode", "fan_mode"),
    **_family("fx", "effect"),
    **_family("hum", "target_humidity"),
    **_family("mode", "mode"),
    **_family("osc", "oscillation"),
    **_family("pct", "percentage"),
    **_family("pow", "power"),
    **_family("pr_mode", "preset_mode"),
    **_family("rgb", "rgb"),
    **_family("swing_mode", "swing_mode"),
    **_family("temp", "temperature"),
    **_family("temp_hi", "temperature_high"),
    **_family("temp_lo", "temperature_low"),
    **_family("tilt", "tilt", ("cmd_t", "cmd_tpl")),
    **_family("tilt_status", "tilt_status", ("t", "tpl")),
    **_family("pos", "position", ("t", "tpl")),
    **_family("set_pos", "set_position", ("t", "tpl")),
    **_family("avty", "availability", ("t", "tpl")),
    "avty": "availability",
    "avty_mode": "availability_mode",
    "bri_scl": "brightness_scale",
    "cmps": "components",
    "dev": "device",
    "dev_cla": "device_class",
    "fx_list": "effect_list",
    "max_hum": "max_humidity",
    "min_hum": "min_humidity",
    "o": "origin",
    "ops": "options",
    "p": "platform",
    "pl_avail": "payload_available",
    "pl_cls": "payload_close",
    "pl_lock": "payload_lock",
    "pl_not_avail": "payload_not_available",
    "pl_off": "payload_off",
    "pl_on": "payload_on",
    "pl_open": "payload_open",
    "pl_osc_off": "payload_oscillation_off",
    "pl_osc_on": "payload_oscillation_on",
    "pl_prs": "payload_press",
    "pl_stop": "payload_stop",
    "pl_unlk": "payload_unlock",
    "pos_clsd": "position_closed",
    "pr_modes": "preset_modes",
    "ret": "retain",
    "stat_cla": "state_class",
    "stat_locked": "state_locked",
    "stat_off": "state_off",
    "stat_on": "state_on",
    "stat_unlocked": "state_unlocked",
    "stat_val_tpl": "state_value_template",
    "uniq_id": "unique_id",
    "unit_of_meas": "unit_of_measurement",
}
"""Short keys of configurations, of those that are read here; all other keys are ignored."""

DEVICE_ABBREVIATIONS = {"ids": "identifiers", "cns": "connections"}


class ConfigTopic(NamedTuple):
    """The parts of a configuration's topic."""

    component: str
    node: str
    object: str


def parse_topic(topic: str, prefix: str) -> ConfigTopic | None:
    """The parts of a configuration's topic; ``None``: it is none, or that of an announced robot."""
    parts = topic.removeprefix(prefix + "/").split("/")
    if not topic.startswith(prefix + "/") or parts[-1] != "config" or len(parts) not in (3, 4):
        return None
    if parts[-2].startswith(ANNOUNCED):
        return None
    return ConfigTopic(parts[0], parts[1] if len(parts) == 4 else "", parts[-2])


def parse_config(where: ConfigTopic, payload: bytes) -> DevicePart:
    """The part of a device that a configuration describes.

    :raises Invalid: it is no configuration
    """
    if len(payload) > MAX_CONFIG:
        raise Invalid(f"a discovery message of {len(payload)} bytes is larger than {MAX_CONFIG}")
    try:
        raw = msgspec.json.decode(payload)
    except (msgspec.DecodeError, UnicodeError, RecursionError):
        raise Invalid("the discovery message is not JSON") from None
    if not isinstance(raw, dict):
        raise Invalid("the discovery message is not a JSON object")
    config = _expanded(raw)
    collected = _Collected()
    if where.component == "device":
        components = config.get("components")
        if not isinstance(components, dict) or "device" not in config:
            raise Invalid("the discovery message of a device needs 'device' and 'components'")
        if len(components) > MAX_COMPONENTS:
            raise Invalid(f"the device has {len(components)} components, more than {MAX_COMPONENTS}")
        shared = {key: value for key, value in config.items() if key != "components"}
        for key, component in components.items():
            if not isinstance(component, dict):
                collected.problem(f"component '{key[:60]}' is not a JSON object")
            elif set(component) - {"p", "platform"}:  # only a platform: the component is removed
                collected.add(key, {**shared, **_expanded(component, config.get("~"))})
    else:
        collected.add(where.object, {**config, "platform": where.component})
    key, name = _identity(config.get("device"), where)
    return DevicePart(
        key, name, collected.elements, collected.calls, collected.availability, collected.problems
    )


def _identity(device: Any, where: ConfigTopic) -> tuple[str, str]:
    """The key and name of a device; without one, an entity is a device of its own."""
    if not isinstance(device, dict):
        own = "/".join(each for each in (where.node, where.object) if each)
        return f"topic:{own}", own
    device = {DEVICE_ABBREVIATIONS.get(key, key): value for key, value in device.items()}
    found = device.get("identifiers") or device.get("connections")
    first: Any = found
    while isinstance(first, list) and first:
        # A connection is a pair: its kind, and an address.
        first = (
            first[-1]
            if len(first) == 2 and all(isinstance(each, str) for each in first) and (found is not first)
            else first[0]
        )
    if not isinstance(first, str | int) or not str(first):
        raise Invalid("the device has no 'identifiers' and no 'connections'")
    name = device.get("name")
    return f"device:{str(first)[:200]}", name[:200] if isinstance(name, str) and name else str(first)[:200]


def _expanded(raw: Mapping[str, Any], base: Any = None) -> dict[str, Any]:
    """A configuration with full keys, and ``~`` replaced by its value."""
    config = {ABBREVIATIONS.get(key, key): value for key, value in raw.items()}
    base = config.get("~", base)
    if isinstance(base, str):
        config = {key: _with_base(key, value, base) for key, value in config.items()}
    availability = config.get("availability")
    if isinstance(availability, list):
        config["availability"] = [
            _expanded(each, base) if isinstance(each, dict) else each
            for each in availability[: MAX_AVAILABILITY + 1]
        ]
    elif isinstance(availability, dict):
        config["availability"] = [_expanded(availability, base)]
    return config


def _with_base(key: str, value: Any, base: str) -> Any:
    if isinstance(value, str) and (key == "topic" or key.endswith("_topic")):
        if value.startswith("~"):
            return base + value[1:]
        if value.endswith("~"):
            return value[:-1] + base
    return value


class _Collected:
    """What the components of one message bring."""

    def __init__(self) -> None:
        self.elements: list[Element] = []
        self.calls: list[DeviceCall] = []
        self.availability: list[PartAvailability] = []
        self.problems: list[str] = []
        self._templates = TemplateParser()

    def problem(self, text: str) -> None:
        if len(self.problems) < MAX_PROBLEMS:
            self.problems.append(text)

    def add(self, key: str, config: dict[str, Any]) -> None:
        """Add one component, or say why it can't be added."""
        platform = config.get("platform")
        build = COMPONENTS.get(platform) if isinstance(platform, str) else None
        if build is None:
            self.problem(f"'{key[:60]}': the component '{str(platform)[:60]}' is not supported")
            return
        entity = EntityBuilder(slug(key), config, self.problem, self._templates.parse)
        try:
            build(entity)
            availability = entity.availability()
        except Invalid as error:
            self.problem(f"'{key[:60]}' ({platform}): {error}")
            return
        self.elements += entity.elements
        self.calls += entity.calls
        if availability not in self.availability:
            self.availability.append(availability)


class EntityBuilder:
    """Reads the keys of one component's configuration.

    :param name: of the entity, below its device
    :param problem: receives sentences about what is not understood
    :param parse: parses a template
    :ivar moves: whether its commands move something. A broker would give a retained one to the device when that comes
        back, maybe after a stop, so none is retained
    """

    moves = False

    def __init__(
        self,
        name: str,
        config: Mapping[str, Any],
        problem: Callable[[str], None],
        parse: Callable[[str], Template],
    ) -> None:
        self.name = name
        self.elements: list[Element] = []
        self.calls: list[DeviceCall] = []
        self._config = config
        self._problem = problem
        self._parse = parse

    def text(self, key: str, default: str = "") -> str:
        """The text under a key."""
        value = self._config.get(key, default)
        if value is None:
            return default
        if isinstance(value, bool):
            # YAML's on and off, when a device wrote them without quotation marks.
            return str(value)
        if not isinstance(value, str | int | float) or len(str(value)) > 4096:
            raise Invalid(f"'{key}' must be a short text")
        return str(value)

    def has(self, key: str) -> bool:
        """Whether there is a value."""
        return self._config.get(key) not in (None, "")

    def is_null(self, key: str) -> bool:
        """Whether there is a key, with ``null``."""
        return key in self._config and self._config[key] is None

    def number(self, key: str, default: float | None = None) -> float | None:
        """The number under a key."""
        value = self._config.get(key, default)
        if value is not None and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise Invalid(f"'{key}' must be a number")
        return value

    def options(self, key: str) -> list[str]:
        """The texts in the list under a key."""
        value = self._config.get(key) or []
        if not isinstance(value, list) or len(value) > MAX_OPTIONS:
            raise Invalid(f"'{key}' must be a list of at most {MAX_OPTIONS} texts")
        return [str(each)[:255] for each in value if isinstance(each, str | int | float)]

    def element(
        self,
        name: str,
        type: str,
        state: tuple[str, str] = ("", ""),
        command: tuple[str, str] = ("", ""),
        read: Callable[[str], Any] = read_text,
        write: Callable[[Any], str] = write_text,
    ) -> None:
        """Add an element, if there is a topic for its state or for its commands.

        :param name: of the element, empty for the entity itself
        :param state: keys of the topic and the template of the state
        :param command: keys of the topic and the template of commands
        """
        source = self._source(*state, read) if self.has(state[0]) else None
        setter = None
        if self.has(command[0]):
            template = self._template(command[1])
            if template is not False:
                topic = check_mqtt_topic(self._config[command[0]], command[0])
                setter = StateCommand(topic, template or None, write, self._qos(), self._retain())
        if source is not None or setter is not None:
            self.elements.append(Element(self._full(name), type, source, setter))

    def call(self, name: str, payload: str, key: str = "command_topic", stops: bool = False) -> None:
        """Add a service that sends a payload, if there is the topic."""
        if self.has(key):
            topic = check_mqtt_topic(self._config[key], key)
            self.calls.append(
                DeviceCall(
                    self._full(name), TRIGGER, topic, constant(payload), self._qos(), self._retain(), stops
                )
            )

    def switch(self, name: str, write: Callable[[Any], str], key: str = "command_topic") -> None:
        """Add a service that switches on and off, if there is the topic."""
        if self.has(key):
            topic = check_mqtt_topic(self._config[key], key)
            self.calls.append(
                DeviceCall(self._full(name), SET_BOOL, topic, write, self._qos(), self._retain())
            )

    def availability(self) -> PartAvailability:
        """The availability of the entity.

        :raises Invalid: it is not valid
        """
        listed = self._config.get("availability")
        if isinstance(listed, list):
            if len(listed) > MAX_AVAILABILITY or not all(isinstance(each, dict) for each in listed):
                raise Invalid(f"'availability' must be a list of at most {MAX_AVAILABILITY} objects")
            mode = self.text("availability_mode", "latest")
            if mode not in ("all", "any", "latest"):
                raise Invalid(f"'availability_mode' is '{mode[:20]}'; it must be all, any or latest")
            return PartAvailability(
                tuple(self._availability(each, "topic", "value_template") for each in listed), mode
            )
        if self.has("availability_topic"):
            return PartAvailability(
                (self._availability(self._config, "availability_topic", "availability_template"),)
            )
        return PartAvailability()

    def _availability(self, config: Mapping[str, Any], topic: str, template: str) -> AvailabilitySource:
        source = config.get(template)
        return AvailabilitySource(
            check_mqtt_topic(config.get(topic), topic),
            self._parse(source) if isinstance(source, str) and source else None,
            (str(config.get("payload_available", "online"))[:255],),
            (str(config.get("payload_not_available", "offline"))[:255],),
        )

    def _source(self, topic: str, template: str, read: Callable[[str], Any]) -> StateSource | None:
        parsed = self._template(template)
        if parsed is False:
            return None
        return StateSource(check_mqtt_topic(self._config[topic], topic), parsed or None, read)

    def _template(self, key: str) -> Template | Literal[False] | None:
        """The template under a key; ``None``: there is none; ``False``: it is not understood, which is reported."""
        source = self._config.get(key) if key else None
        if source in (None, ""):
            return None
        if not isinstance(source, str):
            raise Invalid(f"'{key}' must be a text")
        try:
            return self._parse(source)
        except Invalid as error:
            self._problem(f"'{self.name}', {key}: {error}")
            return False

    def _full(self, name: str) -> str:
        return f"{self.name}/{name}" if name else self.name

    def _qos(self) -> int:
        qos = self._config.get("qos", 0)
        return qos if qos in (0, 1, 2) and not isinstance(qos, bool) else 0

    def _retain(self) -> bool:
        return not self.moves and self._config.get("retain") in (True, "true", "True")


# --- components ----------------------------------------------------------------------------------------------------

_STATE = ("state_topic", "value_template")
_COMMAND = ("command_topic", "command_template")


def _sensor(entity: EntityBuilder) -> None:
    if not entity.has("state_topic"):
        raise Invalid("a sensor needs 'state_topic'")
    device_class = entity.text("device_class")
    numeric = entity.has("unit_of_measurement") or entity.has("state_class")
    if numeric and device_class not in ("timestamp", "date", "enum"):
        entity.element("", NUMBER, _STATE, read=read_number)
    else:
        entity.element("", TEXT, _STATE)


def _binary_sensor(entity: EntityBuilder) -> None:
    if not entity.has("state_topic"):
        raise Invalid("a binary_sensor needs 'state_topic'")
    entity.element(
        "", BOOL, _STATE, read=read_bool(entity.text("payload_on", "ON"), entity.text("payload_off", "OFF"))
    )


def _switch(entity: EntityBuilder) -> None:
    on, off = entity.text("payload_on", "ON"), entity.text("payload_off", "OFF")
    read = read_bool(entity.text("state_on", on), entity.text("state_off", off))
    entity.element("", BOOL, _STATE, _COMMAND, read, write_bool(on, off))
    entity.switch("switch", write_bool(on, off))


def _light(entity: EntityBuilder) -> None:
    schema = entity.text("schema", "basic")
    if schema == "json":
        _json_light(entity)
        return
    if schema not in ("basic", "default"):
        raise Invalid(f"the schema '{schema[:20]}' of lights is not supported; there are basic and json")
    on, off = entity.text("payload_on", "ON"), entity.text("payload_off", "OFF")
    entity.element(
        "",
        BOOL,
        ("state_topic", "state_value_template"),
        ("command_topic", ""),
        read_bool(on, off),
        write_bool(on, off),
    )
    entity.switch("switch", write_bool(on, off))
    scale = entity.number("brightness_scale", 255)
    _numbers(entity, "brightness", write_number(0, scale))
    _numbers(entity, "color_temp", write_number(0))
    _texts(entity, "effect", write_option(entity.options("effect_list")))
    _texts(entity, "rgb", write_text)


def _json_light(entity: EntityBuilder) -> None:
    on, off = '{"state":"ON"}', '{"state":"OFF"}'
    state, command = ("state_topic", ""), ("command_topic", "")
    entity.element(
        "", BOOL, state, command, _json_member("state", {"ON": True, "OFF": False}.get), write_bool(on, off)
    )
    entity.switch("switch", write_bool(on, off))
    if entity.has("brightness") or entity.options("supported_color_modes"):
        write = write_number(0, entity.number("brightness_scale", 255))
        entity.element(
            "brightness",
            NUMBER,
            state,
            command,
            _json_member("brightness", float),
            lambda value: f'{{"state":"ON","brightness":{write(value)}}}',
        )
    entity.element("json", TEXT, state, command, read_text, _write_json)


def _json_member(key: str, convert: Callable[[Any], Any]) -> Callable[[str], Any]:
    """A reader of a member of a JSON object; ``None`` if it is not there, and no new state."""

    def read(text: str) -> Any:
        try:
            whole = msgspec.json.decode(text)
        except (msgspec.DecodeError, RecursionError):
            raise ValueError(text) from None
        if not isinstance(whole, dict):
            raise ValueError(text)
        value = whole.get(key)
        if value is None:
            return None
        if not isinstance(value, str | int | float):
            raise ValueError(text)
        return convert(value)

    return read


def _write_json(value: Any) -> str:
    try:
        msgspec.json.decode(value)
    except (msgspec.DecodeError, UnicodeError, RecursionError):
        raise Invalid("the text is not JSON") from None
    return str(value)


def _numbers(
    entity: EntityBuilder, name: str, write: Callable[[Any], str], state: str = "state_topic"
) -> None:
    template = "value_template" if state == "state_topic" else "state_template"
    entity.element(
        name,
        NUMBER,
        (f"{name}_{state}", f"{name}_{template}"),
        (f"{name}_command_topic", f"{name}_command_template"),
        read_number,
        write,
    )


def _texts(
    entity: EntityBuilder, name: str, write: Callable[[Any], str], template: str = "value_template"
) -> None:
    entity.element(
        name,
        TEXT,
        (f"{name}_state_topic", f"{name}_{template}"),
        (f"{name}_command_topic", f"{name}_command_template"),
        write=write,
    )


def _climate(entity: EntityBuilder) -> None:
    _texts(entity, "mode", write_option(entity.options("modes")), "state_template")
    _texts(entity, "fan_mode", write_option(entity.options("fan_modes")), "state_template")
    _texts(entity, "swing_mode", write_option(entity.options("swing_modes")), "state_template")
    _texts(entity, "preset_mode", write_option(entity.options("preset_modes")))
    bounds = write_number(entity.number("min_temp"), entity.number("max_temp"))
    for name in ("temperature", "temperature_high", "temperature_low"):
        entity.element(
            name,
            NUMBER,
            (f"{name}_state_topic", f"{name}_state_template"),
            (f"{name}_command_topic", f"{name}_command_template"),
            read_number,
            bounds,
        )
    entity.element(
        "target_humidity",
        NUMBER,
        ("target_humidity_state_topic", "target_humidity_state_template"),
        ("target_humidity_command_topic", "target_humidity_command_template"),
        read_number,
        write_number(entity.number("min_humidity"), entity.number("max_humidity")),
    )
    entity.element(
        "current_temperature",
        NUMBER,
        ("current_temperature_topic", "current_temperature_template"),
        read=read_number,
    )
    entity.element(
        "current_humidity", NUMBER, ("current_humidity_topic", "current_humidity_template"), read=read_number
    )
    entity.element("action", TEXT, ("action_topic", "action_template"))
    on, off = entity.text("payload_on", "ON"), entity.text("payload_off", "OFF")
    entity.switch("power", write_bool(on, off), "power_command_topic")


def _number(entity: EntityBuilder) -> None:
    write = write_number(entity.number("min", 1), entity.number("max", 100))
    entity.element("", NUMBER, _STATE, _COMMAND, read_number, write)


def _select(entity: EntityBuilder) -> None:
    entity.element("", TEXT, _STATE, _COMMAND, write=write_option(entity.options("options")))


def _text(entity: EntityBuilder) -> None:
    most = int(entity.number("max", 255) or 255)

    def write(value: Any) -> str:
        if len(value) > most:
            raise Invalid(f"the text has {len(value)} characters, more than the device's {most}")
        return str(value)

    entity.element("", TEXT, _STATE, _COMMAND, write=write)


def _button(entity: EntityBuilder) -> None:
    entity.call("press", entity.text("payload_press", "PRESS"))


def _scene(entity: EntityBuilder) -> None:
    entity.call("press", entity.text("payload_on", "ON"))


def _cover(entity: EntityBuilder) -> None:
    entity.moves = True
    entity.element("", TEXT, _STATE)
    entity.element(
        "position",
        NUMBER,
        ("position_topic", "position_template"),
        ("set_position_topic", "set_position_template"),
        read_number,
        write_number(*_ordered(entity.number("position_closed", 0), entity.number("position_open", 100))),
    )
    entity.element(
        "tilt",
        NUMBER,
        ("tilt_status_topic", "tilt_status_template"),
        ("tilt_command_topic", "tilt_command_template"),
        read_number,
        write_number(entity.number("tilt_min", 0), entity.number("tilt_max", 100)),
    )
    for name, default in (("open", "OPEN"), ("close", "CLOSE"), ("stop", "STOP")):
        # A cover that can't be opened, closed or stopped has null.
        if not entity.is_null(f"payload_{name}"):
            entity.call(f"{name}_cover", entity.text(f"payload_{name}", default), stops=name == "stop")


def _ordered(first: float | None, second: float | None) -> tuple[float, float]:
    low, high = first or 0.0, 0.0 if second is None else second
    return min(low, high), max(low, high)


def _lock(entity: EntityBuilder) -> None:
    locked, unlocked = entity.text("state_locked", "LOCKED"), entity.text("state_unlocked", "UNLOCKED")
    entity.element("", TEXT, _STATE)
    entity.element("locked", BOOL, _STATE, read=_read_locked(locked, unlocked))
    template = entity.text("command_template")
    if template:
        raise Invalid("'command_template' of a lock is not supported")
    entity.call("lock", entity.text("payload_lock", "LOCK"))
    entity.call("unlock", entity.text("payload_unlock", "UNLOCK"))
    if entity.has("payload_open"):
        entity.call("open", entity.text("payload_open"))


def _read_locked(locked: str, unlocked: str) -> Callable[[str], bool | None]:
    """A lock that moves or is jammed has neither state."""
    return lambda text: {unlocked: False, locked: True}.get(text)


def _fan(entity: EntityBuilder) -> None:
    on, off = entity.text("payload_on", "ON"), entity.text("payload_off", "OFF")
    entity.element(
        "", BOOL, ("state_topic", "state_value_template"), _COMMAND, read_bool(on, off), write_bool(on, off)
    )
    entity.switch("switch", write_bool(on, off))
    _numbers(entity, "percentage", write_number(0, 100))
    _texts(entity, "preset_mode", write_option(entity.options("preset_modes")))


def _event(entity: EntityBuilder) -> None:
    entity.element("", TEXT, _STATE)


COMPONENTS: dict[str, Callable[[EntityBuilder], None]] = {
    "binary_sensor": _binary_sensor,
    "button": _button,
    "climate": _climate,
    "cover": _cover,
    "device_tracker": _event,
    "event": _event,
    "fan": _fan,
    "light": _light,
    "lock": _lock,
    "number": _number,
    "scene": _scene,
    "select": _select,
    "sensor": _sensor,
    "switch": _switch,
    "text": _text,
}
