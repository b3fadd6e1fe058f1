"""What pages show, looked up once for all pages of a user, and held once for all that are shown the same."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from functools import cached_property
from typing import Any
from weakref import WeakValueDictionary

from twisted.internet.defer import Deferred
from twisted.python.failure import Failure

from relay_protocol import jsontext
from relay_server.access import Principal
from relay_server.common.clock import Clock

COALESCE_SECONDS = 0.25
"""A page looks no more often than that, and what was looked up for one page is good for others for so long."""

PASSING = frozenset({"rtt_ms", "last_seen", "last", "count", "text"})
"""Fields that differ at nearly every look, though nothing happened: alone they are no news before it is time."""

KEPT = 1024
"""Answers of sources that are kept until something changes."""

Rows = list[dict[str, Any]]
Source = Callable[[Principal], Awaitable[Rows]]
"""What a user may see of something now. Rows must not be changed afterwards."""

_Key = tuple[object, ...]


class Shown:
    """What a source has answered, shared by all pages that are shown the same bytes.

    :param name: of the event that it is sent as
    :param body: JSON: the rows under the name of the event
    """

    def __init__(self, name: str, rows: Rows, body: bytes) -> None:
        self.name = name
        self.rows = rows
        self.body = body

    @cached_property
    def lasting(self) -> Rows:
        """The rows without the fields that pass."""
        return [{name: value for name, value in row.items() if name not in PASSING} for row in self.rows]


class _CachedAnswer:
    """What was looked up since something last changed."""

    def __init__(self) -> None:
        self.of: dict[_Key, tuple[float, Shown]] = {}
        """When it was looked up for each user, in seconds of the clock, and what was found."""
        self.under_way: dict[_Key, list[Deferred[Shown]]] = {}


class Sources:
    """What pages may show, by the names of events.

    :param on_change: has a listener called at every change; returns what ends that
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
        """By the encoded rows themselves: users share what is equal to the byte, as long as somebody holds it."""

    def on_change(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call a listener at every change, after what was known is forgotten; returns what ends that."""
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

    async def look(self, principal: Principal) -> list[Shown]:
        """What a user may see now, of each source."""
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
            # It goes on for the others when the page that asked first leaves.
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
    # An error that nobody waits for any more is left to Twisted, which logs it.
    return result if not left and isinstance(result, Failure) else None
