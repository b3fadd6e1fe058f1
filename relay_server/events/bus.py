"""The event bus: each event that is published reaches all subscribers in the same turn of the reactor.

Nothing is stored here; :mod:`relay_server.events.collector` puts into the event log what belongs there.

The newest events of each realm in memory, for readers that follow new events.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from typing import Any

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_db.queries import StoredEventRecord
from relay_server.events.limits import RECENT


@dataclass(frozen=True, slots=True)
class BusEvent:
    """Something that happened.

    :param kind: such as ``robot.online``
    :param robot_id: the number of the robot it is about, if it is about one
    :param source: who caused it: ``relay``, ``user:<name>``, ``robot:<name>``
    """

    kind: str
    robot_id: int | None
    source: str
    data: dict[str, Any]


Subscriber = Callable[[BusEvent], None]


class EventBus:
    """Notifies subscribers. One that fails is logged and disturbs neither the others nor the publisher."""

    log = Logger()

    def __init__(self) -> None:
        self._subscribers: list[Subscriber] = []

    def subscribe(self, subscriber: Subscriber) -> None:
        """Call this for every event from now on."""
        self._subscribers.append(subscriber)

    def publish(self, kind: str, robot_id: int | None = None, source: str = "relay", **data: Any) -> None:
        """Notify all subscribers of an event; see :class:`BusEvent`."""
        event = BusEvent(kind, robot_id, source, data)
        for subscriber in self._subscribers:
            try:
                subscriber(event)
            except Exception:  # a subscriber must not undo what has happened
                self.log.failure("a subscriber failed at the event '{kind}'", kind=kind)


MAX_FOLLOWED = 500
"""Events that a follower gets at a time."""


class RecentEvents:
    """The newest events of each realm; followers of these need not ask the database."""

    def __init__(self, size: int = RECENT) -> None:
        self._events: dict[str, deque[StoredEventRecord]] = {}
        self._size = size
        self._followers: set[EventFollower] = set()

    def on_written(self, events: list[StoredEventRecord]) -> None:
        """Add events that are in the database, and wake all followers."""
        for each in events:
            self._events.setdefault(each.realm, deque(maxlen=self._size)).append(each)
        for follower in list(self._followers):
            follower.wake()

    def forget_realm(self, realm: str) -> None:
        """Drop the events of a realm that was removed; a new one of its name is another."""
        self._events.pop(realm, None)

    def since(self, realm: str, number: int) -> list[StoredEventRecord] | None:
        """The first :data:`MAX_FOLLOWED` events with greater numbers, in their order.

        :returns: ``None`` when some of them are not in memory
        """
        events = self._events.get(realm)
        if not events or events[0].number > number + 1:
            return None
        if events[-1].number - events[0].number != len(events) - 1:
            # Another process wrote some of the numbers.
            return None
        begin = max(0, number + 1 - events[0].number)
        return list(islice(events, begin, begin + MAX_FOLLOWED))

    def subscribe(self, follower: EventFollower) -> None:
        """Wake this follower whenever events are written."""
        self._followers.add(follower)

    def unsubscribe(self, follower: EventFollower) -> None:
        """Stop waking it."""
        self._followers.discard(follower)


class EventFollower:
    """A reader of new events.

    :ivar number: of the last event that it was given
    :ivar fresh: whether events were written since it last looked
    """

    def __init__(self, number: int) -> None:
        self.number = number
        self.fresh = False
        self._wake: Deferred[None] | None = None

    def wake(self) -> None:
        """Let :meth:`news` return."""
        self.fresh = True
        wake, self._wake = self._wake, None
        if wake is not None:
            wake.callback(None)

    async def news(self) -> None:
        """Wait for :meth:`wake`."""
        if self.fresh:
            return
        self._wake = Deferred()
        try:
            await self._wake
        finally:
            self._wake = None
