"""Lists that pages of the portal show, of robots and of alerts: looked up once for all pages of a user, held once for
all that show the same, and sent at every change and so often that silence means a lost relay.

A reader must not learn of a change that is hidden from them. So an update is sent only if what the reader may see
differs. A repeated update comes a fixed time after the last one, whatever happened in between.

Nothing here touches a socket. :mod:`relay_server.http.streaming` carries updates as server-sent events,
:mod:`relay_server.ws.updates` over a websocket.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, Protocol
from weakref import WeakValueDictionary

import msgspec
from twisted.internet.defer import Deferred
from twisted.python.failure import Failure

from relay_protocol import jsontext
from relay_protocol.errors import Unavailable
from relay_server.access import Principal
from relay_server.common.clock import Clock, Timer, cancel, sleep

COALESCE_SECONDS = 0.25
"""Shortest time between two look-ups of a user, seconds; pages in between share the earlier result."""

PASSING = frozenset({"rtt_ms", "last_seen", "last", "count", "text"})
"""Fields that differ at nearly every look-up. If only these differ, the list is not sent before it is due."""

KEPT = 1024
"""Most results that are kept until something changes."""

Rows = Sequence[Mapping[str, Any]]
Source = Callable[[Principal], Awaitable[Rows]]
"""Returns the rows of a list that a user may see now. The rows must not be changed afterwards."""

_Key = tuple[object, ...]


class Shown:
    """The result of a source, shared by all pages that show the same bytes.

    :param name: name of its event
    :param body: JSON: the rows under the name of the event
    """

    def __init__(self, name: str, rows: Rows, body: bytes) -> None:
        self.name = name
        self.rows = rows
        self.body = body

    @cached_property
    def lasting(self) -> Rows:
        """The rows without the fields of :data:`PASSING`."""
        return [{name: value for name, value in row.items() if name not in PASSING} for row in self.rows]


class _CachedAnswer:
    """Results since the last change."""

    def __init__(self) -> None:
        self.of: dict[_Key, tuple[float, Shown]] = {}
        """Time of the look-up for each user, in seconds of the clock, and the result."""
        self.under_way: dict[_Key, list[Deferred[Shown]]] = {}


class Sources:
    """Sources of the lists that pages may show, by the names of their events.

    :param on_change: registers a listener of all changes; returns a function that removes it
    """

    def __init__(
        self,
        clock: Clock,
        sources: Mapping[str, Source],
        on_change: Callable[[Callable[[], None]], Callable[[], None]],
    ) -> None:
        self._clock = clock
        self._sources = sources
        self._follow = on_change
        self._forget: Callable[[], None] | None = None
        self._listeners: list[Callable[[], None]] = []
        self._known = _CachedAnswer()
        self._same: WeakValueDictionary[tuple[str, bytes], Shown] = WeakValueDictionary()
        """By the encoded rows: users with equal lists share them, as long as any page holds them."""

    def on_change(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Register a listener of changes, called after the cache is cleared; returns a function that removes it."""
        self._listeners.append(listener)
        if self._forget is None:
            self._forget = self._follow(self._changed)

        def end() -> None:
            self._listeners.remove(listener)
            if not self._listeners and self._forget is not None:
                self._forget()
                self._forget = None
                self._known = _CachedAnswer()

        return end

    async def visible_to(self, principal: Principal) -> list[Shown]:
        """The lists of all sources as a user may see them now."""
        return [await self._shown(name, source, principal) for name, source in self._sources.items()]

    def _changed(self) -> None:
        self._known = _CachedAnswer()
        for listener in list(self._listeners):
            listener()

    async def _shown(self, name: str, source: Source, principal: Principal) -> Shown:
        key = (name, principal.user_id, principal.admin, principal.scope and str(principal.scope))
        known = self._known
        at, found = known.of.get(key, (0.0, None))
        if found is not None and self._clock.seconds() - at < COALESCE_SECONDS:
            return found
        waiting: Deferred[Shown] = Deferred()
        under_way = known.under_way.setdefault(key, [])
        under_way.append(waiting)
        if len(under_way) == 1:
            # The look-up continues for other pages when the first one leaves.
            Deferred.fromCoroutine(self._ask(name, source, principal, known, key)).addBoth(_answer, under_way)
        return await waiting

    async def _ask(
        self, name: str, source: Source, principal: Principal, known: _CachedAnswer, key: _Key
    ) -> Shown:
        try:
            rows = await source(principal)
        finally:
            del known.under_way[key]
        body = jsontext.encode({name: rows})
        shown = self._same.get((name, body))
        if shown is None:
            shown = self._same[name, body] = Shown(name, rows, body)
        if len(known.of) >= KEPT:
            known.of.clear()
        known.of[key] = self._clock.seconds(), shown
        return shown


def _answer(result: Shown | Failure, waiting: list[Deferred[Any]]) -> Failure | None:
    left = [each for each in waiting if not each.called]
    for each in left:
        each.callback(result)
    # Twisted logs an error that no page waits for.
    return result if not left and isinstance(result, Failure) else None


STREAM_SECONDS = 5.0
"""Longest silence, seconds (SPEC 1.7)."""

QUIET_SECONDS = 3.0
"""Seconds after the last update until it is repeated, changed or not."""

LOOKUP_SECONDS = 1.5
"""Seconds that a look-up may be late. Then the page is notified that the database does not answer."""

