"""A device while it runs: which of its elements a message concerns, and whether it is there."""

from __future__ import annotations

from collections import defaultdict

from robot_client.platforms.mqtt.devices import MqttDevice
from robot_client.platforms.mqtt.model import AvailabilitySource, Element, PartAvailability


class NamedElement:
    """An element with the full name of its topic."""

    __slots__ = ("element", "topic")

    def __init__(self, topic: str, element: Element) -> None:
        self.topic = topic
        self.element = element


class LiveDevice:
    """The elements of a device by MQTT topic, and its availability.

    :param device: as discovered
    """

    def __init__(self, device: MqttDevice) -> None:
        self.device = device
        self.elements: dict[str, list[NamedElement]] = defaultdict(list)
        for topic, element in device.elements.items():
            if element.source is not None:
                self.elements[element.source.topic].append(NamedElement(topic, element))
        self._sources: dict[str, dict[AvailabilitySource, None]] = defaultdict(dict)
        # Parts that say nothing follow those that do.
        self._parts = [each for each in device.availability if each.sources]
        for part in self._parts:
            for source in part.sources:
                self._sources[source.topic][source] = None
        self._values: dict[AvailabilitySource, tuple[int, bool]] = {}
        """Each with its number; the newest has the largest."""
        self._received = 0

    @property
    def available(self) -> bool:
        """Whether any part of the device is there; a device that never said so is there if it has no such topics."""
        return not self._parts or any(self._part_available(each) for each in self._parts)

    def availability_message(self, topic: str, payload: bytes) -> bool:
        """Take a message; whether the topic is about availability.

        :raises Invalid: it can't be read
        """
        for source in self._sources.get(topic, ()):
            value = source.value(payload)
            if value is not None:
                self._received += 1
                self._values[source] = self._received, value
        return topic in self._sources

    def forget_availability(self) -> None:
        """Forget what was said: a broker that restarts may not know the device yet."""
        self._values.clear()

    def _part_available(self, part: PartAvailability) -> bool:
        values = [self._values[each] for each in part.sources if each in self._values]
        if part.mode == "all":
            return len(values) == len(part.sources) and all(value for _, value in values)
        if part.mode == "any":
            return any(value for _, value in values)
        return max(values)[1] if values else False
