"""Definitions of types, requested from the robot once on each link."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from twisted.internet.defer import Deferred, fail, succeed

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_protocol.ros import well_known
from relay_protocol.ros.definition import normalise, source_of
from relay_server.channels.link_state import ChannelLinkPort, RobotLinkState

ANSWER_SECONDS = 2.0
"""Seconds in which a robot that speaks JSON must send a definition; otherwise its JSON is not checked."""

MAX_UNCHECKED = 4096
"""Most names of types of which a robot that speaks JSON has no definition."""


class _PendingDefinition(NamedTuple):
    """A definition that was requested from the robot.

    :param names: of the types that are requested; the text may define more
    :param waiting: a Deferred for each caller that waits, with the name of its type
    """

    names: dict[str, None]
    waiting: list[tuple[str, Deferred[None]]]


class Definitions:
    """Requests the definitions that a channel needs from its robot.

    A robot that speaks JSON may not have a definition. Then that of :mod:`relay_protocol.ros.well_known` is used; JSON
    of any other type is forwarded unchecked.

    :param defined: called with the name of each type that becomes known, or stays unchecked
    :param unusable: called with the name of each type that is not available, and why
    """

    def __init__(
        self, link_state: RobotLinkState, defined: Callable[[str], None], unusable: Callable[[str, str], None]
    ) -> None:
        self._link_state = link_state
        self._defined = defined
        self._unusable = unusable
        self._pending: dict[str, _PendingDefinition] = {}
        """By the type whose text defines the requested types."""
        self._unchecked: dict[str, None] = {}

    def request(self, type_name: str) -> None:
        """Request a definition, unless it is known or was requested already."""
        if not self.is_settled(type_name):
            self._send_request(type_name)

    def is_settled(self, type_name: str) -> bool:
        """Whether bodies of this type can be sent: the type is known, or it is certain that it will not be."""
        return self._link_state.robot.types.knows(type_name) or type_name in self._unchecked

    def _send_request(self, type_name: str) -> None:
        source = source_of(normalise(type_name))
        if self._link_state.link is None:
            return
        if source in self._pending:
            self._pending[source].names[type_name] = None
            return
        if not self._link_state.cdr and source in well_known.TEXTS:
            self._link_state.robot.types.add(source, well_known.TEXTS[source])
            return
        self._pending[source] = _PendingDefinition({type_name: None}, [])
        self._link_state.send(link.GetType(type=source))
        if not self._link_state.cdr:
            self._link_state.clock.callLater(ANSWER_SECONDS, self._timed_out, self._link_state.link, source)

    def _timed_out(self, pending: ChannelLinkPort, source: str) -> None:
        if self._link_state.link is pending and source in self._pending:
            self.refused(source, f"the robot did not send it within {ANSWER_SECONDS:g} s")

    def ready(self, type_name: str, text: bool = False) -> Deferred[None]:
        """Fires when the type is settled; fails with the reason when the robot does not know it, or the link is lost.

        :param text: wait for the robot's text of this very type; else a text that contains it is enough
        """
        if self._is_ready(type_name, text):
            return succeed(None)
        if self._link_state.link is None:
            # Otherwise the type would count as requested, although the robot was never asked.
            return fail(Unavailable(f"robot {self._link_state.robot.name} is not connected"))
        self._send_request(type_name)
        pending = self._pending.get(source_of(normalise(type_name)))
        if pending is None:
            return succeed(None)
        waiting: Deferred[None] = Deferred()
        pending.waiting.append((type_name, waiting))
        return waiting

    def _is_ready(self, type_name: str, text: bool) -> bool:
        if text and type_name not in self._unchecked:
            return self._link_state.robot.types.has_text(type_name)
        return self.is_settled(type_name)

    def add(self, message: link.TypeDefinition) -> None:
        """The robot has sent a definition."""
        pending = self._pending.pop(message.type, None)
        if pending is None:
            return
        try:
            self._link_state.robot.types.add(message.type, message.text)
        except SwitchboardError as error:
            self._fail(pending, Invalid(f"the robot's definition of {message.type} is unusable: {error}"))
            return
        for name, each in pending.waiting:
            if self._link_state.robot.types.knows(name):
                each.callback(None)
            else:
                each.errback(NotFound(f"the definition of {message.type} does not define {name}"))
        for name in pending.names:
            self._defined(name)

    def refused(self, source: str, reason: str) -> None:
        """The robot does not have the definition."""
        pending = self._pending.pop(source, _PendingDefinition({source: None}, []))
        if self._link_state.cdr:
            self._fail(pending, NotFound(f"type {source}: {reason}"), reason)
            return
        for name in pending.names:
            if len(self._unchecked) >= MAX_UNCHECKED:
                self._unchecked.clear()
            self._unchecked[name] = None
        for _, each in pending.waiting:
            each.callback(None)
        for name in pending.names:
            self._defined(name)

    def _fail(self, pending: _PendingDefinition, error: SwitchboardError, reason: str = "") -> None:
        for _, each in pending.waiting:
            each.errback(error)
        for name in pending.names:
            self._unusable(name, reason or str(error))

    def reset(self) -> None:
        """The link is lost."""
        pending, self._pending = self._pending, {}
        self._unchecked.clear()
        for each in pending.values():
            for _, waiting in each.waiting:
                waiting.errback(Unavailable(f"robot {self._link_state.robot.name} lost its connection"))


class Interfaces:
    """Requests the names of the robot's types when they are needed, and caches the answer."""

    def __init__(self, link_state: RobotLinkState) -> None:
        self._link_state = link_state
        self._known: list[str] | None = None
        self._waiting: list[Deferred[list[str]]] = []

    def names(self) -> Deferred[list[str]]:
        """Fires with full names in order; fails with the reason if the robot lists none, or the link is lost."""
        if self._known is not None:
            return succeed(self._known)
        if self._link_state.link is None:
            return fail(Unavailable(f"robot {self._link_state.robot.name} is not connected"))
        waiting: Deferred[list[str]] = Deferred(self._cancelled)
        self._waiting.append(waiting)
        if len(self._waiting) == 1:
            self._link_state.send(link.GetInterfaces())
        return waiting

    def listed(self, message: link.Interfaces) -> None:
        """The robot has answered; an answer to no request is dropped."""
        waiting, self._waiting = self._waiting, []
        if waiting:
            self._known = message.types
        for each in waiting:
            each.callback(message.types)

    def refused(self, reason: str) -> None:
        """The robot does not list its types."""
        self._fail(Unavailable(f"robot {self._link_state.robot.name} does not list its types: {reason}"))

    def reset(self) -> None:
        """The link is lost; when it is back, the robot may have other packages installed."""
        self._known = None
        self._fail(Unavailable(f"robot {self._link_state.robot.name} lost its connection"))

    def _cancelled(self, waiting: Deferred[Any]) -> None:
        # When the last caller is gone, the next one sends a new request.
        self._waiting.remove(waiting)

    def _fail(self, error: SwitchboardError) -> None:
        waiting, self._waiting = self._waiting, []
        for each in waiting:
            each.errback(error)
