"""Control in memory: a robot that answers orders, connections that drive it, audit entries in a list."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from math import inf
from typing import Any, TypeVar
from unittest.mock import ANY

import msgspec
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_protocol import link
from relay_protocol.link.motion import ControlOrder
from relay_protocol.rights import Grant, Level, Rules
from relay_server.access import Permit, Principal
from relay_server.control.controller import RobotController
from relay_server.control.types import ControlRules
from relay_server.robots.registry import RobotRegistry
from tests.worlds.control_audit import MemoryRecord

O = TypeVar("O", bound=ControlOrder)  # noqa: E741  what else is an order called


class ControlLink:
    """A robot's control link, which executes orders at once unless it is silent.

    :param answer: takes the robot's messages
    :ivar silent: orders are stored, and not answered
    :ivar unable: why it cannot execute orders
    """

    def __init__(self, answer: Callable[[link.MotionState | link.OrderResult], None]) -> None:
        self._answer = answer
        self.said: list[link.Message] = []
        self.closed: str | None = None
        self.silent = False
        self.unable = ""

    def send(self, message: link.Message) -> None:
        """Stores the order, checks that a robot can read its JSON, and executes it."""
        msgspec.json.decode(msgspec.json.encode(message))
        self.said.append(message)
        if isinstance(message, ControlOrder) and not self.silent:
            self.answers(message)

    def answers(self, order: ControlOrder) -> None:
        """The robot reports that an order is done, or why not."""
        self._answer(link.OrderResult(id=order.id, ok=not self.unable, reason=self.unable))

    def close(self, reason: str) -> None:
        """The relay closes the link."""
        self.closed = self.closed or reason

    def orders(self, kind: type[O]) -> list[O]:
        """Orders of one kind so far."""
        return [message for message in self.said if isinstance(message, kind)]

    @property
    def holders(self) -> list[int]:
        """Holders that the robot was given, one after the other."""
        return [order.holder for order in self.orders(link.ControlGrant)]


class Connection:
    """A user's connection to the robot."""

    _numbers = itertools.count(1)

    def __init__(self, clock: Clock, name: str, level: Level, deny: tuple[str, ...] = ()) -> None:
        self.number = next(self._numbers)
        self.permit = Permit(Principal(self.number, name, "main", False, 1, None), 1, Rules())
        self.permit.rules = Rules([Grant(level, (), deny)])
        self.address = "192.0.2.7"
        self.opened = clock.seconds()
        self.reported: list[str] = []
        self.commanded = 0.0
        self.alive = inf
        """When it was heard last, as long as it has not let go."""
        self.changes = 0
        self.when_told: Callable[[], object] = lambda: None
        """Called whenever it is told something."""
        self._clock = clock

    @property
    def name(self) -> str:
        """Its user's name."""
        return self.permit.principal.name

    @property
    def user(self) -> int:
        """The number of its user."""
        return self.permit.principal.user_id

    def notify(self, level: str, text: str) -> None:
        """Stores it."""
        self.reported.append(text)
        self.when_told()

    def last_motion_at(self) -> float:
        """The time of its last command."""
        return self.commanded

    def last_command_at(self) -> float:
        """The same."""
        return self.commanded

    def last_alive_while_driving(self) -> float:
        """Set by the test."""
        return self.alive

    def control_changed(self) -> None:
        """Counts it."""
        self.changes += 1


class ControlWorld:
    """One robot and its control service, on a clock of the test."""

    def __init__(self, rules: ControlRules | None = None) -> None:
        self.clock = Clock()
        self.clock.advance(1000)
        self.registry = RobotRegistry(self.wall)
        self.robot = self.registry.robot(1, "rover", "main")
        self.record = MemoryRecord()
        self.changes = 0
        self.service = RobotController(
            clock=self.clock,
            robot=self.robot,
            record=self.record,
            stop_store=self.record,
            rules=rules or ControlRules(),
            changed=self._changed,
            wall=self.wall,
            clock_ns=self.now_ns,
        )
        self.link = ControlLink(self.service.message_received)

    def wall(self) -> float:
        """Unix time."""
        return 1.7e9 + self.clock.seconds()

    def now_ns(self) -> int:
        """The clock in nanoseconds."""
        return round(self.clock.seconds() * 1e9)

    def _changed(self) -> None:
        self.changes += 1

    def online(self) -> ControlWorld:
        """The robot registers."""
        self.link = ControlLink(self.service.message_received)
        self.registry.registered(self.robot, self.link)
        return self

    def offline(self) -> None:
        """Its link ends."""
        self.registry.lost(self.robot, self.link)

    def connection(
        self, name: str = "ann", level: Level = Level.OPERATOR, deny: tuple[str, ...] = ()
    ) -> Connection:
        """A new connection of a user."""
        return Connection(self.clock, name, level, deny)

    def holding(self, name: str = "ann", level: Level = Level.OPERATOR) -> Connection:
        """A connection with control."""
        client = self.connection(name, level)
        assert result(self.service.take(client, "")).success
        return client


def outcome(work: Any) -> list[Any]:
    """Starts a coroutine; the list gets its result or error as soon as there is one."""
    found: list[Any] = []
    running = work if isinstance(work, Deferred) else Deferred.fromCoroutine(work)
    running.addCallbacks(found.append, lambda failure: found.append(failure.value))
    return found


def result(work: Any) -> Any:
    """The result of work that must be done now."""
    found = outcome(work)
    assert found, "it still waits"
    if isinstance(found[0], BaseException):
        raise found[0]
    return found[0]


def stopped_by(by: str, why: str = "", *, confirmed: bool = True) -> dict[str, Any]:
    """``stopped`` of a robot that was stopped once, at any time."""
    return {"by": by, "why": why, "since": ANY, "confirmed": confirmed, "again": None}
