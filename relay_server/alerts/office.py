"""What all ways out of alerts share: clocks, who sends, and who may know of what."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Collection
from contextlib import AbstractAsyncContextManager, nullcontext
from dataclasses import dataclass

from relay_db.queries import AlertRecord, AlertRuleRecord
from relay_server.alerts.message import Message
from relay_server.clock import Clock

Send = Callable[[AlertRuleRecord, Message], Awaitable[None]]
"""Sends a message by a rule's way. Raises :class:`Undelivered`."""

Room = Callable[[AlertRuleRecord, bool], AbstractAsyncContextManager[None]]
"""What a message has to wait for, and keeps while it is sent. The last says whether the one before has failed."""

Known = Callable[[AlertRuleRecord, Collection[AlertRecord]], Awaitable[set[str]]]
"""Which of these alerts the rule's user may still know of, by their ids. Raises :class:`SwitchboardError`."""


def at_once(rule: AlertRuleRecord, doubtful: bool) -> AbstractAsyncContextManager[None]:
    """The room of a way on which no message waits."""
    return nullcontext()


@dataclass(frozen=True)
class Office:
    """What all deliveries share.

    :param wall: Unix time in seconds
    :param random: 0 to 1
    :param name: makes a fresh name for a message
    :param lasts: whether the alert of this id is not over
    :param realms: those that the robot of an alert is of
    """

    clock: Clock
    wall: Callable[[], float]
    random: Callable[[], float]
    name: Callable[[], str]
    send: Send
    known: Known
    lasts: Callable[[str], bool]
    realms: Callable[[AlertRecord], Collection[str]]
    room: Room = at_once
