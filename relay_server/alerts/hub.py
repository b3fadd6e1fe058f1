"""Brings alerts together: from events and monitors into the store, from there to the database and to users."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Collection
from typing import Any

from twisted.internet.defer import Deferred, DeferredLock
from twisted.logger import Logger

from relay_db import queries
from relay_db.queries import AlertRecord, AlertRuleRecord, RobotRecord
from relay_protocol.errors import SwitchboardError
from relay_protocol.rights import Rules
from relay_server.access import Access, Principal
from relay_server.alerts import rules
from relay_server.alerts import types as kinds
from relay_server.alerts.delivery import DeliveryContext, RuleDispatcher, Send, Slot, no_wait
from relay_server.alerts.monitors import CHECK_SECONDS, Monitors, Thresholds, stopped_by
from relay_server.alerts.store import AlertChange, AlertStore, Key, Moment
from relay_server.channels.channel import Channels
from relay_server.common.clock import Clock, looping
from relay_server.common.concurrency import with_timeout
from relay_server.common.database import AsyncDatabase
from relay_server.control.controllers import Controllers
from relay_server.events.bus import BusEvent, EventBus
from relay_server.robots.registry import RobotRegistry, RobotState

TOPICS_EVERY = 4
"""Checks of robots between two checks of their topics."""

SWEEP_EVERY = 40
"""Checks between two sweeps of the store, which also let pages show new counts and changes by quiet hours."""

MIRROR_EVERY = 120
"""Checks between two reads of the alerts of other relays, whose notices may be lost."""

ABSENT_SECONDS = 30.0
"""Time for robots to come online after the relay has started."""

REPORT_AGAIN_SECONDS = 10.0
"""Time for a restarted daemon to find and report again what is still wrong."""

SAVE_SECONDS = 3.0
"""Time for the last write when the relay stops."""

BATCH = 200
"""Alerts written in one transaction."""


class AlertHub:
    """The alerts of a relay.

    :param wall: Unix time in seconds
    :param send: sends a message of a rule
    :param slot: a context that the message waits for, and holds while it is sent
    :ivar version: changes whenever pages have something else to show
    :ivar on_written: called with alerts that were written, for other relays of a cluster; ``None``: there are none
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
        controllers: Controllers,
        bus: EventBus,
        thresholds: Thresholds,
        send: Send,
        slot: Slot = no_wait,
        leads: Callable[[], bool] = lambda: True,
    ) -> None:
        self._leads = leads
        self.version = 0
        self.store = AlertStore(lambda: secrets.token_hex(8))
        self.dispatcher = RuleDispatcher(
            DeliveryContext(
                clock=clock,
                wall=wall,
                random=secrets.SystemRandom().random,
                name=lambda: secrets.token_hex(8),
                send=send,
                visible=self._visible_ids,
                is_open=self._is_open,
                realms=self._realms,
                slot=slot,
            )
        )
        self._clock = clock
        self._wall = wall
        self._store = store
        self._access = access
        self._registry, self._controllers = registry, controllers
        self._monitors = Monitors(registry, channels, controllers, thresholds, self, leads)
        self._loop = looping(clock, self._run)
        self._runs = 0
        self._shown = self._states = 0
        self._writing: Deferred[None] | None = None
        self._write_lock = DeferredLock()
        self._began = clock.seconds()
        self._absent: dict[int, tuple[str, str]] = {}
        self._registered_at: dict[int, float] = {}
        """The monotonic time of each robot's latest registration."""
        self._daemon_started: dict[int, float] = {}
        """When each robot's daemon started, by the robot's clock."""
        self._all_active: set[int] = set()
        """Robots that have reported all open alerts since they registered."""
        self._unconfirmed: dict[int, set[Key]] = {}
        """Open alerts that a robot reported before its latest registration and not since."""
        self._controlled: set[int] = set()
        """Robots that were controlled through this relay, which sees a loss of control itself."""
        self._listeners: list[Callable[[str, AlertRecord], None]] = []
        self.on_written: Callable[[Collection[AlertRecord]], object] | None = None
        self._rights: dict[int, tuple[object, dict[int, Rules]]] = {}
        """The latest result of :meth:`Access.robots`, and the same by robot, for each user."""
        self._handlers = self._event_handlers()
        bus.subscribe(self._on_event)

    def _event_handlers(self) -> dict[str, Callable[[RobotState, dict[str, Any]], None]]:
        return {
            "robot.online": self._came_online,
            "robot.stopped": self._stopped,
            "robot.resumed": self._resumed,
            "robot.alert": self._robot_alert,
            "robot.active_alerts_sent": self._all_active_sent,
            "control.lost": self._control_lost,
            "control.taken": self._control_taken,
            "audit.lost": self._audit_lost,
            "robot.key_used_twice": self._key_used_twice,
            "audit.written": lambda robot, data: self.end(robot, kinds.AUDIT),
        }

    def subscribe(self, listener: Callable[[str, AlertRecord], None]) -> None:
        """Call this with the event of an alert, and the alert, whenever one begins, becomes worse or ends."""
        self._listeners.append(listener)

    async def start(self) -> None:
        """Load the stored alerts, and check robots from now on."""
        since = self._wall() - kinds.SHOWN_SECONDS
        self.store.load(await self._store.read(queries.recent_alerts, since), self._now())
        self._absent = {
            each.id: (each.name, each.realm) for each in await self._store.read(queries.enrolled_robots)
        }
        self._began = self._clock.seconds()
        await self.refresh()
        self._loop.start(CHECK_SECONDS, now=False)

    def mute(self) -> None:
        """Check no robots and send nothing any more; the next relay reports what happens from now on."""
        if self._loop.running:
            self._loop.stop()
        self.dispatcher.mute()

    async def save(self) -> None:
        """Write all alerts, for :data:`SAVE_SECONDS` at most; those that reached no user as unreported."""
        self.store.mark_unreported(self.dispatcher.undelivered())
        late = f"the database has not taken them within {SAVE_SECONDS:g} s"
        try:
            await with_timeout(self._clock, SAVE_SECONDS, self.flush(), late)
        except SwitchboardError as error:
            self.log.error("the latest alerts are lost: {reason}", reason=str(error))

    async def refresh(self) -> None:
        """Apply changes in the database: rules, acknowledgements, removed robots.

        :raises Unavailable: the database can't be asked
        """
        self.dispatcher.set_rules(await self._store.read(queries.list_alert_rules))
        self._rights.clear()
        # First, so that no acknowledgement is applied to an alert that has become worse since.
        await self.flush()
        for alert, (by, at) in (await self._store.read(queries.acknowledgements)).items():
            found = self.store.find(alert)
            if found is not None and self.owns(found.robot_id):
                self.acknowledge(alert, by, at)
        robots = await self._store.read(queries.list_robots)
        there = {each.id for each in robots}
        self._know_elsewhere(robots)
        for gone in {each.robot_id for each in self.store} - there:
            self.store.forget_robot(gone)
        for by_robot in (self._registered_at, self._daemon_started, self._unconfirmed, self._absent):
            for gone in by_robot.keys() - there:
                del by_robot[gone]
        self._controlled &= there
        self._all_active &= there
        self.version += 1

    async def purge(self) -> None:
        """Delete old alerts, and those over the limit.

        :raises Unavailable: the database can't be asked
        """
        while await self._store.write(queries.purge_alerts, self._wall() - kinds.RETENTION_SECONDS):
            pass

    # --- beginnings and ends ------------------------------------------------------------------------------

    def raise_alert(self, robot: RobotState, kind: str, about: str, level: str, text: str) -> None:
        """Raise an alert about a robot, or repeat an open one."""
        report = self.store.report(
            robot.robot_id, robot.name, robot.realm, kind, about, level, text, self._now()
        )
        self._publish(report)

    def end(self, robot: RobotState, kind: str, about: str = "") -> None:
        """End an alert, if it is open."""
        if self.store.find_open(robot.robot_id, kind, about) is not None:
            self._publish(self.store.end(robot.robot_id, kind, about, self._now()))

    def level_of(self, robot: RobotState, kind: str, about: str = "") -> str | None:
        """The level of an open alert; ``None`` if it is not open."""
        found = self.store.find_open(robot.robot_id, kind, about)
        return None if found is None else found.level

    def ended_since(self, robot: RobotState, kind: str, at: float) -> bool:
        """Whether an alert has ended after a time, Unix seconds, and is not open."""
        found = self.store.find_over(robot.robot_id, kind)
        return found is not None and found.over is not None and found.over >= at

    def parts_of(self, robot: RobotState, kind: str) -> list[str]:
        """The parts (``about``) of the open alerts of a kind."""
        return [each.about for each in self.store.open_of(robot.robot_id) if each.kind == kind]

    def name_of(self, principal: Principal, alert: AlertRecord) -> str:
        """The name of a user at the robot of an alert."""
        robot = self._registry.robot(alert.robot_id, alert.robot, alert.realm)
        return robot.name_of(principal.name, principal.realm)

    def acknowledge(self, alert_id: str, by: str, at: float) -> AlertRecord | None:
        """A user acknowledges an alert; returns it, if there is one."""
        found, changes = self.store.acknowledge(alert_id, by, at, self._now())
        self._publish(changes)
        return found

    def _now(self) -> Moment:
        return Moment(self._wall(), self._clock.seconds())

    def _publish(self, changes: Collection[AlertChange]) -> None:
        if self._states != self.store.states:
            self._states = self.store.states
            self.version += 1
        self.dispatcher.offer(changes)
        for change in changes:
            for listener in self._listeners:
                listener(change.event.value, change.alert)

    def _on_event(self, event: BusEvent) -> None:
        handle = self._handlers.get(event.kind)
        robot = None if event.robot_id is None else self._registry.find(event.robot_id)
        if handle is not None and robot is not None:
            handle(robot, event.data)

    def _came_online(self, robot: RobotState, data: dict[str, Any]) -> None:
        self._registered_at[robot.robot_id] = self._clock.seconds()
        self._all_active.discard(robot.robot_id)
        self._unconfirmed[robot.robot_id] = {
            (each.kind, each.about)
            for each in self.store.open_of(robot.robot_id)
            if each.kind not in kinds.RELAY_KINDS
        }
        self.end(robot, kinds.OFFLINE)

    def _stopped(self, robot: RobotState, data: dict[str, Any]) -> None:
        if self.owns(robot.robot_id) and self.level_of(robot, kinds.STOP) is None:
            text = stopped_by(str(data.get("user", "")), str(data.get("why", "")))
            self.raise_alert(robot, kinds.STOP, "", "warning", text)

    def _resumed(self, robot: RobotState, data: dict[str, Any]) -> None:
        # It may have been stopped again meanwhile.
        if self._controllers.snapshot(robot.robot_id).stopped is None:
            self.end(robot, kinds.STOP)

    def _robot_alert(self, robot: RobotState, data: dict[str, Any]) -> None:
        reported, part = str(data.get("alert_kind", "")), str(data.get("about", ""))
        if (reported, part) == (kinds.CONTROL, "") and not data.get("over"):
            self._controller_lost_by_robot(robot, str(data.get("text", "")))
            return
        kind, about = kinds.from_robot(reported, part)
        self._unconfirmed.get(robot.robot_id, set()).discard((kind, about))
        if data.get("over"):
            self.end(robot, kind, about)
        else:
            level = kinds.known_level(str(data.get("level", "")))
            self.raise_alert(robot, kind, about, level, str(data.get("text", "")))

    def _all_active_sent(self, robot: RobotState, data: dict[str, Any]) -> None:
        """End alerts that the robot has not reported again, where their kind has an end."""
        self._all_active.add(robot.robot_id)
        unconfirmed = self._unconfirmed.get(robot.robot_id, set())
        for kind, about in [each for each in unconfirmed if not kinds.endless(each[0])]:
            unconfirmed.discard((kind, about))
            self.end(robot, kind, about)

    def _control_lost(self, robot: RobotState, data: dict[str, Any]) -> None:
        if data.get("moving"):
            user, why = data.get("user", "a user"), data.get("why", "")
            text = f"{user} lost control while the robot moved: {why}"
            self.raise_alert(robot, kinds.CONTROL, "", "error", text)

    def _control_taken(self, robot: RobotState, data: dict[str, Any]) -> None:
        self._controlled.add(robot.robot_id)
        self.end(robot, kinds.CONTROL)

    def _key_used_twice(self, robot: RobotState, data: dict[str, Any]) -> None:
        text = (
            f"two daemons use the robot's key, at {data.get('addresses', '')}: stop one of them. If one is not yours, "
            "revoke the key and enroll the robot again"
        )
        self.raise_alert(robot, kinds.KEY, "", "error", text)

    def _audit_lost(self, robot: RobotState, data: dict[str, Any]) -> None:
        text = "audit entries about this robot are lost: the database could not be written for too long"
        self.raise_alert(robot, kinds.AUDIT, "", "error", text)

    def _controller_lost_by_robot(self, robot: RobotState, text: str) -> None:
        """The robot reports a loss of control; this is only new if it happened before this relay started."""
        if robot.robot_id not in self._controlled:
            self.raise_alert(robot, kinds.CONTROL, "", "error", text)

    # --- checks of robots ---------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._check_robots()
        except Exception:  # one failed check must not end all checks
            self.log.failure("checking robots for alerts failed")

    def _check_robots(self) -> None:
        now, wall = self._clock.seconds(), self._wall()
        self._runs += 1
        self._monitors.check(now, wall)
        for robot in self._registry:
            self._end_forgotten(robot, now)
        if self._runs % TOPICS_EVERY == 0:
            self._monitors.check_topics(now)
        if self._runs % SWEEP_EVERY == 0:
            self._publish(self.store.sweep(self._now(), self.owns))
            self.version += 1
        if self._absent and now - self._began >= ABSENT_SECONDS and self._leads():
            self._report_absent()
        if self.on_written is not None and self._runs % MIRROR_EVERY == 0:
            Deferred.fromCoroutine(self._mirror_stored()).addErrback(self._not_mirrored)
        self._flush_later()
        if self._shown != self.version:
            self._shown = self.version
            self._registry.changed()

    def _end_forgotten(self, robot: RobotState, now: float) -> None:
        """End alerts of a restarted daemon, which does not know them, and reports again what is wrong."""
        began, before = robot.description.started, self._daemon_started.get(robot.robot_id)
        if robot.control_link is None or began == before:
            return
        if before and now - self._registered_at.get(robot.robot_id, now) < REPORT_AGAIN_SECONDS:
            return
        self._daemon_started[robot.robot_id] = began
        for kind, about in self._unconfirmed.pop(robot.robot_id, ()) if before else ():
            self.end(robot, kind, about)

    def _report_absent(self) -> None:
        """Raise alerts about robots that have not come online since the relay started."""
        absent, self._absent = self._absent, {}
        for robot_id, (name, realm) in absent.items():
            robot = self._registry.robot(robot_id, name, realm)
            if (
                robot.control_link is None
                and not robot.elsewhere
                and robot.last_seen is None
                and self.level_of(robot, kinds.OFFLINE) is None
            ):
                self.raise_alert(
                    robot, kinds.OFFLINE, "", "error", "the robot has not come online since the relay started"
                )

    # --- writing ------------------------------------------------------------------------------------------

    def _flush_later(self) -> None:
        if self._writing is None:
            self._writing = Deferred.fromCoroutine(self.flush())
            self._writing.addErrback(
                lambda failure: self.log.debug("alerts wait to be written: {reason}", reason=failure.value)
            )
            self._writing.addBoth(self._flushed)

    def _flushed(self, _: object) -> None:
        self._writing = None

    async def flush(self) -> None:
        """Write all changed alerts to the database.

        :raises Unavailable: the database cannot be reached; the changes wait
        """
        # One flush at a time: with several writers an older state might overwrite a newer one.
        await self._write_lock.acquire()
        try:
            await self._write(self.store.take_changed())
        finally:
            self._write_lock.release()

    async def _write(self, changed: list[AlertRecord]) -> None:
        while changed:
            batch, changed = changed[:BATCH], changed[BATCH:]
            try:
                await self._store.write(queries.save_alerts, batch)
            except BaseException:  # also an unexpected error, and a cancelled flush
                self.store.put_back([*batch, *changed])
                raise
            if self.on_written is not None:
                self.on_written(batch)
            changed = changed or self.store.take_changed()

    # --- other relays of a cluster ------------------------------------------------------------------------

    def mirror(self, alerts: Collection[AlertRecord]) -> None:
        """Show what other relays have written too. Only the owner of a robot's alerts changes them afterwards."""
        for each in alerts:
            robot = self._registry.find(each.robot_id)
            if self.store.mirror(each, self._now()) and robot is not None and robot.control_link is not None:
                self._mirrored(robot, each)
        self._publish(())

    def _mirrored(self, robot: RobotState, alert: AlertRecord) -> None:
        """An alert has become known after its robot has connected here: it counts only if the robot reports it."""
        if alert.over is not None or alert.kind in kinds.RELAY_KINDS or alert.last >= robot.online_since:
            return
        if robot.robot_id not in self._all_active:
            self._unconfirmed.setdefault(robot.robot_id, set()).add((alert.kind, alert.about))
        elif not kinds.endless(alert.kind):
            self.end(robot, alert.kind, alert.about)

    async def _mirror_stored(self) -> None:
        """Find what other relays have written, in case their notices were lost."""
        since = self._wall() - kinds.SHOWN_SECONDS
        self.mirror(await self._store.read(queries.recent_alerts, since))
        self._know_elsewhere(await self._store.read(queries.list_robots))

    def _know_elsewhere(self, robots: Collection[RobotRecord]) -> None:
        """Know the robots of other relays, so that they are missed if they go."""
        for each in robots:
            if self._registry.is_elsewhere(each.id):
                self._registry.robot(each.id, each.name, each.realm)

    def _not_mirrored(self, failure: Any) -> None:
        if not failure.check(SwitchboardError):
            self.log.failure("the alerts of other relays could not be read", failure)

    def owns(self, robot_id: int) -> bool:
        """Whether the alerts of a robot are this relay's: the robot is here, or nowhere and this relay leads."""
        if self._registry.connected(robot_id):
            return True
        return not self._registry.is_elsewhere(robot_id) and self._leads()

    # --- rights -------------------------------------------------------------------------------------------

    async def _visible_ids(self, rule: AlertRuleRecord, alerts: Collection[AlertRecord]) -> set[str]:
        """The ids of the alerts that the rule's user may see now."""
        # The rule acts as its user, without a token.
        principal = Principal(rule.user_id, rule.user, rule.realm, False, 0, None)
        known = await self._access.robots(principal)
        cached, rights = self._rights.get(rule.user_id, (None, {}))
        if cached is not known:
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

    def _is_open(self, alert_id: str) -> bool:
        found = self.store.find(alert_id)
        return found is not None and found.over is None
