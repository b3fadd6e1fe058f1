"""The devices: from the parts that discovery brings to named topics, services and the topics to subscribe."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

import msgspec
from twisted.logger import Logger

from relay_protocol.errors import Invalid
from robot_client.platforms.mqtt.model import DeviceCall, DevicePart, Element, PartAvailability, slug

MAX_DEVICES = 1000
MAX_DEVICE_ITEMS = 400
"""Elements and services of one device, and sources of its availability."""

MAX_ITEMS = 20_000
"""Elements and services of all devices."""

MAX_NAMES = 10_000
"""Names that are kept, also of devices that are gone."""

MAX_PROBLEMS = 100
"""Problems that are kept for people."""

GATEWAY = "gateway"
"""The name under which the gateway's own topics are; no device gets it."""


class DeviceNames:
    """The name of each device, kept in a file: a device never gets the name of another one, present or gone.

    Rights are patterns of names, so a name that moved to another device would move rights with it.

    :param path: JSON file; ``None`` to keep nothing
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._names: dict[str, str] = {}
        if path is not None and path.exists():
            try:
                self._names = msgspec.json.decode(path.read_bytes(), type=dict[str, str])
            except (OSError, msgspec.DecodeError) as error:
                raise Invalid(f"the names of devices in {path} can't be read: {error}") from None
        self._used = {GATEWAY, *self._names.values()}
        self._changed = False

    def name(self, key: str, wanted: str) -> str:
        """The name of a device; a new one gets it now.

        :param key: identifies the device
        :param wanted: its name for people
        :raises Invalid: there are too many names
        """
        known = self._names.get(key)
        if known is not None:
            return known
        if len(self._names) >= MAX_NAMES:
            raise Invalid(f"{MAX_NAMES} devices have had names; remove those that are gone from {self._path}")
        base = name = slug(wanted)
        number = 2
        while name in self._used:
            name = f"{base}_{number}"
            number += 1
        self._names[key] = name
        self._used.add(name)
        self._changed = True
        return name

    def known(self, key: str) -> str | None:
        """The name of a device that has one."""
        return self._names.get(key)

    def save(self) -> None:
        """Write new names to the file.

        :raises OSError: they can't be written; the next call tries again
        """
        if not self._changed or self._path is None:
            return
        temporary = self._path.with_suffix(".new")
        with temporary.open("wb") as file:
            file.write(msgspec.json.encode(self._names))
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(self._path)
        self._changed = False


class MqttDevice(NamedTuple):
    """A device as the relay sees it.

    :param elements: by the full name of the topic
    :param calls: by the full name of the service
    """

    name: str
    title: str
    elements: Mapping[str, Element]
    calls: Mapping[str, DeviceCall]
    availability: tuple[PartAvailability, ...]

    @property
    def available_topic(self) -> str:
        """Its topic that says whether it is there."""
        return f"/{self.name}/available"

    def mqtt_topics(self) -> set[str]:
        """The MQTT topics of its states and of its availability."""
        states = {each.source.topic for each in self.elements.values() if each.source is not None}
        return states | {source.topic for each in self.availability for source in each.sources}


class DeviceChanges(NamedTuple):
    """What :meth:`DeviceRegistry.flush` changed: devices by name; ``None``: removed."""

    devices: dict[str, MqttDevice | None]


class ProblemList:
    """Sentences for people, by what they are about, the newest last."""

    def __init__(self) -> None:
        self._texts: dict[str, list[str]] = {}
        self.changed = False
        self.left_out = 0
        self._log = Logger("mqtt")

    def set(self, about: str, texts: Iterable[str]) -> None:
        """Replace the problems of one source."""
        found = [each[:500] for each in texts]
        if self._texts.get(about, []) == found:
            return
        self.changed = True
        if not found:
            del self._texts[about]
        elif about in self._texts or len(self._texts) < MAX_PROBLEMS:
            self._texts[about] = found
            for text in found:
                self._log.warn("{about}: {text}", about=about[:200], text=text, limited="problem")
        else:
            self.left_out += 1

    def json(self) -> str:
        """All as JSON: ``problems``, a list of ``about`` and ``text``, and how many were ``left_out``."""
        self.changed = False
        problems = [
            {"about": about[:200], "text": each} for about, texts in self._texts.items() for each in texts
        ]
        return msgspec.json.encode({"problems": problems[:MAX_PROBLEMS], "left_out": self.left_out}).decode()


class DeviceRegistry:
    """All devices.

    :param patterns: names of devices that take part, with ``*`` and ``?``
    """

    def __init__(self, names: DeviceNames, problems: ProblemList, patterns: Iterable[str] = ("*",)) -> None:
        self.devices: dict[str, MqttDevice] = {}
        self._names = names
        self._problems = problems
        self._patterns = tuple(patterns)
        self._parts: dict[str, dict[str, DevicePart]] = {}
        """By key of a device, by source."""
        self._keys: dict[str, str] = {}
        """Key of the device by source."""
        self._changed: dict[str, None] = {}
        self._count = 0
        """Elements and services in all parts."""

    def set_part(self, source: str, part: DevicePart | None) -> None:
        """Replace what one source says.

        :param source: the topic of the discovery message
        :param part: ``None``: nothing more
        :raises Invalid: there are too many devices
        """
        before = self._keys.get(source)
        if before is not None and (part is None or part.key != before):
            self._remove(source, before)
        if part is None:
            return
        if part.key not in self._parts and len(self._parts) >= MAX_DEVICES:
            raise Invalid(
                f"there are {MAX_DEVICES} devices, the most there may be; '{part.name[:60]}' is left out"
            )
        try:
            self._check_size(source, part)
        except Invalid:
            if source in self._keys:
                self._remove(source, part.key)
            raise
        of_device = self._parts.setdefault(part.key, {})
        self._count += _size(part) - (_size(of_device[source]) if source in of_device else 0)
        of_device[source] = part
        self._keys[source] = part.key
        self._changed[part.key] = None

    def _check_size(self, source: str, part: DevicePart) -> None:
        """Before it is kept, so that what is kept, and the work with it, has limits.

        :raises Invalid: its device, or all, would have too much
        """
        of_device = self._parts.get(part.key, {})
        name, old = part.name[:60], _size(of_device[source]) if source in of_device else 0
        if source not in of_device and len(of_device) >= MAX_DEVICE_ITEMS:
            raise Invalid(f"'{name}' has more than {MAX_DEVICE_ITEMS} discovery messages")
        if sum(map(_size, of_device.values())) - old + _size(part) > MAX_DEVICE_ITEMS:
            raise Invalid(
                f"'{name}' has more than {MAX_DEVICE_ITEMS} elements and services; those of {source} are left out"
            )
        if self._count - old + _size(part) > MAX_ITEMS:
            raise Invalid(
                f"all devices have more than {MAX_ITEMS} elements and services; '{name}' is left out"
            )

    def _remove(self, source: str, key: str) -> None:
        del self._keys[source]
        self._count -= _size(self._parts[key].pop(source))
        if not self._parts[key]:
            del self._parts[key]
        self._changed[key] = None

    @property
    def has_changed(self) -> bool:
        """Whether :meth:`flush` has something to build."""
        return bool(self._changed)

    def flush(self, most: int | None = None) -> DeviceChanges:
        """Build the devices that changed.

        :param most: that are built; the others are built by the next call
        """
        changed = list(self._changed)[:most]
        for key in changed:
            del self._changed[key]
        found: dict[str, MqttDevice | None] = {}
        for key in changed:
            try:
                self._flush_device(key, self._parts.get(key), found)
                self._problems.set(f"device {key}", [])
            except Invalid as error:
                self._problems.set(f"device {key}", [str(error)])
        if found:
            self._save_names()
        return DeviceChanges(found)

    def _save_names(self) -> None:
        try:
            self._names.save()
        except OSError as error:
            text = f"the names of devices can't be kept for the next start: {error.strerror}"
            self._problems.set("names", [text])
        else:
            self._problems.set("names", [])

    def _flush_device(
        self, key: str, parts: Mapping[str, DevicePart] | None, found: dict[str, MqttDevice | None]
    ) -> None:
        if parts is None:
            name = self._names.known(key)
            if name is not None:
                self._replace(name, None, found)
            return
        name = self._names.name(key, next(iter(parts.values())).name)
        if any(fnmatchcase(name, each) for each in self._patterns):
            try:
                device = self._build(name, parts)
            except Invalid:
                self._replace(name, None, found)
                raise
            self._replace(name, device, found)

    def _replace(self, name: str, device: MqttDevice | None, found: dict[str, MqttDevice | None]) -> None:
        before = self.devices.pop(name, None)
        if device is not None:
            self.devices[name] = device
        if before is not None or device is not None:
            found[name] = device

    def _build(self, name: str, parts: Mapping[str, DevicePart]) -> MqttDevice:
        ordered = [parts[each] for each in sorted(parts)]
        used = {f"/{name}/available"}
        elements: dict[str, Element] = {}
        calls: dict[str, DeviceCall] = {}
        for part in ordered:
            for element in part.elements:
                elements[_free(used, name, element.name)] = element
            for call in part.calls:
                calls[_free(used, name, call.name)] = call
        availability = tuple(dict.fromkeys(each for part in ordered for each in _hashable(part.availability)))
        if len({source for part in availability for source in part.sources}) > MAX_DEVICE_ITEMS:
            raise Invalid(
                f"'{name}' has more than {MAX_DEVICE_ITEMS} sources of its availability, and is left out"
            )
        return MqttDevice(name, ordered[0].name, elements, calls, availability)


def _size(part: DevicePart) -> int:
    return len(part.elements) + len(part.calls)


def _hashable(availability: Iterable[PartAvailability]) -> list[PartAvailability]:
    return [PartAvailability(tuple(each.sources), each.mode) for each in availability]


def _free(used: set[str], device: str, name: str) -> str:
    """A name that is not used yet, and is used now.

    The entity gets a number, and not its part: what moves the robot is known by the end of the name.
    """
    entity, slash, part = name.partition("/")
    free, number = f"/{device}/{name}", 2
    while free in used:
        free = f"/{device}/{entity}_{number}{slash}{part}"
        number += 1
    used.add(free)
    return free
