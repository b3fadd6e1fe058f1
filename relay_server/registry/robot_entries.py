"""What robots have, as entries of the directory: nobody registers it, and it is judged where its resources are."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fnmatch import fnmatchcase
from itertools import product
from typing import Any, NamedTuple

import msgspec

from relay_db.queries import EntryCursor, RobotRecord
from relay_protocol.link import Service, Topic
from relay_protocol.rights import Operation, Rules
from relay_server.channels.channels import Channels
from relay_server.registry.entries import OWN, EntryQuery, RegistryEntry
from relay_server.registry.limits import FIRST_LOOK, LOOKED_AT
from relay_server.relay_node.view import VisibleGraph, seen
from relay_server.resources.location import ResourceLocation
from relay_server.robots.graph import OwnEndpoints
from relay_server.robots.registry import RobotRegistry, RobotState

_GRAPH = {"action": "actions", "service": "services", "topic": "topics"}
"""The collections of SPEC section 1.13, by the kind of what is in them."""


class VisibleRobot(NamedTuple):
    """A robot, and what somebody may do there."""

    record: RobotRecord
    rules: Rules


class RobotEntries:
    """Tells what robots have."""

    def __init__(self, registry: RobotRegistry, channels: Channels) -> None:
        self._registry = registry
        self._channels = channels

    def look(self, robots: Iterable[VisibleRobot], ask: EntryQuery) -> RobotEntryPage:
        """Look through what these robots have.

        :param robots: those that are wanted and may be seen
        """
        return RobotEntryPage(self, sorted(robots, key=lambda each: each.record.name), ask)

    def one(self, robots: Iterable[VisibleRobot], entry_id: str) -> RegistryEntry | None:
        """The one of this id."""
        kind, _, rest = entry_id.partition(":")
        name, _, what = rest.partition(":")
        for each in robots:
            if each.record.name == name and kind in OWN:
                member = name if kind == "robot" else what
                members = self.of(each, kind)
                return self.entry(each.record, kind, member, members[member]) if member in members else None
        return None

    def of(self, robot: VisibleRobot, kind: str) -> dict[str, Any]:
        """All that a robot has of one kind, as far as it may be seen, by name and in order."""
        record, rules = robot
        there = self._registry.find(record.id) or RobotState(record.id, record.name, record.realm)
        if kind == "robot":
            return {record.name: there}
        if kind == "camera":
            cameras = sorted(there.cameras, key=lambda each: each.name)
            return {each.name: each for each in cameras if rules.judge(Operation.VIEW, each.name).allowed}
        channel = self._channels.find(there)
        view: VisibleGraph = seen(there, OwnEndpoints() if channel is None else channel.ends(), rules)
        if kind == "module":
            return dict.fromkeys(view.nodes)
        members: dict[str, Any] = getattr(view, _GRAPH[kind])
        return members

    @staticmethod
    def entry(record: RobotRecord, kind: str, name: str, there: Any) -> RegistryEntry:
        """Something that a robot has.

        :param there: what :meth:`of` says of it
        """
        place = ResourceLocation("", record.name)
        if kind == "robot":
            data = {"state": there.state.value, "params": place.of("params")}
            return _entry(f"robot:{name}", kind, name, record, place.address, data, record.description)
        id = f"{kind}:{record.name}:{name}"
        if kind == "camera":
            return _entry(id, kind, name, record, place.of("cameras", name), {"type": there.type})
        if kind == "module":
            return _entry(id, kind, name, record, place.of("modules", name), {})
        ends: Topic | Service = there
        return _entry(id, kind, name, record, place.of(_GRAPH[kind], name), {"types": ends.types})


class RobotEntryPage:
    """What is found, in the order of places.

    :ivar stopped: where it was looked no further, if it was not looked through all
    """

    def __init__(self, robots: RobotEntries, chosen: list[VisibleRobot], ask: EntryQuery) -> None:
        self._robots = robots
        self._chosen = chosen
        self._ask = ask
        self.stopped: EntryCursor | None = None

    def __iter__(self) -> Iterator[RegistryEntry]:
        after = self._ask.after or EntryCursor("", "", "", "")
        kinds = [kind for kind in OWN if self._ask.kind in (None, kind)]
        looked = 0
        for robot, kind in product(self._chosen, kinds):
            name = robot.record.name
            if (name, kind) < (after.robot, after.kind):
                continue
            if looked >= LOOKED_AT:
                self.stopped = EntryCursor(name, kind, "", "")
                return
            looked += FIRST_LOOK
            begun = after.name if (name, kind) == (after.robot, after.kind) else ""
            for member, there in self._robots.of(robot, kind).items():
                if member < begun:
                    continue
                if looked >= LOOKED_AT:
                    self.stopped = EntryCursor(name, kind, member, "")
                    return
                looked += 1
                if fnmatchcase(member, self._ask.name):
                    entry = self._robots.entry(robot.record, kind, member, there)
                    if entry.place > after:
                        yield entry


def _entry(
    id: str,
    kind: str,
    name: str,
    record: RobotRecord,
    address: str,
    data: dict[str, Any],
    description: str = "",
) -> RegistryEntry:
    return RegistryEntry(id, kind, name, record.name, address, description, msgspec.json.encode(data))
