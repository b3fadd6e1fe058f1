"""Summaries of robots: for users by their rights, and complete for the administrator on the relay's own machine."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import msgspec

from relay_db import queries
from relay_protocol.errors import NotFound
from relay_protocol.rights import Rules
from relay_server.access import NO_ROBOT, Access, Principal
from relay_server.control import view
from relay_server.control.controllers import Controllers
from relay_server.robots.link_quality import LinkQuality, joined, milliseconds
from relay_server.robots.registry import RobotRegistry, RobotState
from relay_server.sessions.context import ClientContext
from relay_server.sessions.presence import (
    PresenceReader,
    PresenceService,
    RobotFacts,
    RobotInfo,
    RobotUsers,
    client_rows,
    visible_clients,
)

CACHE_SECONDS = 0.25
"""Most seconds that a page's summary is reused. Values such as round-trip times change without an event."""


class RobotSummaries:
    """Summaries of robots.

    :param clients: the clients of a robot by its id, oldest first
    :param seconds: a monotonic clock
    """

    def __init__(
        self,
        access: Access,
        registry: RobotRegistry,
        presence: PresenceService,
        clients: Callable[[int], list[ClientContext]],
        controllers: Controllers,
        seconds: Callable[[], float],
    ) -> None:
        self._access = access
        self._registry = registry
        self._presence = presence
        self._clients = clients
        self._controllers = controllers
        self._seconds = seconds
        self.facts_elsewhere: Callable[[int], RobotFacts | None] = lambda robot_id: None
        """Returns what another relay of the cluster knows of a robot, by its number."""
        self._views: dict[tuple[object, ...], tuple[float, RobotInfo]] = {}
        registry.on_change(self._views.clear)

    async def shared(self, principal: Principal) -> list[RobotInfo]:
        """As :meth:`robots`, for pages: users with equal rights on a robot share its summary.

        It is made again after a change, and after :data:`CACHE_SECONDS`.
        """
        return [self._shared(record, rules) for record, rules in await self._access.robots(principal)]

    def _shared(self, record: queries.RobotRecord, rules: Rules) -> RobotInfo:
        key = (record, rules.source_free_key)
        now = self._seconds()
        at, row = self._views.get(key, (-math.inf, None))
        if row is None or now - at >= CACHE_SECONDS:
            row = self._summary(record, rules)
            self._views[key] = now, row
        return row

    async def robots(self, principal: Principal) -> list[RobotInfo]:
        """Summaries of the principal's robots, by its rights."""
        return [self._summary(record, rules) for record, rules in await self._access.robots(principal)]

    async def people(self, principal: Principal, robot: str) -> RobotUsers:
        """Users of a robot, and the quality of its link (SPEC 1.7).

        :raises NotFound: no such robot, or no right on it
        """
        for record, rules in await self._access.robots(principal):
            if record.name == robot:
                robot_state = self._of(record)
                name = robot_state.name_of(principal.name, principal.realm)
                people, more = self._presence.users(robot_state, PresenceReader(name, rules, None))
                return {
                    "robot": record.name,
                    "state": robot_state.state.value,
                    "link": robot_state.link_quality().summary(),
                    "drops": _drops(robot_state),
                    "battery": _battery(robot_state),
                    "people": people,
                    "more": more,
                }
        raise NotFound(NO_ROBOT)

    def status(self) -> list[dict[str, Any]]:
        """Every robot the relay knows, with its clients, for the administrator's own machine."""
        return [self._full_summary(robot) for robot in self._registry]

    def _of(self, record: queries.RobotRecord) -> RobotState:
        known = self._registry.find(record.id)
        if known is not None:
            return known
        elsewhere = self._registry.is_elsewhere(record.id)
        return RobotState(record.id, record.name, record.realm, elsewhere=elsewhere)

    def _summary(self, record: queries.RobotRecord, rules: Rules) -> RobotInfo:
        # Only robots with a right are listed.
        assert rules.level is not None
        facts = self._facts(record)
        clients = visible_clients(facts["clients"], rules)
        return {
            "name": record.name,
            "description": record.description,
            **facts,
            "level": rules.level,
            "clients": clients,
            "people": len({each["user"] for each in clients}),
            **view.visible_overrides(facts, rules),
        }

    def _facts(self, record: queries.RobotRecord) -> RobotFacts:
        """The facts of a robot, which its own relay knows."""
        robot = self._of(record)
        facts = self.facts_of(robot)
        if not robot.elsewhere:
            return facts
        # Of its motion, only a stop that is on its way there is known here.
        stop = facts["stopped"]
        coming = None if stop is None or stop["confirmed"] else stop
        there = self.facts_elsewhere(robot.robot_id)
        if there is None:
            return {**facts, "stopped": coming, "suppressed": [], "inhibited": []}
        return {**there, "stopped": there["stopped"] or coming}

    def facts_of(self, robot: RobotState) -> RobotFacts:
        """The facts of a robot, as far as this relay knows them itself."""
        link = robot.link_quality()
        snapshot = self._controllers.snapshot(robot.robot_id)
        return {
            "state": robot.state.value,
            "clients": client_rows(robot, self._clients(robot.robot_id)),
            "holder": view.holder(snapshot),
            "stopped": view.stopped(snapshot),
            **view.overrides(robot),
            "battery": _battery(robot),
            "rtt_ms": milliseconds(link.rtt),
            "quality": link.quality,
            "host": robot.description.host,
            "platform": robot.description.platform,
            "distro": robot.description.distro,
            "last_seen": robot.last_seen,
        }

    def _full_summary(self, robot: RobotState) -> dict[str, Any]:
        return {
            "name": robot.full,
            "realm": robot.realm,
            "shared": sorted(robot.shared),
            "state": robot.state.value,
            "elsewhere": robot.elsewhere,
            "address": robot.address,
            "agent": robot.description.agent,
            "rtt_ms": milliseconds(robot.rtt),
            "link": robot.link_quality().summary(),
            "drops": _drops(robot),
            "battery": _battery(robot),
            "last_seen": robot.last_seen,
            "health": None if robot.control_link is None else msgspec.structs.asdict(robot.health),
            "holder": self._holder(robot),
            "stopped": view.stopped(self._controllers.snapshot(robot.robot_id)),
            **view.overrides(robot),
            "clients": [_client(each, robot.link_quality()) for each in self._clients(robot.robot_id)],
            "viewers": [
                {"user": each.name, "address": each.address, "since": since, "camera": each.camera}
                for each, since in robot.viewers.items()
            ],
        }

    def _holder(self, robot: RobotState) -> dict[str, Any] | None:
        holder = self._controllers.snapshot(robot.robot_id).lease.holder
        if holder is None:
            return None
        client = holder.client
        return {"user": client.name, "address": client.address, "since": holder.since}


def _drops(robot: RobotState) -> int | None:
    """Samples that the robot has reported as dropped."""
    return None if robot.control_link is None else robot.health.dropped_samples


def _battery(robot: RobotState) -> float | None:
    """The charge, 0 to 1; ``None`` while the robot is offline."""
    return None if robot.control_link is None else robot.health.battery


def _client(client: ClientContext, robot_link: LinkQuality) -> dict[str, Any]:
    """A connection.

    :param robot_link: the quality of the link from the relay to the robot
    """
    link = client.link_quality()
    return {
        "user": client.name,
        "address": client.address,
        "since": client.since,
        "rtt_ms": milliseconds(client.rtt),
        "link": link.summary(),
        "robot_rtt_ms": milliseconds(joined(link, robot_link).rtt),
        "drops": client.drops,
        "waiting_bytes": client.port.waiting_bytes,
        "refusals": client.refusals,
        "stale_commands": client.stale_commands,
    }
