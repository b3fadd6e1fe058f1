"""Resources of robots as entries of the registry: read from their graphs by the reader's rights, never registered."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fnmatch import fnmatchcase
from itertools import product
from typing import Any, NamedTuple

import msgspec

from relay_db.queries import EntryCursor, RobotRecord
from relay_protocol.link import Service, Topic
from relay_protocol.rights import Operation, Rules
from relay_server.channels.channel import Channels
from relay_server.relay_node.visible_graph import VisibleGraph, graph_by_rules
from relay_server.resources.states import ResourceLocation
from relay_server.robots.registry import OwnEndpoints, RobotRegistry, RobotState
from relay_server.service_registry.entries import MAX_SCANNED, ROBOT_KINDS, SCAN_COST, EntryInfo, EntryQuery

_GRAPH = {"action": "actions", "service": "services", "topic": "topics"}
"""The collections of SPEC 1.13, by the kind of their members."""


class VisibleRobot(NamedTuple):
    """A robot and the reader's rights on it."""

    record: RobotRecord
    rules: Rules


class RobotEntries:
    """Finds entries of robots' resources."""

    def __init__(self, registry: RobotRegistry, channels: Channels) -> None:
        self._registry = registry
        self._channels = channels

    def search(self, robots: Iterable[VisibleRobot], query: EntryQuery) -> RobotEntryPage:
        """Entries of robots.

        :param robots: those that match and that the reader may see
        """
        return RobotEntryPage(self, sorted(robots, key=lambda each: each.record.name), query)

    def find(self, robots: Iterable[VisibleRobot], entry_id: str) -> EntryInfo | None:
        """The entry of this id."""
        kind, _, rest = entry_id.partition(":")
        name, _, what = rest.partition(":")
        for each in robots:
            if each.record.name == name and kind in ROBOT_KINDS:
                member = name if kind == "robot" else what
                members = self.members(each, kind)
                return self.entry(each.record, kind, member, members[member]) if member in members else None
        return None

    def members(self, robot: VisibleRobot, kind: str) -> dict[str, Any]:
        """All of one kind that a robot has and the reader may see, by name, sorted."""
        record, rules = robot
        there = self._registry.find(record.id) or RobotState(record.id, record.name, record.realm)
        if kind == "robot":
            return {record.name: there}
        if kind == "camera":
            cameras = sorted(there.cameras, key=lambda each: each.name)
            return {each.name: each for each in cameras if rules.decide(Operation.VIEW, each.name).allowed}
        channel = self._channels.find(there)
        visible: VisibleGraph = graph_by_rules(
            there, OwnEndpoints() if channel is None else channel.own_endpoints(), rules
        )
        if kind == "node":
            return dict.fromkeys(visible.nodes)
        members: dict[str, Any] = getattr(visible, _GRAPH[kind])
        return members

    @staticmethod
    def entry(record: RobotRecord, kind: str, name: str, there: Any) -> EntryInfo:
        """The entry of a member.

        :param there: its value in :meth:`members`
        """
        place = ResourceLocation("", record.name)
        if kind == "robot":
            data = {"state": there.state.value, "params": place.of("params")}
            return _entry(f"robot:{name}", kind, name, record, place.address, data, record.description)
        id = f"{kind}:{record.name}:{name}"
        if kind == "camera":
            return _entry(id, kind, name, record, place.of("cameras", name), {"type": there.type})
        if kind == "node":
            return _entry(id, kind, name, record, place.of("nodes", name), {})
        ends: Topic | Service = there
        return _entry(id, kind, name, record, place.of(_GRAPH[kind], name), {"types": ends.types})


class RobotEntryPage:
    """Entries of robots in the order of their cursors, while they are iterated.

    :ivar stopped: the cursor at which the scan ended before the last member, else ``None``
    """

    def __init__(self, robots: RobotEntries, chosen: list[VisibleRobot], query: EntryQuery) -> None:
        self._robots = robots
        self._chosen = chosen
        self._query = query
        self.stopped: EntryCursor | None = None

    def __iter__(self) -> Iterator[EntryInfo]:
        after = self._query.after or EntryCursor("", "", "", "")
        kinds = [kind for kind in ROBOT_KINDS if self._query.kind in (None, kind)]
        scanned = 0
        for robot, kind in product(self._chosen, kinds):
            name = robot.record.name
            if (name, kind) < (after.robot, after.kind):
                continue
            if scanned >= MAX_SCANNED:
                self.stopped = EntryCursor(name, kind, "", "")
                return
            scanned += SCAN_COST
            begun = after.name if (name, kind) == (after.robot, after.kind) else ""
            for member, there in self._robots.members(robot, kind).items():
                if member < begun:
                    continue
                if scanned >= MAX_SCANNED:
                    self.stopped = EntryCursor(name, kind, member, "")
                    return
                scanned += 1
                if fnmatchcase(member, self._query.name):
                    entry = self._robots.entry(robot.record, kind, member, there)
                    if entry.cursor > after:
                        yield entry


def _entry(
    id: str,
    kind: str,
    name: str,
    record: RobotRecord,
    address: str,
    data: dict[str, Any],
    description: str = "",
) -> EntryInfo:
    return EntryInfo(
        id=id,
        kind=kind,
        name=name,
        robot=record.name,
        address=address,
        description=description,
        data=msgspec.Raw(msgspec.json.encode(data)),
        user=None,
        ttl=None,
        registered=None,
        expires=None,
    )
