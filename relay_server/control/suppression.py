"""Suppressing what commands a topic, inhibiting what it says (SOM4R): the robot times both, this lets commands by."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_protocol import limits, link
from relay_protocol.errors import Invalid, Unavailable
from relay_server.common.clock import Clock, Timer, cancel, detached
from relay_server.control.audit import Actor, AuditSink
from relay_server.control.commands import NotDone, RobotCommands
from relay_server.robots.registry import RobotState

SLACK = 0.5
"""Seconds the relay lets commands by after a suppression should be over. The robot, which times it, judges them."""


def _ignore() -> None:
    """Nobody waits for the end."""


@dataclass(eq=False)
class _Inhibition:
    """That a topic is inhibited.

    :ivar who: its end, or that of his right, ends this
    :ivar over: called when it is over, however that comes
    :ivar gone: whether he has come to his end already
    """

    who: object
    over: Callable[[], None]
    timer: Timer
    gone: bool = False


class SuppressionService:
    """Who commands the topics of one robot for moments, and who keeps them silent.

    :param changed: called when others command
    """

    log = Logger()

    def __init__(
        self,
        clock: Clock,
        robot: RobotState,
        orders: RobotCommands,
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
        """By topic, whose commands are let by without control; replaced as a whole."""
        self._inhibited: dict[str, _Inhibition] = {}

    def suppress(self, actor: Actor, sources: list[int], resource: str, ms: int) -> Deferred[None]:
        """For so long only these sources command a topic.

        :param ms: 50 to 200, or 0 to end it
        :raises Invalid: another time
        :raises Unavailable: too many topics are
        """
        least, most = limits.SUPPRESS_MS
        if ms != 0 and not least <= ms <= most:
            raise Invalid(f"'ms' must be {least} to {most}, or 0 to end it, not {ms}")
        self._check_room(resource)
        return detached(self._suppress(actor, sources[: limits.SOURCES], resource, ms))

    async def _suppress(self, actor: Actor, sources: list[int], resource: str, ms: int) -> None:
        await self._orders.give(
            lambda id: link.Suppress(id=id, resource=resource, sources=sources, ms=ms, by=actor.name[:255])
        )
        if ms == 0:
            self._forget([resource])
            return
        self._until[resource] = self._clock.seconds() + ms / 1000 + SLACK
        self._clock.callLater(ms / 1000 + SLACK, self._look, resource)
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
        who: object = None,
        over: Callable[[], None] = _ignore,
    ) -> Deferred[None]:
        """For so long a topic says nothing, or its last value.

        :param ms: at most 60,000; 0 ends it
        :param who: whose end ends it, by :meth:`ends`
        :param over: called when it is over, however that comes
        :raises Invalid: another time
        :raises Unavailable: too many topics are
        """
        if not 0 <= ms <= limits.INHIBIT_MS:
            raise Invalid(f"'ms' must be 1 to {limits.INHIBIT_MS}, or 0 to end it, not {ms}")
        if ms and resource not in self._inhibited and len(self._inhibited) >= limits.FACTS:
            raise Unavailable(f"{limits.FACTS} topics of robot {self._robot.name} are inhibited already")
        self._inhibition_over(resource)
        if ms:
            timer = self._clock.callLater(ms / 1000 + SLACK, self._inhibition_over, resource)
            self._inhibited[resource] = _Inhibition(who, over, timer)
        else:
            over()
        return detached(self._inhibit(actor, resource, ms, hold, self._inhibited.get(resource)))

    async def _inhibit(
        self, actor: Actor, resource: str, ms: int, hold: bool, begun: _Inhibition | None
    ) -> None:
        try:
            await self._orders.give(
                lambda id: link.Inhibit(id=id, resource=resource, ms=ms, hold=hold, by=actor.name[:255])
            )
        except NotDone:
            if begun is not None and self._inhibited.get(resource) is begun:
                self._inhibition_over(resource)
            raise
        if ms:
            self._record.note("robot.inhibited", self._robot, actor, audit=False, resource=resource, ms=ms)

    def ends(self, who: object, allowed: Callable[[str], bool]) -> None:
        """Somebody is there no more, or has other rights: what he may not inhibit now is inhibited no more.

        :param allowed: whether he may inhibit a topic
        """
        for resource, each in self._inhibited.items():
            each.gone = each.gone or (each.who is who and not allowed(resource))
        self.came()

    def came(self) -> None:
        """The robot is there: it is told what is inhibited no more."""
        if self._robot.control is None:
            return
        for resource in [resource for resource, each in self._inhibited.items() if each.gone]:
            self._inhibition_over(resource)
            self._orders.give(partial(_end, resource), always=True).addErrback(self._not_ended, resource)

    def _inhibition_over(self, resource: str) -> None:
        inhibition = self._inhibited.pop(resource, None)
        if inhibition is not None:
            cancel(inhibition.timer)
            inhibition.over()

    def _not_ended(self, failure: Any, resource: str) -> None:
        """Its time ends it."""
        self.log.warn("{topic} may still be inhibited: {reason}", topic=resource, reason=failure.value)

    def lost(self) -> None:
        """The robot's link is gone, and with it what held there."""
        self._forget(list(self.sources))

    def _check_room(self, resource: str) -> None:
        if resource not in self.sources and len(self.sources) >= limits.FACTS:
            raise Unavailable(f"{limits.FACTS} topics of robot {self._robot.name} are suppressed already")

    def _look(self, resource: str) -> None:
        if self._until.get(resource, 0.0) <= self._clock.seconds():
            self._forget([resource])

    def _forget(self, resources: list[str]) -> None:
        gone = [resource for resource in resources if self._until.pop(resource, None) is not None]
        if gone:
            self.sources = {topic: who for topic, who in self.sources.items() if topic not in gone}
            self._changed()


def _end(resource: str, id: int) -> link.Inhibit:
    return link.Inhibit(id=id, resource=resource, ms=0, by="the relay")
