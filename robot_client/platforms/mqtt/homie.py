"""Homie 4 and 5: from attributes on the broker to the parts of devices (https://homieiot.github.io)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import msgspec

from relay_protocol.errors import Invalid
from robot_client.platforms.mqtt.messages import BOOL, NUMBER, TEXT
from robot_client.platforms.mqtt.model import (
    ANNOUNCED,
    AvailabilitySource,
    DevicePart,
    Element,
    PartAvailability,
    StateCommand,
    StateSource,
    read_bool,
    read_number,
    read_text,
    slug,
    write_bool,
    write_number,
    write_option,
    write_text,
)

MAX_DESCRIPTION = 256 * 1024
"""Bytes of a description (Homie 5)."""

MAX_ATTRIBUTE = 4096
"""Bytes of one attribute (Homie 4)."""

MAX_PROPERTIES = 200
MAX_PROBLEMS = 20
MAX_DEVICES = 2000
"""Devices whose attributes are kept, also of those that are not complete."""

MAX_ATTRIBUTES = 1500
"""Attributes of one device (Homie 4)."""

HOMIE_QOS = 1
"""Quality of service of commands, as the convention recommends."""

MAX_BYTES = 32 * 1024 * 1024
"""Of the attributes of all devices."""

_ID = re.compile(r"[a-z0-9][a-z0-9-]*\Z")
_ANNOUNCED = ANNOUNCED.replace("_", "-")
_AVAILABLE = ("ready", "sleeping", "alert")
_NOT_AVAILABLE = ("init", "disconnected", "lost", "")


def subscriptions(domain: str) -> list[str]:
    """The topics on which devices describe themselves."""
    version_4 = [
        *(f"{domain}/+/{each}" for each in ("$homie", "$name", "$state", "$nodes")),
        f"{domain}/+/+/$properties",
        *(f"{domain}/+/+/+/{each}" for each in ("$datatype", "$format", "$settable")),
    ]
    return [*version_4, f"{domain}/5/+/$description", f"{domain}/5/+/$state"]


class HomieDevices:
    """Collects attributes, and builds devices that are complete.

    :param domain: first level of the topics
    """

    def __init__(self, domain: str) -> None:
        self.domain = domain
        self._attributes: dict[str, dict[str, str]] = {}
        self._changed: set[str] = set()
        self._bytes = 0

    def handle(self, topic: str, payload: bytes) -> bool:
        """Take an attribute; return whether the topic is one.

        :raises Invalid: it can't be used
        """
        parts = topic.split("/")
        if parts[0] != self.domain or len(parts) < 3 or not parts[-1].startswith("$"):
            return False
        if parts[1].startswith(_ANNOUNCED):
            return True
        if len(parts) == 4 and parts[1] == "5":
            self._set(f"5/{parts[2]}", parts[3], payload, MAX_DESCRIPTION)
        elif parts[1] != "5":
            self._set(parts[1], "/".join(parts[2:]), payload, MAX_ATTRIBUTE)
        return True

    def _set(self, device: str, attribute: str, payload: bytes, most: int) -> None:
        if not _ID.match(device.removeprefix("5/")):
            raise Invalid(f"the Homie device '{device[:60]}' has an id that is not valid")
        if len(payload) > most:
            raise Invalid(f"an attribute of {len(payload)} bytes is larger than {most}")
        if not payload:
            if attribute in ("$homie", "$state", "$description"):
                gone = self._attributes.pop(device, {})
                self._bytes -= sum(map(_bytes, gone.values()))
                self._changed.add(device)
            return
        known = self._attributes.get(device)
        if known is None:
            if len(self._attributes) >= MAX_DEVICES:
                raise Invalid(f"there are {MAX_DEVICES} Homie devices; '{device[:60]}' is left out")
            known = self._attributes[device] = {}
        if attribute not in known and len(known) >= MAX_ATTRIBUTES:
            raise Invalid(f"the Homie device '{device[:60]}' has more than {MAX_ATTRIBUTES} attributes")
        text = payload.decode("utf-8", "replace")
        if known.get(attribute) == text:
            return
        more = _bytes(text) - _bytes(known.get(attribute, ""))
        if self._bytes + more > MAX_BYTES:
            raise Invalid(
                f"Homie devices have more than {MAX_BYTES >> 20} MiB of attributes; '{device[:60]}' is too much"
            )
        self._bytes += more
        known[attribute] = text
        # A change of the state alone is a matter of availability.
        if attribute != "$state" or text in _AVAILABLE:
            self._changed.add(device)

    @property
    def has_changed(self) -> bool:
        """Whether :meth:`take_changed` has something to return."""
        return bool(self._changed)

    def take_changed(self, most: int | None = None) -> list[tuple[str, DevicePart | None]]:
        """Devices that changed since the last call, each with the topic it is known by; ``None``: it is gone.

        Devices that are not complete yet are left out.

        :param most: that are looked at; the others come with the next call
        """
        found: list[tuple[str, DevicePart | None]] = []
        changed = sorted(self._changed)[:most]
        self._changed.difference_update(changed)
        for device in changed:
            source = f"{self.domain}/{device}"
            attributes = self._attributes.get(device)
            if attributes is None:
                found.append((source, None))
            else:
                build = _device_5 if device.startswith("5/") else _device_4
                part = build(source, attributes)
                if part is not None:
                    found.append((source, part))
        return found


def _bytes(text: str) -> int:
    """Bytes that a text needs at least."""
    return len(text) if text.isascii() else len(text.encode())


def _device_4(source: str, attributes: Mapping[str, str]) -> DevicePart | None:
    nodes = attributes.get("$nodes")
    if nodes is None or "$homie" not in attributes or "$state" not in attributes:
        return None
    return _part(source, attributes.get("$name", source), _properties_4(nodes, attributes))


def _properties_4(nodes: str, attributes: Mapping[str, str]) -> Iterator[_Property]:
    """The properties of a device that speaks Homie 4. An id that is listed several times counts once."""
    for node in dict.fromkeys(nodes.split(",")):
        for property in dict.fromkeys(attributes.get(f"{node}/$properties", "").split(",")):
            path = f"{node}/{property}"
            if not property:
                continue
            described = {
                each: attributes.get(f"{path}/${each}", "") for each in ("datatype", "format", "settable")
            }
            yield path, {**described, "settable": described["settable"] == "true"}


def _device_5(source: str, attributes: Mapping[str, str]) -> DevicePart | None:
    text = attributes.get("$description")
    if text is None or "$state" not in attributes:
        return None
    try:
        described = msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError):
        return _part(source, source, (), "the description is not JSON")
    if not isinstance(described, dict):
        return _part(source, source, (), "the description is not a JSON object")
    name = described.get("name")
    return _part(source, name if isinstance(name, str) and name else source, _properties_5(described))


def _properties_5(described: Mapping[str, Any]) -> Iterator[_Property]:
    for node_id, node in _members(described, "nodes"):
        for property_id, property in _members(node, "properties"):
            yield f"{node_id}/{property_id}", property


def _members(whole: Mapping[str, Any], key: str) -> list[tuple[str, dict[str, Any]]]:
    members = whole.get(key)
    if not isinstance(members, dict):
        return []
    return [(name, each) for name, each in members.items() if isinstance(each, dict)]


_Property = tuple[str, Mapping[str, Any]]
"""Node and property, and how it is described."""


def _part(source: str, name: str, properties: Iterable[_Property], *problems: str) -> DevicePart:
    """A device with its first :data:`MAX_PROPERTIES` properties, and problems about those that can't be used."""
    elements: list[Element] = []
    found = list(problems)
    for number, (path, described) in enumerate(properties):
        if number == MAX_PROPERTIES:
            found.insert(0, f"there are more than {MAX_PROPERTIES} properties; the others are left out")
            break
        _add(source, path, described, elements, found)
    state = AvailabilitySource(f"{source}/$state", None, _AVAILABLE, _NOT_AVAILABLE)
    availability = [PartAvailability((state,))]
    return DevicePart(f"homie:{source}", name[:200], elements, (), availability, found[:MAX_PROBLEMS])


