"""What is told of robots: to users by their rights, to the administrator on the relay's own machine all of it."""

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
from relay_server.sessions.presence import PresenceReader, PresenceService, client_rows
from relay_server.sessions.session import Session

FRESH_SECONDS = 0.25
"""What passes without a change, such as the time to a robot and back, is so old at most in what pages show."""


class RobotSummaries:
    """Puts together what is known of robots.

    :param sessions: the open sessions of a robot by its id, oldest first
    :param seconds: a monotonic clock
    """

    def __init__(
        self,
        access: Access,
        registry: RobotRegistry,
        people: PresenceService,
        sessions: Callable[[int], list[Session]],
        desks: Controllers,
        seconds: Callable[[], float],
    ) -> None:
        self._access = access
        self._registry = registry
        self._people = people
        self._sessions = sessions
        self._desks = desks
        self._seconds = seconds
        self._views: dict[tuple[object, ...], tuple[float, dict[str, Any]]] = {}
        registry.on_change(self._views.clear)

    async def shared(self, principal: Principal) -> list[dict[str, Any]]:
        """The same as :meth:`robots`, for pages: a row is shared by all users with equal rights on its robot.

        It is made again when something has changed, and after :data:`FRESH_SECONDS`.
        """
        return [self._shared(record, rules) for record, rules in await self._access.robots(principal)]

    def _shared(self, record: queries.RobotRecord, rules: Rules) -> dict[str, Any]:
        key = (record, rules.alike)
        now = self._seconds()
        at, row = self._views.get(key, (-math.inf, {}))
        if now - at >= FRESH_SECONDS:
            row = self._view(record, rules)
            self._views[key] = now, row
        return row

    async def robots(self, principal: Principal) -> list[dict[str, Any]]:
        """What the principal may see of its robots."""
        return [self._view(record, rules) for record, rules in await self._access.robots(principal)]

    async def people(self, principal: Principal, robot: str) -> dict[str, Any]:
        """Who is at a robot, and how good its link is (SPEC section 1.7).

        :raises NotFound: no such robot, or no right on it
        """
        for record, rules in await self._access.robots(principal):
            if record.name == robot:
                there = self._of(record)
                name = there.name_of(principal.name, principal.realm)
                people, more = self._people.told(there, PresenceReader(name, rules, None))
                return {
                    "robot": record.name,
                    "state": there.state.value,
                    "link": there.reading().told(),
                    "drops": _drops(there),
                    "battery": _battery(there),
                    "people": people,
                    "more": more,
                }
        raise NotFound(NO_ROBOT)

    def status(self) -> list[dict[str, Any]]:
        """Every robot the relay knows and who works with it, for the administrator's own machine."""
        return [self._known(robot) for robot in self._registry]

    def _of(self, record: queries.RobotRecord) -> RobotState:
        return self._registry.find(record.id) or RobotState(record.id, record.name, record.realm)

    def _view(self, record: queries.RobotRecord, rules: Rules) -> dict[str, Any]:
        robot = self._of(record)
        link = robot.reading()
        standing = self._desks.standing(record.id)
        return {
            "name": record.name,
            "description": record.description,
            "state": robot.state.value,
            "level": str(rules.level),
            "clients": client_rows(robot, self._sessions(record.id), rules),
            "people": self._people.count(robot, rules),
            "holder": view.holder(standing),
            "stopped": view.stopped(standing),
            **view.overrides(robot, rules),
            "battery": _battery(robot),
            "rtt_ms": milliseconds(link.rtt),
            "quality": link.quality,
            "host": robot.description.host,
            "platform": robot.description.platform,
            "distro": robot.description.distro,
            "last_seen": robot.last_seen,
        }

    def _known(self, robot: RobotState) -> dict[str, Any]:
        return {
            "name": robot.full,
            "realm": robot.realm,
            "shared": sorted(robot.shared),
            "state": robot.state.value,
            "address": robot.address,
            "agent": robot.description.agent,
            "rtt_ms": milliseconds(robot.rtt),
            "link": robot.reading().told(),
            "drops": _drops(robot),
            "battery": _battery(robot),
            "last_seen": robot.last_seen,
            "health": None if robot.control is None else msgspec.structs.asdict(robot.health),
            "holder": self._holder(robot),
            "stopped": view.stopped(self._desks.standing(robot.robot_id)),
            **view.overrides(robot),
            "clients": [_client(each, robot.reading()) for each in self._sessions(robot.robot_id)],
            "onlookers": [
                {"user": each.name, "address": each.address, "since": since, "camera": each.camera}
                for each, since in robot.onlookers.items()
            ],
        }

    def _holder(self, robot: RobotState) -> dict[str, Any] | None:
        tenure = self._desks.standing(robot.robot_id).lease.holder
        if tenure is None:
            return None
        client = tenure.client
        return {"user": client.name, "address": client.address, "since": tenure.since}


def _drops(robot: RobotState) -> int | None:
    """Samples the robot has dropped, as far as it has told."""
    return None if robot.control is None else robot.health.dropped_samples


def _battery(robot: RobotState) -> float | None:
    """The charge it has, 0 to 1; what it had before it went away nobody shall take for that."""
    return None if robot.control is None else robot.health.battery


def _client(session: Session, onward: LinkQuality) -> dict[str, Any]:
    """A connection.

    :param onward: how good the way from the relay to the robot is
    """
    link = session.reading()
    return {
        "user": session.name,
        "address": session.address,
        "since": session.since,
        "rtt_ms": milliseconds(session.rtt),
        "link": link.told(),
        "robot_rtt_ms": milliseconds(joined(link, onward).rtt),
        "drops": session.outbox.dropped,
        "waiting_bytes": session.outbox.waiting_bytes,
        "refusals": session.refusals,
        "stale_commands": session.stale_commands,
    }
