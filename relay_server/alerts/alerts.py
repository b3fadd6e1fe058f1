"""Puts alerts together: what happens to robots goes into the book, from there to the database and to people."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Collection
from typing import Any

from twisted.internet.defer import Deferred, DeferredLock
from twisted.logger import Logger

from relay_db import queries
from relay_db.queries import AlertRecord, AlertRuleRecord
from relay_protocol.errors import SwitchboardError
from relay_protocol.rights import Rules
from relay_server.access import Access, Principal
from relay_server.alerts import rules
from relay_server.alerts import types as kinds
from relay_server.alerts.delivery import DeliveryContext, Room, Send, at_once
from relay_server.alerts.dispatcher import RuleDispatcher
from relay_server.alerts.monitors import LOOK_SECONDS, Monitors, Thresholds, stopped_by
from relay_server.alerts.store import AlertChange, AlertStore, Key, Moment
from relay_server.channels.channels import Channels
from relay_server.common.clock import Clock, looping, with_timeout
from relay_server.common.database import AsyncDatabase
from relay_server.control.controllers import Controllers
from relay_server.events.bus import EventBus
from relay_server.robots.registry import RobotRegistry, RobotState

TOPICS_EVERY = 4
"""Looks at robots from one look at their topics to the next."""

TIDY_EVERY = 40
"""Looks from one tidying of the book to the next; pages are told anew what was counted and what quiet hours changed."""

ABSENT_SECONDS = 30.0
"""A robot that was not there when the relay began has so long to come."""

AGAIN_SECONDS = 10.0
"""A daemon that began anew has so long to hear what is still wrong, and to tell it."""

KEEP_SECONDS = 3.0
"""The latest alerts have so long to be kept when the relay goes down."""

BATCH = 200
"""Alerts written in one transaction."""


class AlertHub:
    """The alerts of a relay.

    :param wall: Unix time in seconds
    :param send: sends a message by a rule's way
    :param room: what it has to wait for there
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        wall: Callable[[], float],
        store: AsyncDatabase,
        access: Access,
        registry: RobotRegistry,
        channels: Channels,
        desks: Controllers,
        journal: EventBus,
        thresholds: Thresholds,
        send: Send,
        room: Room = at_once,
    ) -> None:
        self.version = 0
        """Another number whenever there is something else to show."""
        self.book = AlertStore(lambda: secrets.token_hex(8))
        self.tellers = RuleDispatcher(
            DeliveryContext(
                clock, wall, secrets.SystemRandom().random, lambda: secrets.token_hex(8), send, self._known,
                self._lasts, self._realms, room,
            )
        )  # fmt: skip
        self._clock = clock
        self._wall = wall
        self._store = store
        self._access = access
        self._registry = registry
        self._senses = Monitors(registry, channels, desks, thresholds, self)
        self._looking = looping(clock, self._look)
        self._looks = 0
        self._shown = self._states = 0
        self._writing: Deferred[None] | None = None
        self._pen = DeferredLock()
        self._began = clock.seconds()
        self._absent: dict[int, tuple[str, str]] = {}
        self._came: dict[int, float] = {}
        """When each robot's latest registration was, monotonic seconds."""
        self._daemons: dict[int, float] = {}
        """When each robot's daemon began, as it says itself."""
        self._untold: dict[int, set[Key]] = {}
        """What each robot told before its latest registration and not since."""
        self._steered: set[int] = set()
        """Robots of which this relay has seen somebody take control: of a loss after that it needs nobody's word."""
        self._listeners: list[Callable[[str, AlertRecord], None]] = []
        self._rights: dict[int, tuple[object, dict[int, Rules]]] = {}
        """By user: the list that :meth:`Access.robots` gave last, and what that says by robot."""
        self._takers: dict[str, Callable[[RobotState, dict[str, Any]], None]] = {
            "robot.online": self._came_online,
            "robot.stopped": self._stopped,
            "robot.resumed": lambda robot, data: self.over(robot, kinds.STOP),
            "robot.alert": self._robot_tells,
            "robot.alerts_told": self._all_told,
            "control.lost": self._control_lost,
            "control.taken": self._control_taken,
            "audit.lost": self._audit_lost,
            "robot.key_used_twice": self._key_used_twice,
            "audit.written": lambda robot, data: self.over(robot, kinds.AUDIT),
        }
        journal.listen(self._happened)

    def listen(self, listener: Callable[[str, AlertRecord], None]) -> None:
        """Have somebody told of what is worth telling: what has become of an alert, and the alert as it is now."""
        self._listeners.append(listener)

    async def start(self) -> None:
        """Take up what an earlier relay kept, and look from now on."""
        since = self._wall() - kinds.SHOWN_SECONDS
        self.book.load(await self._store.read(queries.recent_alerts, since), self._moment())
        self._absent = {
            each.id: (each.name, each.realm) for each in await self._store.read(queries.enrolled_robots)
        }
        self._began = self._clock.seconds()
        await self.refresh()
        self._looking.start(LOOK_SECONDS, now=False)

    def hush(self) -> None:
        """Look no more, and send nothing: of what happens from now on the next relay tells."""
        if self._looking.running:
            self._looking.stop()
        self.tellers.hush()

    async def keep(self) -> None:
        """Keep what there is, if the database takes it soon; what nobody was told of as that."""
        self.book.untell(self.tellers.unheard())
        late = f"the database has not taken them within {KEEP_SECONDS:g} s"
        try:
            await with_timeout(self._clock, KEEP_SECONDS, self.flush(), late)
        except SwitchboardError as error:
            self.log.error("the latest alerts could not be kept: {reason}", reason=str(error))

    async def refresh(self) -> None:
        """Take up what somebody changed in the database: rules, acknowledgements, robots that are gone.

        :raises Unavailable: the database can't be asked
        """
        self.tellers.take(await self._store.read(queries.list_alert_rules))
        self._rights.clear()
        # First, that no acknowledgement is taken up of what has become worse since.
        await self.flush()
        for alert, (by, at) in (await self._store.read(queries.acknowledgements)).items():
            self.acknowledge(alert, by, at)
        there = {each.id for each in await self._store.read(queries.list_robots)}
        for gone in {each.robot_id for each in self.book} - there:
            self.book.forget(gone)
        for kept in (self._came, self._daemons, self._untold, self._absent):
            for gone in kept.keys() - there:
                del kept[gone]
        self._steered &= there
        self.version += 1

    async def purge(self) -> None:
        """Forget what is too old or too much.

        :raises Unavailable: the database can't be asked
        """
        while await self._store.write(queries.purge_alerts, self._wall() - kinds.KEPT_SECONDS):
            pass

    # --- what happens -------------------------------------------------------------------------------------

    def tell(self, robot: RobotState, kind: str, about: str, level: str, text: str) -> None:
        """Something is wrong with a robot."""
        who = robot.robot_id, robot.name, robot.realm
        self._changed(self.book.tell(*who, kind, about, level, text, self._moment()))

    def over(self, robot: RobotState, kind: str, about: str = "") -> None:
        """It is well again."""
        if self.book.lasts(robot.robot_id, kind, about) is not None:
            self._changed(self.book.over(robot.robot_id, kind, about, self._moment()))

    def lasts(self, robot: RobotState, kind: str, about: str = "") -> str | None:
        """The level of this alert while it lasts."""
        found = self.book.lasts(robot.robot_id, kind, about)
        return None if found is None else found.level

    def lasting(self, robot: RobotState, kind: str) -> list[str]:
        """What those of a kind that last are about."""
        return [each.about for each in self.book.open_of(robot.robot_id) if each.kind == kind]

    def name_of(self, principal: Principal, alert: AlertRecord) -> str:
        """What somebody is called at the robot of an alert."""
        robot = self._registry.presence(alert.robot_id, alert.robot, alert.realm)
        return robot.name_of(principal.name, principal.realm)

    def acknowledge(self, alert_id: str, by: str, at: float) -> AlertRecord | None:
        """Somebody looks after an alert; the alert, if there is one."""
        found, changes = self.book.acknowledge(alert_id, by, at, self._moment())
        self._changed(changes)
        return found

    def _moment(self) -> Moment:
        return Moment(self._wall(), self._clock.seconds())

    def _changed(self, changes: Collection[AlertChange]) -> None:
        if self._states != self.book.states:
            self._states = self.book.states
            self.version += 1
        self.tellers.offer(changes)
        for change in changes:
            for listener in self._listeners:
                listener(change.event.value, change.alert)

    def _happened(self, kind: str, robot_id: int | None, data: dict[str, Any]) -> None:
        """An event of the journal, whether it is kept there or not."""
        take = self._takers.get(kind)
        robot = None if robot_id is None else self._registry.find(robot_id)
        if take is not None and robot is not None:
            take(robot, data)

    def _came_online(self, robot: RobotState, data: dict[str, Any]) -> None:
        self._came[robot.robot_id] = self._clock.seconds()
        self._untold[robot.robot_id] = {
            (each.kind, each.about)
            for each in self.book.open_of(robot.robot_id)
            if each.kind not in kinds.OURS
        }
        self.over(robot, kinds.OFFLINE)

    def _stopped(self, robot: RobotState, data: dict[str, Any]) -> None:
        if self.lasts(robot, kinds.STOP) is None:
            text = stopped_by(str(data.get("user", "")), str(data.get("why", "")))
            self.tell(robot, kinds.STOP, "", "warning", text)

    def _robot_tells(self, robot: RobotState, data: dict[str, Any]) -> None:
        word = str(data.get("alert_kind", "")), str(data.get("about", ""))
        if word == (kinds.CONTROL, "") and not data.get("over"):
            self._was_bereft(robot, str(data.get("text", "")))
            return
        kind, about = kinds.from_robot(*word)
        self._untold.get(robot.robot_id, set()).discard((kind, about))
        if data.get("over"):
            self.over(robot, kind, about)
        else:
            level = kinds.known_level(str(data.get("level", "")))
            self.tell(robot, kind, about, level, str(data.get("text", "")))

    def _all_told(self, robot: RobotState, data: dict[str, Any]) -> None:
        """What the robot has not told again is over, where it has an end of its own."""
        untold = self._untold.get(robot.robot_id, set())
        for kind, about in [each for each in untold if not kinds.endless(each[0])]:
            untold.discard((kind, about))
            self.over(robot, kind, about)

    def _control_lost(self, robot: RobotState, data: dict[str, Any]) -> None:
        if data.get("moving"):
            who, why = data.get("user", "somebody"), data.get("why", "")
            self.tell(robot, kinds.CONTROL, "", "error", f"{who} lost control while the robot moved: {why}")

    def _control_taken(self, robot: RobotState, data: dict[str, Any]) -> None:
        self._steered.add(robot.robot_id)
        self.over(robot, kinds.CONTROL)

    def _key_used_twice(self, robot: RobotState, data: dict[str, Any]) -> None:
        text = (
            f"two daemons use the robot's key, at {data.get('addresses', '')}: stop one of them. If one is not yours, "
            "revoke the key and enroll the robot again"
        )
        self.tell(robot, kinds.KEY, "", "error", text)

    def _audit_lost(self, robot: RobotState, data: dict[str, Any]) -> None:
        text = "audit entries about this robot are lost: the database could not be written for too long"
        self.tell(robot, kinds.AUDIT, "", "error", text)

    def _was_bereft(self, robot: RobotState, text: str) -> None:
        """The robot says that its driver lost it: only of an earlier relay's time is that anything new."""
        if robot.robot_id not in self._steered:
            self.tell(robot, kinds.CONTROL, "", "error", text)

    # --- looking ------------------------------------------------------------------------------------------

    def _look(self) -> None:
        try:
            self._look_once()
        except Exception:  # a look that fails must not be the last one
            self.log.failure("looking after alerts failed")

    def _look_once(self) -> None:
        now, wall = self._clock.seconds(), self._wall()
        self._looks += 1
        self._senses.look(now, wall)
        for robot in self._registry:
            self._end_what_is_forgotten(robot, now)
        if self._looks % TOPICS_EVERY == 0:
            self._senses.look_at_topics(now)
        if self._looks % TIDY_EVERY == 0:
            self._changed(self.book.sweep(self._moment()))
            self.version += 1
        if self._absent and now - self._began >= ABSENT_SECONDS:
            self._miss()
        self._flush_later()
        if self._shown != self.version:
            self._shown = self.version
            self._registry.changed()

    def _end_what_is_forgotten(self, robot: RobotState, now: float) -> None:
        """A daemon that began anew does not know what it told before; it tells again what is still wrong."""
        began, before = robot.description.started, self._daemons.get(robot.robot_id)
        if robot.control is None or began == before:
            return
        if before and now - self._came.get(robot.robot_id, now) < AGAIN_SECONDS:
            return
        self._daemons[robot.robot_id] = began
        for kind, about in self._untold.pop(robot.robot_id, ()) if before else ():
            self.over(robot, kind, about)

    def _miss(self) -> None:
        """Robots that were there before the relay began, and are not since."""
        absent, self._absent = self._absent, {}
        for robot_id, (name, realm) in absent.items():
            robot = self._registry.presence(robot_id, name, realm)
            if robot.control is None and robot.last_seen is None and self.lasts(robot, kinds.OFFLINE) is None:
                self.tell(
                    robot, kinds.OFFLINE, "", "error", "the robot has not come back since the relay began"
                )

    # --- writing ------------------------------------------------------------------------------------------

    def _flush_later(self) -> None:
        if self._writing is None:
            self._writing = Deferred.fromCoroutine(self.flush())
            self._writing.addErrback(
                lambda failure: self.log.debug("alerts wait to be kept: {reason}", reason=failure.value)
            )
            self._writing.addBoth(self._flushed)

    def _flushed(self, _: object) -> None:
        self._writing = None

    async def flush(self) -> None:
        """Have the database know what the book does.

        :raises Unavailable: it can't be reached; what is not written waits
        """
        # One at a time: a database with several writers might put an older state over a later one.
        await self._pen.acquire()
        try:
            await self._write(self.book.take_changed())
        finally:
            self._pen.release()

    async def _write(self, changed: list[AlertRecord]) -> None:
        while changed:
            batch, changed = changed[:BATCH], changed[BATCH:]
            try:
                await self._store.write(queries.save_alerts, batch)
            except BaseException:  # also an error nobody has foreseen, and a flush that is given up
                self.book.put_back([*batch, *changed])
                raise
            changed = changed or self.book.take_changed()

    # --- who may know -------------------------------------------------------------------------------------

    async def _known(self, rule: AlertRuleRecord, alerts: Collection[AlertRecord]) -> set[str]:
        """Which of these alerts the rule's user may know of now, by their ids."""
        # Who asks is a user, by no token.
        asks = Principal(rule.user_id, rule.user, rule.realm, False, 0, None)
        known = await self._access.robots(asks)
        kept, rights = self._rights.get(rule.user_id, (None, {}))
        if kept is not known:
            rights = {record.id: each for record, each in known}
            self._rights[rule.user_id] = (known, rights)
        return {
            each.id
            for each in alerts
            if each.robot_id in rights and rules.visible(rights[each.robot_id], each.kind, each.about)
        }

    def _realms(self, alert: AlertRecord) -> frozenset[str]:
        robot = self._registry.find(alert.robot_id)
        return frozenset({alert.realm}) if robot is None else robot.realms

    def _lasts(self, alert_id: str) -> bool:
        found = self.book.find(alert_id)
        return found is not None and found.over is None
