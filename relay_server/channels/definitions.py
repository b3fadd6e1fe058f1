"""Which types a robot can tell the definition of, asked for once on each link."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from twisted.internet.defer import Deferred, fail, succeed

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_protocol.ros import common
from relay_protocol.ros.definition import normalise, source_of
from relay_server.channels.robot_link import ChannelPort, RobotLinkState

PATIENCE = 2.0
"""A robot that speaks JSON has this long to tell a definition, seconds; then its JSON goes unchecked."""

UNCHECKED = 4096
"""Most names of types that are kept because a robot has no definition of them."""


class _Asked(NamedTuple):
    """A definition the robot was asked for.

    :param names: of the types that are wanted of it
    :param waiting: for each of those who wait, with the type
    """

    names: dict[str, None]
    waiting: list[tuple[str, Deferred[None]]]


class Definitions:
    """Asks the robot for the definitions that its channel needs.

    A robot that speaks JSON may have none of a type. Then one of :mod:`relay_protocol.ros.common` will do; JSON of any
    other type goes to it unchecked.

    :param defined: called with the name of each type that becomes known, or stays unchecked
    :param unusable: called with the name of each type that is not available, and why
    """

    def __init__(
        self, wire: RobotLinkState, defined: Callable[[str], None], unusable: Callable[[str, str], None]
    ) -> None:
        self._wire = wire
        self._defined = defined
        self._unusable = unusable
        self._asked: dict[str, _Asked] = {}
        """By the types whose texts define what is wanted."""
        self._unchecked: dict[str, None] = {}

    def want(self, type_name: str) -> None:
        """Ask for a type unless it is known or asked for already."""
        if not self.settled(type_name):
            self._ask(type_name)

    def settled(self, type_name: str) -> bool:
        """Whether bodies of this type can be sent: the type is known, or it is certain that it will not be."""
        return self._wire.robot.types.knows(type_name) or type_name in self._unchecked

    def _ask(self, type_name: str) -> None:
        source = source_of(normalise(type_name))
        if self._wire.link is None:
            return
        if source in self._asked:
            self._asked[source].names[type_name] = None
            return
        if not self._wire.cdr and source in common.TEXTS:
            self._wire.robot.types.add(source, common.TEXTS[source])
            return
        self._asked[source] = _Asked({type_name: None}, [])
        self._wire.send(link.GetType(type=source))
        if not self._wire.cdr:
            self._wire.clock.callLater(PATIENCE, self._late, self._wire.link, source)

    def _late(self, asked: ChannelPort, source: str) -> None:
        if self._wire.link is asked and source in self._asked:
            self.refused(source, f"the robot did not tell it within {PATIENCE:g} s")

    def ready(self, type_name: str, text: bool = False) -> Deferred[None]:
        """Fires when the type is settled; fails in words when the robot does not know it or is lost.

        :param text: wait for the robot's text of just this type; else one that contains it will do
        """
        if self._has(type_name, text):
            return succeed(None)
        if self._wire.link is None:
            # Nobody would ask the robot, and this type would count as asked for.
            return fail(Unavailable(f"robot {self._wire.robot.name} is not connected"))
        self._ask(type_name)
        asked = self._asked.get(source_of(normalise(type_name)))
        if asked is None:
            return succeed(None)
        waiting: Deferred[None] = Deferred()
        asked.waiting.append((type_name, waiting))
        return waiting

    def _has(self, type_name: str, text: bool) -> bool:
        if text and type_name not in self._unchecked:
            return self._wire.robot.types.has_text(type_name)
        return self.settled(type_name)

    def add(self, message: link.TypeDefinition) -> None:
        """The robot has sent a definition."""
        asked = self._asked.pop(message.type, None)
        if asked is None:
            return
        try:
            self._wire.robot.types.add(message.type, message.text)
        except SwitchboardError as error:
            self._unusable_now(
                asked, Invalid(f"the robot's definition of {message.type} is unusable: {error}")
            )
            return
        for name, each in asked.waiting:
            if self._wire.robot.types.knows(name):
                each.callback(None)
            else:
                each.errback(NotFound(f"the definition of {message.type} does not define {name}"))
        for name in asked.names:
            self._defined(name)

    def refused(self, source: str, reason: str) -> None:
        """The robot does not have the type."""
        asked = self._asked.pop(source, _Asked({source: None}, []))
        if self._wire.cdr:
            self._unusable_now(asked, NotFound(f"type {source}: {reason}"), reason)
            return
        for name in asked.names:
            if len(self._unchecked) >= UNCHECKED:
                self._unchecked.clear()
            self._unchecked[name] = None
        for _, each in asked.waiting:
            each.callback(None)
        for name in asked.names:
            self._defined(name)

    def _unusable_now(self, asked: _Asked, error: SwitchboardError, reason: str = "") -> None:
        for _, each in asked.waiting:
            each.errback(error)
        for name in asked.names:
            self._unusable(name, reason or str(error))

    def reset(self) -> None:
        """The link is gone."""
        asked, self._asked = self._asked, {}
        self._unchecked.clear()
        for each in asked.values():
            for _, waiting in each.waiting:
                waiting.errback(Unavailable(f"robot {self._wire.robot.name} lost its connection"))


class Interfaces:
    """Asks the robot for the names of its types, when somebody wants to know, and keeps the answer."""

    def __init__(self, wire: RobotLinkState) -> None:
        self._wire = wire
        self._known: list[str] | None = None
        self._waiting: list[Deferred[list[str]]] = []

    def names(self) -> Deferred[list[str]]:
        """Fires with full names in order; fails in words when the robot does not tell them or is lost."""
        if self._known is not None:
            return succeed(self._known)
        if self._wire.link is None:
            return fail(Unavailable(f"robot {self._wire.robot.name} is not connected"))
        waiting: Deferred[list[str]] = Deferred(self._given_up)
        self._waiting.append(waiting)
        if len(self._waiting) == 1:
            self._wire.send(link.GetInterfaces())
        return waiting

    def told(self, message: link.Interfaces) -> None:
        """The robot's answer; one nobody asked for is let go."""
        waiting, self._waiting = self._waiting, []
        if waiting:
            self._known = message.types
        for each in waiting:
            each.callback(message.types)

    def refused(self, reason: str) -> None:
        """The robot does not tell."""
        self._fail(Unavailable(f"robot {self._wire.robot.name} does not tell its types: {reason}"))

    def reset(self) -> None:
        """The link is gone; what comes back may have other packages installed."""
        self._known = None
        self._fail(Unavailable(f"robot {self._wire.robot.name} lost its connection"))

    def _given_up(self, waiting: Deferred[Any]) -> None:
        # When the last one has given up the next one asks anew.
        self._waiting.remove(waiting)

    def _fail(self, error: SwitchboardError) -> None:
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            each.errback(error)