def _add(
    source: str, path: str, described: Mapping[str, Any], elements: list[Element], problems: list[str]
) -> None:
    """Add the element of one property, or say why it is left out.

    :param path: node and property
    """
    if not all(_ID.match(each) for each in path.split("/")):
        problems.append(f"'{path[:80]}' has an id that is not valid")
        return
    datatype = str(described.get("datatype") or "string")
    format = described.get("format")
    build = _DATATYPES.get(datatype)
    if build is None:
        problems.append(f"'{path[:80]}': the datatype '{datatype[:20]}' is not supported")
        return
    try:
        type, read, write = build(format if isinstance(format, str) else "")
    except ValueError:
        problems.append(f"'{path[:80]}': the format '{str(format)[:60]}' can't be read")
        return
    topic = f"{source}/{path}"
    command = (
        StateCommand(f"{topic}/set", None, write, HOMIE_QOS) if described.get("settable") is True else None
    )
    name = "/".join(slug(each) for each in path.split("/"))
    elements.append(Element(name, type, StateSource(topic, None, read), command))


_Forms = tuple[str, Callable[[str], Any], Callable[[Any], str]]


def _number_format(format: str) -> _Forms:
    bounds = format.split(":") if format else []
    low, high = ((*bounds, "", "")[:2]) if len(bounds) > 1 else ("", "")
    return NUMBER, read_number, write_number(float(low) if low else None, float(high) if high else None)


def _boolean_format(_: str) -> _Forms:
    return BOOL, read_bool("true", "false"), write_bool("true", "false")


def _enum_format(format: str) -> _Forms:
    return TEXT, read_text, write_option([each.strip() for each in format.split(",") if each.strip()])


def _text_format(_: str) -> _Forms:
    return TEXT, read_text, write_text


_DATATYPES: dict[str, Callable[[str], _Forms]] = {
    "boolean": _boolean_format,
    "color": _text_format,
    "datetime": _text_format,
    "duration": _text_format,
    "enum": _enum_format,
    "float": _number_format,
    "integer": _number_format,
    "json": _text_format,
    "percent": _number_format,
    "string": _text_format,
}