STALL_SECONDS = 5.0
"""Seconds without any byte accepted after which a page is cut."""

FIRST = "robots"
"""The event that is also repeated without a change; the others are sent only when their list has changed."""

UNKNOWN = "unknown"
"""The event that says that the relay is alive but does not know the other lists, with the reason."""

NO_ANSWER = "the database does not answer"


class UpdateUnknown(msgspec.Struct, frozen=True):
    """The live update ``unknown``: the state cannot be looked up now.

    :param reason: why, for display
    """

    reason: str


class UpdateSink(Protocol):
    """The connection to a page."""

    def send(self, event: str, body: bytes) -> None:
        """Send one event.

        :param body: JSON
        """

    def made_progress(self) -> bool:
        """Whether the page has accepted bytes since the last call."""

    def cut(self) -> None:
        """End the connection: the page accepts no more bytes."""


class LiveUpdates:
    """Updates one page. Each event has the name of its source, and holds a list under that name.

    :param principal: the user of the page; called before each look-up, as the credentials may have ended
    """

    def __init__(
        self,
        clock: Clock,
        page: UpdateSink,
        principal: Callable[[], Awaitable[Principal]],
        sources: Sources,
    ) -> None:
        self._clock = clock
        self._page = page
        self._principal = principal
        self._sources = sources
        self._sent: dict[str, Shown] = {}
        self._reason = ""
        """The reason in the last :data:`UNKNOWN`, empty when the lists are known again."""
        self._due = clock.seconds()
        """Time of the next update even without a change, monotonic seconds."""
        self._dirty = False
        """Whether anything has changed since the last look-up began."""
        self._wake: Deferred[None] | None = None
        self._late: Timer | None = None
        self._held = False
        """Whether updates are held back, since they would be old on arrival."""
        self._stalled: Timer | None = None
        """Cuts the page; set while it accepts nothing."""

    async def run(self) -> None:
        """Send updates until this is cancelled or the credentials end.

        :raises Refused: the credentials have ended
        """
        forget = self._sources.on_change(self._changed)
        try:
            while True:
                await self._update()
                # All pages look up at the same moments, so that one look-up serves all.
                rest = COALESCE_SECONDS - self._clock.seconds() % COALESCE_SECONDS
                await sleep(self._clock, min(rest, self._left()))
                await self._until_change()
        finally:
            forget()
            cancel(self._stalled)

    def wait(self) -> None:
        """Hold updates back until :meth:`resume`: the page reads, but slowly."""
        self._held = True

    def pause(self) -> None:
        """The page accepts no bytes at present."""
        self._held = True
        if self._stalled is None:
            self._stalled = self._clock.callLater(STALL_SECONDS, self._stall)

    def _stall(self) -> None:
        self._stalled = None
        if self._page.made_progress():
            self._stalled = self._clock.callLater(STALL_SECONDS, self._stall)
        else:
            self._page.cut()

    def resume(self) -> None:
        """The page accepts bytes again."""
        cancel(self._stalled)
        self._stalled = None
        self._held = False
        self._due = self._clock.seconds()
        self._changed()

    # --- sending ------------------------------------------------------------------------------------------

    async def _update(self) -> None:
        self._dirty = False
        self._start_late_timer()
        try:
            principal = await self._principal()
            found = await self._sources.visible_to(principal)
        except Unavailable as error:
            # The next look-up may succeed.
            self._unknown(str(error))
            return
        finally:
            cancel(self._late)
        due = self._left() == 0
        if due:
            self._put_off()
        for now in found:
            name = now.name
            if not self._held and self._differs(name, now, due):
                self._sent[name] = now
                if name == FIRST:
                    self._reason = ""
                    self._put_off()
                self._page.send(name, now.body)

    def _differs(self, name: str, now: Shown, due: bool) -> bool:
        before = self._sent.get(name)
        if before is None or (due and name == FIRST):
            return True
        if now is before:
            return False
        return now.rows != before.rows if due else now.lasting != before.lasting

    def _start_late_timer(self) -> None:
        """Start the timer for a look-up that is late."""
        self._late = self._clock.callLater(self._left() + LOOKUP_SECONDS, self._is_late)

    def _is_late(self) -> None:
        self._unknown(NO_ANSWER)
        self._start_late_timer()

    def _unknown(self, reason: str) -> None:
        if reason == self._reason and self._left() > 0:
            return
        self._put_off()
        if not self._held:
            self._reason = reason
            self._sent.pop(FIRST, None)
            self._page.send(UNKNOWN, jsontext.encode(UpdateUnknown(reason)))

    # --- waiting ------------------------------------------------------------------------------------------

    def _left(self) -> float:
        """Seconds until an update is due even without a change; 0 when it is due now."""
        return max(0.0, self._due - self._clock.seconds())

    def _put_off(self) -> None:
        self._due = self._clock.seconds() + QUIET_SECONDS

    def _changed(self) -> None:
        self._dirty = True
        self._wake_up()

    def _wake_up(self) -> None:
        wake, self._wake = self._wake, None
        if wake is not None:
            wake.callback(None)

    async def _until_change(self) -> None:
        if self._dirty:
            return
        wake: Deferred[None] = Deferred()
        self._wake = wake
        timer = self._clock.callLater(self._left(), self._wake_up)
        try:
            await wake
        finally:
            self._wake = None
            cancel(timer)
