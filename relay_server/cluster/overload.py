"""An overloaded relay of a cluster has some of its robots dial others, while those have room.

Robots that people or programs depend on at this moment stay: see :attr:`OverloadRelief.stays`. A robot that comes back,
because it has only one address, is not asked again for an hour.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.task import LoopingCall
from twisted.logger import Logger

from relay_server.robots.registry import RobotState

CHECK_SECONDS = 10.0
"""Seconds over which the load is averaged."""
OVERLOADED = 0.85
"""Share of a core that a relay which uses one core should not use for long."""
MOST_CHECKS = 3
"""So many averages in a row must be over it, also after some robots were asked."""
AGAIN_SECONDS = 3600.0
"""Seconds in which a robot is not asked again."""
ROOM = 0.5
"""Share of a core that another relay may use at most, to be counted on."""
ASKED_SHARE = 0.05
"""Share of the robots that are asked at a time, one at least."""
OVERLOAD = "this relay is overloaded; connect again, to another relay"


class OverloadRelief:
    """
    :param robots: that this relay knows
    :param cpu: returns the share of a core that this relay uses
    :param others: the shares of the other relays that take robots
    :ivar stays: whether a robot must not be asked now: it is driven, recorded, or used by the relay's own programs
    """

    log = Logger()

    def __init__(
        self,
        reactor: Any,
        robots: Iterable[RobotState],
        cpu: Callable[[], float],
        others: Callable[[], Awaitable[list[float]]],
    ) -> None:
        self.stays: Callable[[RobotState], bool] = lambda robot: False
        self._robots = robots
        self._cpu = cpu
        self._others = others
        self._over = 0
        self._seconds = reactor.seconds
        self._asked: dict[int, float] = {}
        """When robots were asked, by number. One that is here again has nowhere else to go."""
        self._loop = LoopingCall(self._check)
        self._loop.clock = reactor

    def start(self) -> None:
        """Check the load from now on."""
        self._loop.start(CHECK_SECONDS, now=False)

    def stop(self) -> None:
        """Check no more."""
        if self._loop.running:
            self._loop.stop()

    def _check(self) -> Deferred[None]:
        self._over = self._over + 1 if self._cpu() >= OVERLOADED else 0
        return Deferred.fromCoroutine(self._relieve()).addErrback(
            lambda failure: self.log.failure("the load could not be checked", failure)
        )

    async def _relieve(self) -> None:
        if self._over < MOST_CHECKS:
            return
        self._over = 0
        room = [share for share in await self._others() if share <= ROOM]
        if not room:
            self.log.warn("this relay is overloaded, and no other has room", limited="overload")
            return
        now = self._seconds()
        self._asked = {number: at for number, at in self._asked.items() if now - at < AGAIN_SECONDS}
        connected = [each for each in self._robots if each.control_link is not None]
        movable = [each for each in connected if each.robot_id not in self._asked and not self.stays(each)]
        # Those that are used make the load.
        movable.sort(key=lambda each: (-(each.users + len(each.viewers)), each.robot_id))
        chosen = movable[: max(1, int(ASKED_SHARE * len(connected)))]
        if not chosen:
            self.log.warn(
                "this relay is overloaded, and all its robots are in use or were asked before",
                limited="overload",
            )
            return
        for robot in chosen:
            self._asked[robot.robot_id] = now
            if robot.control_link is not None:
                robot.control_link.close(OVERLOAD)
        self.log.warn(
            "this relay is overloaded: {count} of {all} robots are asked to connect to another one",
            count=len(chosen),
            all=len(connected),
        )
