"""Type definitions of a robot, asked for once each."""

from __future__ import annotations

from collections.abc import Callable

from twisted.internet.defer import Deferred, fail, succeed

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_server.channel.wire import Wire


class Definitions:
    """Asks the robot for the definitions that its channel needs.

    :param defined: called with the name of each type that becomes known
    :param unusable: called with the name of each type that is not to be had, and why
    """

    def __init__(
        self, wire: Wire, defined: Callable[[str], None], unusable: Callable[[str, str], None]
    ) -> None:
        self._wire = wire
        self._defined = defined
        self._unusable = unusable
        self._asked: dict[str, list[Deferred[None]]] = {}

    def want(self, type_name: str) -> None:
        """Ask for a type unless it is known or asked for already."""
        if not self._wire.robot.types.knows(type_name):
            self._ask(type_name)

    def _ask(self, type_name: str) -> None:
        if type_name not in self._asked and self._wire.cdr and self._wire.link is not None:
            self._asked[type_name] = []
            self._wire.send(link.GetType(type=type_name))

    def ready(self, type_name: str, text: bool = False) -> Deferred[None]:
        """Fires when the type is known; fails in words when the robot does not know it or is lost.

        :param text: wait for the robot's text of just this type; else one that contains it will do
        """
        if not self._wire.cdr or self._has(type_name, text):
            return succeed(None)
        if self._wire.link is None:
            # Nobody would ask the robot, and this type would count as asked for.
            return fail(Unavailable(f"robot {self._wire.robot.name} is not connected"))
        self._ask(type_name)
        waiting: Deferred[None] = Deferred()
        self._asked.setdefault(type_name, []).append(waiting)
        return waiting

    def _has(self, type_name: str, text: bool) -> bool:
        types = self._wire.robot.types
        return types.has_text(type_name) if text else types.knows(type_name)

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
        self._fail(waiting, NotFound(f"type {type_name}: {reason}"))
        self._unusable(type_name, reason)

    def reset(self) -> None:
        """The link is gone."""
        asked, self._asked = self._asked, {}
        for waiting in asked.values():
            self._fail(waiting, Unavailable(f"robot {self._wire.robot.name} lost its connection"))

    @staticmethod
    def _fail(waiting: list[Deferred[None]], error: SwitchboardError) -> None:
        for each in waiting:
            each.errback(error)
