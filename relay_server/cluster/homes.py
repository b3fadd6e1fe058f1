"""The home of each robot: the relay of the cluster that its control link ends at.

All that belongs to a robot is at its home: control, stops, subscriptions, recordings. The other relays pass requests
and websockets for the robot on to it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol
from weakref import WeakSet

import msgspec
from sqlalchemy.orm import Session
from twisted.internet.defer import Deferred
from twisted.internet.task import LoopingCall
from twisted.logger import Logger

from relay_db import queries
from relay_db.queries import HomeRelayRecord
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.cluster.bus import ClusterBus
from relay_server.cluster.relays import RelayDirectory, RelayInfo
from relay_server.common.database import AsyncDatabase
from relay_server.robots.registry import ControlLinkPort, RobotRegistry, RobotState

SUBJECT = "homes"
REGISTER_SECONDS = 10.0
"""Seconds in which a robot is registered, after this relay was recorded as its home: its stored stop is read first."""

READ_SECONDS = 2.0
"""Seconds between reads of the homes of all robots, for notices that were lost."""


class HomeNotice(msgspec.Struct, array_like=True, frozen=True):
    """A notice of the bus that a robot has connected to a relay; the fields of :class:`HomeRelayRecord`.

    :param address: network address of the robot; empty: not known
    """

    robot_id: int
    relay: str
    epoch: int
    address: str = ""


class RobotHomes(Protocol):
    """Where robots are connected. A single relay uses :class:`SingleHome`, a cluster :class:`ClusterHomes`."""

    async def connecting(
        self, robot: RobotState, address: str, connected: Callable[[], bool] = lambda: True
    ) -> None:
        """A robot has proved its identity here, and is registered next.

        :param address: its network address
        :param connected: whether its connection is still open; may be called by any thread
        :raises SwitchboardError: its home could not be recorded, or it has connected to another relay meanwhile
        """

    def disconnected(self, robot: RobotState) -> None:
        """The control link of a robot has ended here, and it has no newer one here."""

    def elsewhere(self, robot_id: int) -> RelayInfo | None:
        """The other relay that a robot is connected to; ``None``: it is connected here or to no live relay."""

    def other(self, relay: str) -> RelayInfo | None:
        """Another live relay by its id; ``None``: it is this one, or there is none."""


class SingleHome:
    """The only relay is the home of all robots (:class:`RobotHomes`)."""

    async def connecting(
        self, robot: RobotState, address: str, connected: Callable[[], bool] = lambda: True
    ) -> None:
        """Nothing is recorded."""

    def disconnected(self, robot: RobotState) -> None:
        """Nothing is recorded."""

    def elsewhere(self, robot_id: int) -> RelayInfo | None:
        """There is no other relay."""
        return None

    def other(self, relay: str) -> RelayInfo | None:
        """There is no other relay."""
        return None


class ClusterHomes:
    """Homes in the database, with a notice by the bus at each change (:class:`RobotHomes`).

    :param own: id of this relay
    """

    log = Logger()

    def __init__(
        self,
        reactor: Any,
        database: AsyncDatabase,
        robots: RobotRegistry,
        bus: ClusterBus,
        relays: RelayDirectory,
        own: str,
    ) -> None:
        self._database = database
        self._robots = robots
        self._bus = bus
        self._relays = relays
        self._own = own
        self._homes: dict[int, HomeRelayRecord] = {}
        self._connecting: Counter[int] = Counter()
        """Robots that are about to be registered here, by the number of their connections."""
        self._recorded: dict[int, float] = {}
        """When this relay was last recorded as the home of a robot that has not disconnected since."""
        self._seconds = reactor.seconds
        self._closed: WeakSet[ControlLinkPort] = WeakSet()
        """Links that were closed because their robots have newer ones elsewhere."""
        self.on_moved: Callable[[RobotState], object] = lambda robot: None
        """Called with a robot that clients are connected to here, after it has connected to another relay."""
        self.on_key_used_twice: Callable[[RobotState, str, str], None] = lambda robot, newer, older: None
        """Called with both addresses if a link here answers after the key was proved at another relay."""
        self.on_home: Callable[[int, str], object] = lambda robot_id, relay: None
        """Called with the number of a robot that has connected to a relay, and the relay's id."""
        self._unsubscribe = _nothing
        self._loop = LoopingCall(self._update)
        self._loop.clock = reactor

    async def start(self) -> None:
        """Read all homes, and follow changes.

        :raises Unavailable: the database does not answer
        """
        self._unsubscribe = self._bus.subscribe(SUBJECT, self._received)
        await self._read()
        self._loop.start(READ_SECONDS, now=False)

    def stop(self) -> None:
        """Follow no more changes."""
        self._unsubscribe()
        if self._loop.running:
            self._loop.stop()

    # --- robots of this relay -----------------------------------------------------------------------------

    async def connecting(
        self, robot: RobotState, address: str, connected: Callable[[], bool] = lambda: True
    ) -> None:
        """See :meth:`RobotHomes.connecting`."""
        self._connecting[robot.robot_id] += 1
        try:
            epoch = await self._database.write(_claim, robot.robot_id, self._own, connected)
        finally:
            self._connecting[robot.robot_id] -= 1
            self._connecting += Counter()
        known = self._homes.get(robot.robot_id)
        if known is not None and known.epoch > epoch:
            raise Unavailable("the robot has connected to another relay meanwhile")
        self._recorded[robot.robot_id] = self._seconds()
        self._announce(HomeNotice(robot.robot_id, self._own, epoch, address))

    def disconnected(self, robot: RobotState) -> None:
        """See :meth:`RobotHomes.disconnected`."""
        self._recorded.pop(robot.robot_id, None)
        home = self._homes.get(robot.robot_id)
        if home is None or home.relay != self._own:
            return
        self._release(home)

    def _release(self, home: HomeRelayRecord) -> None:
        self._announce(HomeNotice(home.robot_id, "", home.epoch))
        release = self._database.write(queries.release_home_relay, home.robot_id, self._own, home.epoch)
        Deferred.fromCoroutine(release).addErrback(self._not_released)

    def _not_released(self, failure: Any) -> None:
        """The others will find that this relay does not know the robot, or that it is gone."""
        if not failure.check(SwitchboardError):
            self.log.failure("the home of a robot could not be released", failure)

    def _announce(self, home: HomeNotice) -> None:
        self._apply(HomeRelayRecord(home.robot_id, home.relay, home.epoch))
        self._bus.publish(SUBJECT, msgspec.json.encode(home))

    # --- robots of all relays -----------------------------------------------------------------------------

    def elsewhere(self, robot_id: int) -> RelayInfo | None:
        """See :meth:`RobotHomes.elsewhere`."""
        home = self._homes.get(robot_id)
        return None if home is None else self.other(home.relay)

    def other(self, relay: str) -> RelayInfo | None:
        """See :meth:`RobotHomes.other`."""
        return None if relay in ("", self._own) else self._relays.find(relay)

    def count(self, relay: str) -> int:
        """The number of robots whose home is a relay.

        :param relay: its id
        """
        return sum(home.relay == relay for home in self._homes.values())

    def relays_changed(self) -> None:
        """Relays have come or gone."""
        for robot_id in self._homes:
            self._update_elsewhere(robot_id)

    def _update_elsewhere(self, robot_id: int) -> None:
        elsewhere = self.elsewhere(robot_id) is not None
        self._robots.set_elsewhere(robot_id, elsewhere=elsewhere)
        robot = self._robots.find(robot_id)
        if elsewhere and robot is not None:
            self.on_moved(robot)

    def _received(self, subject: str, body: bytes) -> None:
        try:
            home = msgspec.json.decode(body, type=HomeNotice)
        except msgspec.DecodeError as error:
            self.log.error("a notice of the bus can't be read: {error}", error=error, limited="notice")
            return
        self._apply(HomeRelayRecord(home.robot_id, home.relay, home.epoch), home.address)

    def _apply(self, home: HomeRelayRecord, address: str = "") -> None:
        """Take over what is newer than what is known.

        :param address: of the robot; empty: not known
        """
        known = self._homes.get(home.robot_id)
        new = known is None or (known.epoch, known.relay == "") < (home.epoch, home.relay == "")
        if new:
            self._homes[home.robot_id] = home
        # A link that was registered here after the notice came is found by the next read.
        self._close_older(self._homes[home.robot_id], address)
        if new:
            self._update_elsewhere(home.robot_id)
        if new and home.relay:
            self.on_home(home.robot_id, home.relay)

    def _close_older(self, home: HomeRelayRecord, address: str) -> None:
        """Close a robot's link here if the robot has a newer one at another relay."""
        robot = self._robots.find(home.robot_id)
        link = None if robot is None else robot.control_link
        if robot is None or link is None or home.relay in ("", self._own) or link in self._closed:
            return
        self._closed.add(link)
        self._close_link(robot, link, home.relay, address)

    def _close_link(self, robot: RobotState, older: ControlLinkPort, relay: str, address: str) -> None:
        """Close a robot's link here, because the robot has connected to another relay."""
        self.log.info("robot {robot} has connected to another relay", robot=robot.full)
        if not address:
            other = self._relays.find(relay)
            address = f"unknown address at {'another relay' if other is None else f'relay {other.host}'}"
        used_twice = partial(self.on_key_used_twice, robot, address, robot.address)
        older.close_replaced("the robot has connected to another relay", used_twice)

    async def _read(self) -> None:
        records = await self._database.read(queries.home_relays)
        for home in records:
            if home.relay == self._own and not self._is_here(home.robot_id):
                # It was not released while the database did not answer.
                self._release(home)
                continue
            self._apply(home)
            if home.relay == "" and self._is_registered(home.robot_id):
                # A connection to another relay was given up after that had been recorded, so this one counts.
                await self._claim_again(home)

    async def _claim_again(self, home: HomeRelayRecord) -> None:
        """Record that a robot is connected here, unless it has connected to another relay since that was read."""
        epoch = await self._database.write(queries.reclaim_home_relay, home.robot_id, self._own, home.epoch)
        if epoch is not None and self._is_registered(home.robot_id):
            self._announce(HomeNotice(home.robot_id, self._own, epoch))

    def _is_registered(self, robot_id: int) -> bool:
        robot = self._robots.find(robot_id)
        return robot is not None and robot.control_link is not None and robot.control_link not in self._closed

    def _is_here(self, robot_id: int) -> bool:
        """Whether a robot is registered here, or is about to be."""
        robot = self._robots.find(robot_id)
        recorded = self._recorded.get(robot_id)
        return (
            bool(self._connecting[robot_id])
            or (robot is not None and robot.control_link is not None)
            or (recorded is not None and self._seconds() - recorded < REGISTER_SECONDS)
        )

    def _update(self) -> Deferred[None]:
        return Deferred.fromCoroutine(self._read()).addErrback(self._not_read)

    def _not_read(self, failure: Any) -> None:
        if not failure.check(SwitchboardError):
            self.log.failure("reading the homes of robots failed", failure)


def _claim(s: Session, robot_id: int, relay: str, connected: Callable[[], bool]) -> int:
    """:raises Unavailable: the robot has gone while the database was busy; its connection elsewhere must count"""
    if not connected():
        raise Unavailable("the robot has disconnected")
    return queries.claim_home_relay(s, robot_id, relay)


def _nothing() -> None:
    """Nothing is subscribed yet."""
