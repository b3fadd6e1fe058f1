"""What leaves an event by itself: what the journal, the alerts and robots' graphs tell, in the words of the memory.

Nothing here is done for a sample, and nothing waits: what finds no room, or comes too often, is counted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from relay_db.base import canonical_json
from relay_db.models import NAME
from relay_db.names import sanitise
from relay_db.queries import AlertRecord, NewStoredEvent
from relay_db.queries.event_search import OURS
from relay_protocol.realms import DEFAULT_REALM
from relay_server.common.token_bucket import Buckets
from relay_server.events.limits import DATA, NOTED, NOTED_A_SECOND, NOTED_AT_ONCE
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
        "login.refused",
    }
)
"""What of the journal is noted (SPEC section 1.14)."""

_REALM = "realm"
"""The field in which an event about no robot says whose it is: empty or ``None`` where nobody is to be told. To whom a
failed login is told must not tell him what there is in other realms, so it is the one that was named, there or not."""

_UNTOLD = frozenset({"robot", "user", "address"})
"""Fields that an event has in other places, or that are not everybody's who may see the robot."""

_ONLY = {"recording.started": frozenset({"recording"}), "recording.ended": frozenset({"recording", "state"})}
"""Fields of kinds of which no others are told: why a recording ended may name what not everybody may see."""

_AT_HOME = frozenset(_ONLY)
"""Kinds that are told in the realm of who did it alone, as what was recorded stays there (SPEC section 3.1)."""

_SHARES = {"module": "module", "video": "video"}
"""Kinds, by what they begin with, that have a share of what may be noted for themselves: they take no room from what
else somebody does, or becomes of a robot."""

_GUARDED = frozenset({"stale", "diagnostics", "key"})
"""Kinds of alerts whose words take further rights (SPEC section 1.10); that there is one does not."""


class EventCollector:
    """See the module's text.

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
        self._buckets = Buckets(NOTED_A_SECOND, NOTED_AT_ONCE, NOTED, seconds)

    def happened(self, kind: str, source: str, robot_id: int | None, data: Mapping[str, Any]) -> None:
        """An event of the journal, whether it is kept there or not."""
        if kind not in KINDS or data.get("snapshot"):
            # Who asks for a picture a second would push out all else.
            return
        who, _, name = source.partition(":")
        user = name if who == "user" else None
        if robot_id is None:
            self._note(kind, None, user, data)
        else:
            told = _ONLY.get(kind, data.keys()) - _UNTOLD
            self._note(kind, robot_id, user, {name: value for name, value in data.items() if name in told})

    def modules(self, robot: RobotState, up: Iterable[str], down: Iterable[str]) -> None:
        """Nodes have come into a robot's graph, and have gone, while it was online."""
        for kind, nodes in (("module.up", up), ("module.down", down)):
            for node in nodes:
                self._note(kind, robot.robot_id, None, {"module": node})

    def alert(self, what: str, alert: AlertRecord) -> None:
        """An alert has begun, become worse, or is over."""
        data = {"alert": alert.id, "alert_kind": alert.kind, "level": alert.level}
        if alert.kind not in _GUARDED:
            data |= {"about": alert.about, "text": alert.text}
        self._note(f"alert.{what}", alert.robot_id, None, data)

    def note(self, event: NewStoredEvent, by: str | None = None) -> None:
        """What another part of this relay has put together; dropped where there were too many of late.

        :param by: whose share of what may be noted it takes, where that is not the event's user
        """
        share = _SHARES.get(event.kind.partition(".")[0], "")
        if self._may_pass(event.realm, event.robot_id, by or event.user, share):
            self._writer.note(event)
        else:
            self._writer.drop(event.realm)

    def _may_pass(self, realm: str, robot_id: int | None, user: str | None, share: str) -> bool:
        """Whether there is one more; what strangers name for realms has one share together."""
        return self._buckets.take((realm if self._writer.knows(realm) else None, robot_id, user, share))

    def _note(self, kind: str, robot_id: int | None, user: str | None, data: Mapping[str, Any]) -> None:
        robot = None if robot_id is None else self._registry.find(robot_id)
        if robot_id is not None and robot is None:
            # It was removed: nobody may see this any more.
            return
        if robot is None:
            realm = data.get(_REALM, DEFAULT_REALM)
            if realm:
                self.note(NewStoredEvent(realm, self._wall(), OURS, kind, None, _name(user), _text(data)))
            return
        # Whom it does not name with his realm is of the robot's own.
        name, at, of = (user or "").partition("@")
        for realm in sorted(robot.realms):
            mine = user is not None and realm == (of if at else robot.realm)
            if kind in _AT_HOME and not mine:
                continue
            told = data if mine or user is None else {**data, "by": user if at else f"{user}@{robot.realm}"}
            source, who = f"{OURS}:{robot.name}", _name(name) if mine else None
            self.note(NewStoredEvent(realm, self._wall(), source, kind, robot_id, who, _text(told)), by=user)


def _name(user: str | None) -> str | None:
    return user and sanitise(user, NAME)


def _text(data: Mapping[str, Any]) -> str:
    """Data as it is kept; words are cut, and what is too large all the same is left out."""
    cut = {
        name: sanitise(value) if isinstance(value, str) else value
        for name, value in data.items()
        if name != _REALM
    }
    text = canonical_json(cut)
    return text if len(text) <= DATA else canonical_json({"left_out": len(text)})
