"""What a device has, however it was discovered: elements with a state and a command, calls, availability.

An element is a topic of the gateway, ``/<device>/<element>``. If it can be set, the topic
``/<device>/<element>/set`` takes commands.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from relay_protocol.errors import Invalid
from robot_client.platforms.mqtt.templates import Template, value_variables

MAX_STATE = 64 * 1024
"""Bytes of a state's payload."""

MAX_SLUG = 60
"""Characters of each part of a topic's name."""

ANNOUNCED = "switchboard_"
"""Begins the ids of robots that ``--announce`` puts on the broker. They are no devices: announced robots would become
devices of a robot, and those be announced again."""

MAX_MQTT_TOPIC = 1024
"""Bytes of a topic on the broker."""

_NOT_NAME = re.compile(r"[^a-z0-9_]+")


def slug(text: str) -> str:
    """A part of a topic's name made of any text; texts that give none, or are too long, get one by their hash."""
    name = _NOT_NAME.sub("_", text.lower()).strip("_")
    name = re.sub("_+", "_", name)
    if not name or len(name) > MAX_SLUG:
        digest = hashlib.sha256(text.encode("utf-8", "replace")).hexdigest()[:8]
        name = f"{name[: MAX_SLUG - 9]}_{digest}" if name else f"x_{digest}"
    return name if name[0].isalpha() else "n" + name if name[0] == "_" else "n_" + name


def check_mqtt_topic(topic: Any, what: str) -> str:
    """A topic that can be subscribed and published.

    :param what: the key it stands under, for the error
    :raises Invalid: it is no text, empty, too long, or has wildcards
    """
    if not isinstance(topic, str) or not topic:
        raise Invalid(f"'{what}' must be a topic")
    if len(topic.encode("utf-8", "replace")) > MAX_MQTT_TOPIC:
        raise Invalid(f"'{what}' is longer than {MAX_MQTT_TOPIC} bytes")
    if any(each in topic for each in "+#\0") or topic.startswith("$") or not topic.isprintable():
        raise Invalid(f"'{what}' is '{topic[:80]}', which is not the name of one topic")
    return topic


class StateSource(NamedTuple):
    """The MQTT topic of a state.

    :param read: value of a text; raises :class:`ValueError` where it can't be read. ``None``: no new state
    """

    topic: str
    template: Template | None
    read: Callable[[str], Any]

    def value(self, payload: bytes) -> Any:
        """The value in a payload; ``None``: it holds none.

        :raises Invalid: the payload can't be read
        """
        if len(payload) > MAX_STATE:
            raise Invalid(f"a state of {len(payload)} bytes is larger than {MAX_STATE}")
        try:
            text = payload.decode()
        except UnicodeDecodeError:
            raise Invalid("the state is not a text in UTF-8") from None
        if self.template is not None:
            text = self.template.render(value_variables(text))
        try:
            return self.read(text)
        except ValueError:
            raise Invalid(f"the state {text[:60]!r} can't be read") from None


class StateCommand(NamedTuple):
    """How an element is set.

    :param write: text of a value; raises :class:`Invalid` for one that the device does not take
    """

    topic: str
    template: Template | None
    write: Callable[[Any], str]
    qos: int = 0
    retain: bool = False

    def payload(self, value: Any) -> str:
        """The payload for a value.

        :raises Invalid: the device does not take it
        """
        text = self.write(value)
        if self.template is None:
            return text
        return self.template.render({"value": _plain_number(text)})


class Element(NamedTuple):
    """A state, a command, or both.

    :param name: below the device's, with ``/`` between parts
    :param type: :data:`BOOL`, :data:`NUMBER` or :data:`TEXT`
    """

    name: str
    type: str
    source: StateSource | None = None
    command: StateCommand | None = None


class DeviceCall(NamedTuple):
    """A service of a device.

    :param type: :data:`TRIGGER`, or :data:`SET_BOOL` with a payload for each value
    :param stops: whether a stop of the gateway calls it
    """

    name: str
    type: str
    topic: str
    payload: Callable[[Any], str]
    qos: int = 0
    retain: bool = False
    stops: bool = False


class AvailabilitySource(NamedTuple):
    """One topic that says whether a device is there."""

    topic: str
    template: Template | None
    available: Sequence[str]
    not_available: Sequence[str]

    def value(self, payload: bytes) -> bool | None:
        """``None``: none of the payloads."""
        text = payload[:MAX_STATE].decode("utf-8", "replace")
        if self.template is not None:
            text = self.template.render(value_variables(text))
        return True if text in self.available else False if text in self.not_available else None


class PartAvailability(NamedTuple):
    """Whether a part of a device is there, by all, any, or the latest of its topics."""

    sources: Sequence[AvailabilitySource] = ()
    mode: str = "latest"


class DevicePart(NamedTuple):
    """What one discovery message brings to a device.

    :param key: identifies the device
    :param name: of the device, for people
    :param problems: sentences about what is not understood
    """

    key: str
    name: str
    elements: Sequence[Element] = ()
    calls: Sequence[DeviceCall] = ()
    availability: Sequence[PartAvailability] = ()
    problems: Sequence[str] = ()


# --- reading and writing values --------------------------------------------------------------------------------


def read_number(text: str) -> float:
    """A number.

    :raises ValueError: none
    """
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def read_text(text: str) -> str:
    """The text itself."""
    return text


def read_bool(on: str, off: str) -> Callable[[str], bool]:
    """A reader of two payloads.

    :param on: the payload that means true
    """

    def read(text: str) -> bool:
        if text == on:
            return True
        if text == off:
            return False
        raise ValueError(text)

    return read


def write_bool(on: str, off: str) -> Callable[[Any], str]:
    """A writer of two payloads."""
    return lambda value: on if value else off


def write_text(value: Any) -> str:
    """The text itself."""
    return str(value)


def write_number(least: float | None = None, most: float | None = None) -> Callable[[Any], str]:
    """A writer of numbers within bounds, which does not write a fraction without need."""

    def write(value: Any) -> str:
        if not math.isfinite(value):
            raise Invalid("the number must be finite")
        if (least is not None and value < least) or (most is not None and value > most):
            raise Invalid(
                f"{value:g} is outside of {least:g} to {most:g}"
                if None not in (least, most)
                else f"{value:g} is outside of what the device takes"
            )
        return str(int(value)) if float(value).is_integer() and abs(value) < 1e15 else repr(float(value))

    return write


def write_option(options: Sequence[str]) -> Callable[[Any], str]:
    """A writer of one of several texts; any text if there are no options."""

    def write(value: Any) -> str:
        if options and value not in options:
            raise Invalid(f"{str(value)[:60]!r} is not one of {', '.join(options)[:500]}")
        return str(value)

    return write


def constant(payload: str) -> Callable[[Any], str]:
    """A writer of always the same payload."""
    return lambda _: payload


def _plain_number(text: str) -> Any:
    """Command templates compute with numbers, as in Home Assistant."""
    try:
        number = float(text)
    except ValueError:
        return text
    if not math.isfinite(number) or not re.fullmatch(r"-?[0-9.]+(e-?[0-9]+)?", text):
        return text
    return int(number) if re.fullmatch(r"-?[0-9]{1,15}", text) else number
