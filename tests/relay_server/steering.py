"""Control in memory: a robot that answers orders, connections that want to drive it, a record in a list."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from math import inf
from typing import Any, TypeVar

import msgspec
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_protocol import link
from relay_protocol.link.motion import Order
from relay_protocol.rights import Grant, Level, Rules
from relay_server.access import Permit, Principal
from relay_server.control.controller import RobotController
from relay_server.control.types import ControlRules
from relay_server.robots.registry import RobotRegistry
from tests.relay_server.control_record import MemoryRecord

O = TypeVar("O", bound=Order)  # noqa: E741  what else is an order called


class ControlLink:
    """A robot's control link: it does as it is told at once, unless it is to keep silent.

    :param answer: takes what the robot says
    :ivar silent: orders are kept, and not answered
    :ivar unable: why it can't do what it is told
    """

    def __init__(self, answer: Callable[[link.Safety | link.Done], None]) -> None:
        self._answer = answer
        self.said: list[link.Message] = []
        self.closed: str | None = None
        self.silent = False
        self.unable = ""

    def send(self, message: link.Message) -> None:
        """Keep it, once it has proved to be JSON that a robot can read, and carry it out."""
        msgspec.json.decode(msgspec.json.encode(message))
        self.said.append(message)
        if isinstance(message, Order) and not self.silent:
            self.answers(message)

    def answers(self, order: Order) -> None:
        """The robot has carried out an order, or says why not."""
        self._answer(link.Done(id=order.id, ok=not self.unable, reason=self.unable))

    def close(self, reason: str) -> None:
        """The relay hangs up."""
        self.closed = self.closed or reason

    def orders(self, kind: type[O]) -> list[O]:
        """Orders of one kind so far."""
        return [message for message in self.said if isinstance(message, kind)]

    @property
    def holders(self) -> list[int]:
        """Whom the robot was told to obey, one after the other."""
        return [order.holder for order in self.orders(link.Control)]


class Connection:
    """Somebody connected to the robot."""

    _numbers = itertools.count(1)

    def __init__(self, clock: Clock, name: str, level: Level, deny: tuple[str, ...] = ()) -> None:
        self.number = next(self._numbers)
        self.permit = Permit(Principal(self.number, name, "main", False, 1, None), 1, Rules())
        self.permit.rules = Rules([Grant(level, (), deny)])
        self.address = "192.0.2.7"
        self.opened = clock.seconds()
        self.told: list[str] = []
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
        """Whose it is."""
        return self.permit.principal.user_id

    def tell(self, level: str, text: str) -> None:
        """Keep it."""
        self.told.append(text)
        self.when_told()

    def driving_since(self) -> float:
        """When it last commanded."""
        return self.commanded

    def commanding_since(self) -> float:
        """The same."""
        return self.commanded

    def heard_driving(self) -> float:
        """As the test says."""
        return self.alive

    def control_changed(self) -> None:
        """Count it."""
        self.changes += 1


class Place:
    """One robot and its desk, on a clock of the test's own."""

    def __init__(self, rules: ControlRules | None = None) -> None:
        self.clock = Clock()
        self.clock.advance(1000)
        self.registry = RobotRegistry(self.wall)
        self.robot = self.registry.presence(1, "rover", "main")
        self.record = MemoryRecord()
        self.changes = 0
        self.desk = RobotController(
            self.clock,
            self.robot,
            self.record,
            rules or ControlRules(),
            self._changed,
            self.wall,
            self.now_ns,
        )
        self.link = ControlLink(self.desk.told)

    def wall(self) -> float:
        """Unix time."""
        return 1.7e9 + self.clock.seconds()

    def now_ns(self) -> int:
        """The clock in nanoseconds."""
        return round(self.clock.seconds() * 1e9)

    def _changed(self) -> None:
        self.changes += 1

    def online(self) -> Place:
        """The robot registers."""
        self.link = ControlLink(self.desk.told)
        self.registry.registered(self.robot, self.link)
        return self

    def offline(self) -> None:
        """Its link ends."""
        self.registry.lost(self.robot, self.link)

    def connection(
        self, name: str = "ann", level: Level = Level.OPERATOR, deny: tuple[str, ...] = ()
    ) -> Connection:
        """Somebody comes."""
        return Connection(self.clock, name, level, deny)

    def holding(self, name: str = "ann", level: Level = Level.OPERATOR) -> Connection:
        """Somebody who has control."""
        client = self.connection(name, level)
        assert result(self.desk.take(client, "")).success
        return client


def outcome(work: Any) -> list[Any]:
    """Start a coroutine; the list holds its result or its error as soon as there is one."""
    found: list[Any] = []
    running = work if isinstance(work, Deferred) else Deferred.fromCoroutine(work)
    running.addCallbacks(found.append, lambda failure: found.append(failure.value))
    return found


def result(work: Any) -> Any:
    """What comes of something that must be done now."""
    found = outcome(work)
    assert found, "it still waits"
    if isinstance(found[0], BaseException):
        raise found[0]
    return found[0]
