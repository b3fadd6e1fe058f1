"""Turns events of the bus, alerts and changes of robots' graphs into stored events.

Nothing here runs for a sample, and nothing waits. Events beyond the rate limit or the queue are dropped and counted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from relay_db.base import canonical_json
from relay_db.models import NAME
from relay_db.names import sanitise
from relay_db.queries import AlertRecord, NewStoredEvent
from relay_db.queries.event_search import RELAY_SOURCE
from relay_protocol.realms import DEFAULT_REALM
from relay_server.common.token_bucket import Buckets
from relay_server.events.bus import BusEvent
from relay_server.events.limits import DATA, RATE_KEYS, RECORDED_A_SECOND, RECORDED_AT_ONCE
from relay_server.events.writer import EventWriter
from relay_server.robots.registry import RobotRegistry, RobotState

KINDS = frozenset(
    {
        "robot.online",
        "robot.offline",
        "robot.stopped",
        "robot.resumed",
        "robot.key_used_twice",
        "robot.suppressed",
        "robot.inhibited",
        "client.joined",
        "client.left",
        "control.taken",
        "control.granted",
        "control.released",
        "control.lost",
        "control.requested",
        "control.withdrawn",
        "control.lapsed",
        "control.refused",
        "motion.begun",
        "publication.begun",
        "param.set",
        "video.joined",
        "video.left",
        "recording.started",
        "recording.ended",
        "call.begun",
        "call.ended",
        "goal.begun",
        "goal.ended",
        "alert.acknowledged",
        "login.refused",
        "client.refused",
        "robot.refused",
        "robot.enrolment_refused",
        "fleet.done",
        "recording.removed",
        "module.ordered",
        "module.changed",
        "file.stored",
        "file.deleted",
        "pipe.started",
        "pipe.ended",
        "role.started",
        "role.stopped",
        "role.ended",
    }
)
"""Kinds of the event bus that are stored (SPEC 1.14)."""

_REALM = "realm"
"""The field with the realm of an event that is about no robot; without a value the event is not stored. Of a refused
login it is the realm that the name gave, whether it exists or not: the answer must not show which realms exist."""

_OMITTED_FIELDS = frozenset({"robot", "user", "address"})
"""Fields that a stored event has elsewhere, or that not every reader with a right on the robot may see."""

_ONLY_FIELDS = {
    "recording.started": frozenset({"recording"}),
    "recording.ended": frozenset({"recording", "state"}),
}
"""All fields that are stored of these kinds: the reason why a recording ended may name restricted topics."""

_OWN_REALM_ONLY = frozenset(_ONLY_FIELDS)
"""Kinds that are stored in the realm of their user alone, as recordings stay there (SPEC 3.1)."""

REFUSED = f"{RELAY_SOURCE}.refused"
_SOURCES = dict.fromkeys(("client.refused", "robot.refused", "robot.enrolment_refused"), REFUSED)
"""Kinds that any client can cause have a source of their own, so that they displace no other events."""

_SHARES = {"node": "node", "video": "video", "module": "module", "file": "file"}
"""Prefixes of kinds with a rate limit of their own: many of them displace no other events of the user or robot."""

_RESTRICTED_ALERTS = frozenset({"stale", "diagnostics", "key"})
"""Kinds of alerts whose text takes further rights (SPEC 1.10)."""


class EventCollector:
    """Stores what happens in the relay, as far as it is for the event log.

    :param wall: Unix time in seconds
    :param seconds: a monotonic clock
    """

    def __init__(
        self,
        writer: EventWriter,
        registry: RobotRegistry,
        wall: Callable[[], float],
        seconds: Callable[[], float],
    ) -> None:
        self._writer = writer
        self._registry = registry
        self._wall = wall
        self._buckets = Buckets(RECORDED_A_SECOND, RECORDED_AT_ONCE, RATE_KEYS, seconds)

    def on_bus_event(self, event: BusEvent) -> None:
        """Store an event of the bus if it is of one of :data:`KINDS`."""
        kind, robot_id, data = event.kind, event.robot_id, event.data
        if kind not in KINDS or data.get("snapshot"):
            # Snapshots may come once a second; they would displace all other events.
            return
        origin, _, name = event.source.partition(":")
        user = name if origin == "user" else None
        if robot_id is None:
            self._record(kind, None, user, data)
        else:
            fields = _ONLY_FIELDS.get(kind, data.keys()) - _OMITTED_FIELDS
            self._record(
                kind, robot_id, user, {name: value for name, value in data.items() if name in fields}
            )

    def on_nodes_changed(self, robot: RobotState, up: Iterable[str], down: Iterable[str]) -> None:
        """Store that nodes came into the graph of a robot that is online, or left it."""
        for kind, names in (("node.up", up), ("node.down", down)):
            for node in names:
                self._record(kind, robot.robot_id, None, {"node": node})

    def on_alert(self, event: str, alert: AlertRecord) -> None:
        """Store that an alert began, became worse, or ended."""
        data = {"alert": alert.id, "alert_kind": alert.kind, "level": alert.level}
        if alert.kind not in _RESTRICTED_ALERTS:
            data |= {"about": alert.about, "text": alert.text}
        self._record(f"alert.{event}", alert.robot_id, None, data)

    def record(self, event: NewStoredEvent, by: str | None = None) -> None:
        """Store an event, unless too many of its kind came recently.

        :param by: whose rate limit counts, where that is not the event's user
        """
        share = _SOURCES.get(event.kind) or _SHARES.get(event.kind.partition(".")[0], "")
        if self._within_rate(event.realm, event.robot_id, by or event.user, share):
            self._writer.append(event)
        else:
            self._writer.count_drop(event.realm)

    def _within_rate(self, realm: str, robot_id: int | None, user: str | None, share: str) -> bool:
        """Whether the rate limit allows one more. Names of realms that do not exist share one limit."""
        return self._buckets.take((realm if self._writer.knows_realm(realm) else None, robot_id, user, share))

    def _record(self, kind: str, robot_id: int | None, user: str | None, data: Mapping[str, Any]) -> None:
        robot = None if robot_id is None else self._registry.find(robot_id)
        if robot_id is not None and robot is None:
            # The robot was removed, and all rights to see its events with it.
            return
        if robot is None:
            realm = data.get(_REALM, DEFAULT_REALM)
            if realm:
                source = _SOURCES.get(kind, RELAY_SOURCE)
                self.record(NewStoredEvent(realm, self._wall(), source, kind, None, _name(user), _text(data)))
            return
        # A name without a realm is of the robot's own realm.
        name, at, of = (user or "").partition("@")
        for realm in sorted(robot.realms):
            mine = user is not None and realm == (of if at else robot.realm)
            if kind in _OWN_REALM_ONLY and not mine:
                continue
            stored = data if mine or user is None else {**data, "by": user if at else f"{user}@{robot.realm}"}
            source, own_user = f"{RELAY_SOURCE}:{robot.name}", _name(name) if mine else None
            self.record(
                NewStoredEvent(realm, self._wall(), source, kind, robot_id, own_user, _text(stored)), by=user
            )


def _name(user: str | None) -> str | None:
    return user and sanitise(user, NAME)


def _text(data: Mapping[str, Any]) -> str:
    """Data as it is stored. Text is cut; data that is still too large is left out."""
    cut = {
        name: sanitise(value) if isinstance(value, str) else value
        for name, value in data.items()
        if name != _REALM
    }
    text = canonical_json(cut)
    return text if len(text) <= DATA else canonical_json({"left_out": len(text)})
