"""What pages show, looked up and encoded once for all pages that may see the same."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from functools import cached_property
from typing import Any

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
    """What a source has answered, shared by pages.

    :param name: of the event that it is sent as
    """

    def __init__(self, name: str, rows: Rows, at: float) -> None:
        self.name = name
        self.rows = rows
        self.at = at

    @cached_property
    def lasting(self) -> Rows:
        """The rows without the fields that pass."""
        return [{name: value for name, value in row.items() if name not in PASSING} for row in self.rows]

    @cached_property
    def body(self) -> bytes:
        """JSON: the rows under the name of the event."""
        return jsontext.encode({self.name: self.rows})


class _CachedAnswer:
    """What was looked up since something last changed."""

    def __init__(self) -> None:
        self.of: dict[_Key, Shown] = {}
        self.same: dict[_Key, Shown] = {}
        """By the rows themselves: different users may be shown the same."""
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
        self._known = self._before = _CachedAnswer()

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
                self._known = self._before = _CachedAnswer()

        return end

    async def look(self, principal: Principal) -> list[Shown]:
        """What a user may see now, of each source."""
        return [await self._shown(name, source, principal) for name, source in self._sources.items()]

    def _changed(self) -> None:
        self._before, self._known = self._known, _CachedAnswer()
        for listener in list(self._listeners):
            listener()

    async def _shown(self, name: str, source: Source, principal: Principal) -> Shown:
        key = (name, principal.user_id, principal.admin, principal.scope and str(principal.scope))
        known = self._known
        found = known.of.get(key)
        if found is not None and self._clock.seconds() - found.at < COALESCE_SECONDS:
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
        same = (name, *map(id, rows))
        shown = known.same.get(same)
        if shown is None:
            shown = Shown(name, rows, self._clock.seconds())
            before = known.of.get(key) or self._before.of.get(key)
            if before is not None and before.rows == rows:
                shown = before
        shown.at = self._clock.seconds()
        if len(known.of) >= KEPT:
            known.of.clear()
            known.same.clear()
        known.of[key] = known.same[same] = shown
        return shown


def _answer(result: Shown | Failure, waiting: list[Deferred[Any]]) -> Failure | None:
    left = [each for each in waiting if not each.called]
    for each in left:
        each.callback(result)
    # An error that nobody waits for any more is left to Twisted, which logs it.
    return result if not left and isinstance(result, Failure) else None
