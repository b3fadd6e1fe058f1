"""Emptying a relay of a cluster before it ends: its robots dial the other relays, then its clients connect to them."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable, Sequence
from contextlib import suppress
from typing import Any

import msgspec
from twisted.internet.defer import Deferred
from twisted.internet.task import deferLater
from twisted.logger import Logger

from relay_protocol.errors import Unavailable
from relay_server.robots.registry import RobotState

ASK_SECONDS = 10.0
"""Seconds within which all robots are asked to dial another relay."""
ASK_INTERVAL = 0.1
"""Most seconds between two robots."""
MOVE_SECONDS = 10.0
"""Seconds that robots have to connect to another relay, after the last one was asked."""
POLL_SECONDS = 0.1
RETRY_SECONDS = 1.0
"""Seconds after which a robot that dials this relay is asked to dial again: a load balancer may need them to notice."""
DRAINING = "this relay is being drained; connect again, to another relay"


class DrainState(msgspec.Struct, frozen=True):
    """How far a drain is.

    :param robots: connected to this relay
    :param done: whether all robots that move have moved, and clients were asked to connect again
    """

    robots: int
    done: bool


class Drain:
    """
    :param robots: that this relay knows
    :param others: whether the cluster has another relay that takes robots
    :ivar begun: no robot is taken any more
    """

    log = Logger()

    def __init__(
        self, reactor: Any, robots: Iterable[RobotState], others: Callable[[], Awaitable[bool]]
    ) -> None:
        self.begun = False
        self.close_clients: Sequence[Callable[[str], object]] = ()
        """Functions that together close the websockets of all clients, with a reason."""
        self._reactor = reactor
        self._robots = robots
        self._others = others
        self._done: Deferred[None] | None = None

    @property
    def state(self) -> DrainState:
        """The state now."""
        return DrainState(len(self._connected()), self._done is not None and self._done.called)

    async def begin(self) -> None:
        """Begin to drain, if that has not begun yet.

        :raises Unavailable: no other relay could take over
        """
        if self.begun:
            return
        # Before the others are asked: of two relays that are drained at the same time, neither counts on the other.
        self.begun = True
        try:
            if not await self._others():
                raise Unavailable(
                    "there is no other relay that could take over the robots of this one; stop this relay instead"
                )
        except BaseException:
            self.begun = False
            raise
        self.log.info("this relay is drained")
        self._done = Deferred.fromCoroutine(self._run())
        self._done.addErrback(lambda failure: self.log.failure("the drain failed", failure))

    async def run(self) -> None:
        """Drain this relay if there are others; returns when that is done."""
        with suppress(Unavailable):
            await self.begin()
        while self.begun and not self.state.done:
            await deferLater(self._reactor, POLL_SECONDS)

    async def _run(self) -> None:
        robots = self._connected()
        interval = min(ASK_INTERVAL, ASK_SECONDS / max(1, len(robots)))
        for robot in robots:
            if robot.control_link is not None:
                robot.control_link.close(DRAINING)
            await deferLater(self._reactor, interval)
        end = self._reactor.seconds() + MOVE_SECONDS
        while not all(robot.elsewhere for robot in robots) and self._reactor.seconds() < end:
            await deferLater(self._reactor, POLL_SECONDS)
        missing = sum(not robot.elsewhere for robot in robots)
        self.log.info(
            "drained: {count} robots asked, {missing} of them not seen at another relay",
            count=len(robots),
            missing=missing,
        )
        for close in self.close_clients:
            close(DRAINING)

    def _connected(self) -> list[RobotState]:
        """Robots at this relay; unused ones first."""
        robots = [each for each in self._robots if each.control_link is not None]
        return sorted(robots, key=lambda each: (each.users + len(each.viewers), each.robot_id))
