"""Type definitions of a robot, asked for once each."""

from __future__ import annotations

from collections.abc import Callable

from twisted.internet.defer import Deferred, fail, succeed

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_protocol.ros import common
from relay_server.channel.wire import ChannelLink, Wire

PATIENCE = 2.0
"""A robot that speaks JSON has this long to tell a definition, seconds; then its JSON goes unchecked."""

UNCHECKED = 4096
"""Most names of types that are kept because a robot has no definition of them."""


class Definitions:
    """Asks the robot for the definitions that its channel needs.

    A robot that speaks JSON may have none of a type. Then one of :mod:`relay_protocol.ros.common` will do; JSON of any
    other type goes to it unchecked.

    :param defined: called with the name of each type that becomes known, or stays unchecked
    :param unusable: called with the name of each type that is not available, and why
    """

    def __init__(
        self, wire: Wire, defined: Callable[[str], None], unusable: Callable[[str, str], None]
    ) -> None:
        self._wire = wire
        self._defined = defined
        self._unusable = unusable
        self._asked: dict[str, list[Deferred[None]]] = {}
        self._unchecked: dict[str, None] = {}

    def want(self, type_name: str) -> None:
        """Ask for a type unless it is known or asked for already."""
        if not self.settled(type_name):
            self._ask(type_name)

    def settled(self, type_name: str) -> bool:
        """Whether bodies of this type can be sent: the type is known, or it is certain that it will not be."""
        return self._wire.robot.types.knows(type_name) or type_name in self._unchecked

    def _ask(self, type_name: str) -> None:
        if type_name in self._asked or self._wire.link is None:
            return
        if not self._wire.cdr and type_name in common.TEXTS:
            self._wire.robot.types.add(type_name, common.TEXTS[type_name])
            return
        self._asked[type_name] = []
        self._wire.send(link.GetType(type=type_name))
        if not self._wire.cdr:
            self._wire.clock.callLater(PATIENCE, self._late, self._wire.link, type_name)

    def _late(self, asked: ChannelLink, type_name: str) -> None:
        if self._wire.link is asked and type_name in self._asked:
            self.refused(type_name, f"the robot did not tell it within {PATIENCE:g} s")

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
        if type_name not in self._asked:
            return succeed(None)
        waiting: Deferred[None] = Deferred()
        self._asked[type_name].append(waiting)
        return waiting

    def _has(self, type_name: str, text: bool) -> bool:
        if text and type_name not in self._unchecked:
            return self._wire.robot.types.has_text(type_name)
        return self.settled(type_name)

    def add(self, message: link.TypeDefinition) -> None:
        """The robot has sent a definition."""
        waiting = self._asked.pop(message.type, None)
        if waiting is None:
            return
        try:
            self._wire.robot.types.add(message.type, message.text)
        except SwitchboardError as error:
            reason = f"the robot's definition of {message.type} is unusable: {error}"
            self._fail(waiting, Invalid(reason))
            self._unusable(message.type, reason)
            return
        for each in waiting:
            each.callback(None)
        self._defined(message.type)

    def refused(self, type_name: str, reason: str) -> None:
        """The robot does not have the type."""
        waiting = self._asked.pop(type_name, [])
        if not self._wire.cdr:
            if len(self._unchecked) >= UNCHECKED:
                self._unchecked.clear()
            self._unchecked[type_name] = None
            for each in waiting:
                each.callback(None)
            self._defined(type_name)
            return
        self._fail(waiting, NotFound(f"type {type_name}: {reason}"))
        self._unusable(type_name, reason)

    def reset(self) -> None:
        """The link is gone."""
        asked, self._asked = self._asked, {}
        self._unchecked.clear()
        for waiting in asked.values():
            self._fail(waiting, Unavailable(f"robot {self._wire.robot.name} lost its connection"))

    @staticmethod
    def _fail(waiting: list[Deferred[None]], error: SwitchboardError) -> None:
        for each in waiting:
            each.errback(error)
