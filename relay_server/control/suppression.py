"""Suppression of commands to a topic, and inhibition of its messages (SOM4R). The robot times both."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_protocol import limits, link
from relay_protocol.errors import Invalid, Unavailable
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.concurrency import detached
from relay_server.common.errors import NotDone
from relay_server.control.actor import Actor
from relay_server.control.orders import ControlOrders
from relay_server.control.records import AuditSink
from relay_server.robots.registry import RobotState

SLACK = 0.5
"""Seconds for which the relay still passes commands after a suppression should have ended; the robot decides."""


def ignore() -> None:
    """Do nothing."""


@dataclass(eq=False)
class _Inhibition:
    """An inhibited topic.

    :ivar owner: the inhibition ends when the owner leaves or loses the right
    :ivar ended: called when it has ended, for any reason
    :ivar to_end: whether the owner has left or lost the right
    """

    owner: object
    ended: Callable[[], None]
    timer: Timer
    to_end: bool = False


class SuppressionService:
    """Keeps which sources suppress others on the topics of one robot, and which topics are inhibited.

    :param changed: called when :attr:`sources` has changed
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        robot: RobotState,
        orders: ControlOrders,
        record: AuditSink,
        changed: Callable[[], None],
    ) -> None:
        self._clock = clock
        self._robot = robot
        self._orders = orders
        self._record = record
        self._changed = changed
        self._until: dict[str, float] = {}
        self.sources: Mapping[str, frozenset[int]] = {}
        """By topic, the sources whose commands pass without control; replaced as a whole."""
        self._inhibited: dict[str, _Inhibition] = {}

    def suppress(self, actor: Actor, sources: list[int], resource: str, ms: int) -> Deferred[None]:
        """Let only these sources command a topic for a time.

        :param ms: 50 to 200 milliseconds, or 0 to end it
        :raises Invalid: ``ms`` is out of range
        :raises Unavailable: too many topics are suppressed, or inhibited
        """
        least, most = limits.SUPPRESS_MS
        if ms != 0 and not least <= ms <= most:
            raise Invalid(f"'ms' must be {least} to {most}, or 0 to end it, not {ms}")
        self._check_room(resource)
        return detached(self._suppress(actor, sources[: limits.SOURCES], resource, ms))

    async def _suppress(self, actor: Actor, sources: list[int], resource: str, ms: int) -> None:
        await self._orders.send(
            lambda id: link.Suppress(id=id, resource=resource, sources=sources, ms=ms, by=actor.name[:255])
        )
        if ms == 0:
            self._forget([resource])
            return
        self._until[resource] = self._clock.seconds() + ms / 1000 + SLACK
        self._clock.callLater(ms / 1000 + SLACK, self._check_expired, resource)
        if self.sources.get(resource) != frozenset(sources):
            self.sources = {**self.sources, resource: frozenset(sources)}
            self._changed()
            self._record.note("robot.suppressed", self._robot, actor, audit=False, resource=resource)

    def inhibit(
        self,
        actor: Actor,
        resource: str,
        ms: int,
        hold: bool,
        owner: object = None,
        ended: Callable[[], None] = ignore,
    ) -> Deferred[None]:
        """Have a topic deliver nothing, or its last value, for a time.

        :param ms: at most 60,000 milliseconds; 0 ends it
        :param owner: its end ends the inhibition, by :meth:`end_of`
        :param ended: called when it has ended, for any reason
        :raises Invalid: ``ms`` is out of range
        :raises Unavailable: too many topics are suppressed, or inhibited
        """
        if not 0 <= ms <= limits.INHIBIT_MS:
            raise Invalid(f"'ms' must be 1 to {limits.INHIBIT_MS}, or 0 to end it, not {ms}")
        if ms and resource not in self._inhibited and len(self._inhibited) >= limits.LIST_ITEMS:
            raise Unavailable(f"{limits.LIST_ITEMS} topics of robot {self._robot.name} are inhibited already")
        self._drop_inhibition(resource)
        if ms:
            timer = self._clock.callLater(ms / 1000 + SLACK, self._drop_inhibition, resource)
            self._inhibited[resource] = _Inhibition(owner, ended, timer)
        else:
            ended()
        return detached(self._inhibit(actor, resource, ms, hold, self._inhibited.get(resource)))

    async def _inhibit(
        self, actor: Actor, resource: str, ms: int, hold: bool, begun: _Inhibition | None
    ) -> None:
        try:
            await self._orders.send(
                lambda id: link.Inhibit(id=id, resource=resource, ms=ms, hold=hold, by=actor.name[:255])
            )
        except NotDone:
            if begun is not None and self._inhibited.get(resource) is begun:
                self._drop_inhibition(resource)
            raise
        if ms:
            self._record.note("robot.inhibited", self._robot, actor, audit=False, resource=resource, ms=ms)

    def end_of(self, owner: object, allowed: Callable[[str], bool]) -> None:
        """End the inhibitions of an owner that has left or lost the right.

        :param allowed: whether the owner may inhibit a topic
        """
        for resource, each in self._inhibited.items():
            each.to_end = each.to_end or (each.owner is owner and not allowed(resource))
        self.robot_online()

    def robot_online(self) -> None:
        """Send the robot the inhibitions that are to end."""
        if self._robot.control_link is None:
            return
        for resource in [resource for resource, each in self._inhibited.items() if each.to_end]:
            self._drop_inhibition(resource)
            self._orders.send(partial(_end_message, resource), always=True).addErrback(
                self._not_ended, resource
            )

    def _drop_inhibition(self, resource: str) -> None:
        inhibition = self._inhibited.pop(resource, None)
        if inhibition is not None:
            cancel(inhibition.timer)
            inhibition.ended()

    def _not_ended(self, failure: Any, resource: str) -> None:
        """Log that an inhibition was not ended; it ends when its time is over."""
        self.log.warn("{topic} may still be inhibited: {reason}", topic=resource, reason=failure.value)

    def link_lost(self) -> None:
        """Forget all suppressions, as the robot's link is lost."""
        self._forget(list(self.sources))

    def _check_room(self, resource: str) -> None:
        if resource not in self.sources and len(self.sources) >= limits.LIST_ITEMS:
            raise Unavailable(
                f"{limits.LIST_ITEMS} topics of robot {self._robot.name} are suppressed already"
            )

    def _check_expired(self, resource: str) -> None:
        if self._until.get(resource, 0.0) <= self._clock.seconds():
            self._forget([resource])

    def _forget(self, resources: list[str]) -> None:
        gone = [resource for resource in resources if self._until.pop(resource, None) is not None]
        if gone:
            self.sources = {topic: numbers for topic, numbers in self.sources.items() if topic not in gone}
            self._changed()


def _end_message(resource: str, id: int) -> link.Inhibit:
    return link.Inhibit(id=id, resource=resource, ms=0, by="the relay")
