"""What a page is told of its robots, and when: at every change, and so often that silence means a lost relay.

Somebody who sees nothing of what changed must not learn that it did: whatever wakes a look, it tells only what is other
than what was told, and what is told without news comes so long after the last telling, whoever wakes when.

Nothing here touches a socket. Two edges carry it: ``stream`` as server-sent events, ``pages`` over a websocket.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Protocol

from twisted.internet.defer import Deferred

from relay_protocol import jsontext
from relay_protocol.errors import Unavailable
from relay_server.access import Principal
from relay_server.common.clock import Clock, Timer, cancel, sleep
from relay_server.http.update_sources import COALESCE_SECONDS, Shown, Sources

STREAM_SECONDS = 5.0
"""Something is told at least so often (SPEC section 1.7)."""

QUIET_SECONDS = 3.0
"""So long after the last telling it is told again, changed or not."""

LOOK_SECONDS = 1.5
"""A look that is due and takes longer is told to be under way, again and again, which is in time."""

STALL_SECONDS = 5.0
"""A page that takes nothing for so long is cut."""

FIRST = "robots"
"""The event that is told without news as well; the others are told when they are another list."""

UNKNOWN = "unknown"
"""The event that says that the relay lives and can't tell the others, and why."""

NO_ANSWER = "the database does not answer"


class UpdateSink(Protocol):
    """Who is told."""

    def tell(self, event: str, body: bytes) -> None:
        """Pass one event on.

        :param body: JSON
        """

    def moves(self) -> bool:
        """Whether it has taken something since this was asked last."""

    def cut(self) -> None:
        """It takes nothing any more: end the connection."""


class LiveUpdates:
    """Tells one page. Each event has the name of its source, and holds a list under that name.

    :param principal: whose page it is; asked again each time, for that may be over
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
        self._told: dict[str, Shown] = {}
        self._reason = ""
        """What was told to be why the others are not known; empty when they are."""
        self._due = clock.seconds()
        """When something is told, whatever there is, monotonic seconds."""
        self._dirty = False
        """Whether anything has changed since what was told last was looked up."""
        self._wake: Deferred[None] | None = None
        self._late: Timer | None = None
        self._waits = False
        """Whether nothing more is told for now: it would only be old when it arrives."""
        self._stalled: Timer | None = None
        """Cuts the page; there while it takes nothing."""

    async def run(self) -> None:
        """Until this is cancelled, or the credentials end.

        :raises Refused: they have ended
        """
        forget = self._sources.on_change(self._changed)
        try:
            while True:
                await self._look()
                # Pages look at the same moments, so that what is looked up for one is good for all.
                rest = COALESCE_SECONDS - self._clock.seconds() % COALESCE_SECONDS
                await sleep(self._clock, min(rest, self._left()))
                await self._until_change()
        finally:
            forget()
            cancel(self._stalled)

    def wait(self) -> None:
        """Tell nothing until :meth:`resume`: the page takes what it was told, but slowly."""
        self._waits = True

    def pause(self) -> None:
        """The page takes nothing for now."""
        self._waits = True
        if self._stalled is None:
            self._stalled = self._clock.callLater(STALL_SECONDS, self._stall)

    def _stall(self) -> None:
        self._stalled = None
        if self._page.moves():
            self._stalled = self._clock.callLater(STALL_SECONDS, self._stall)
        else:
            self._page.cut()

    def resume(self) -> None:
        """It does again."""
        cancel(self._stalled)
        self._stalled = None
        self._waits = False
        self._due = self._clock.seconds()
        self._changed()

    # --- telling ------------------------------------------------------------------------------------------

    async def _look(self) -> None:
        self._dirty = False
        self._expect()
        try:
            principal = await self._principal()
            found = await self._sources.look(principal)
        except Unavailable as error:
            # The next look may do better.
            self._unknown(str(error))
            return
        finally:
            cancel(self._late)
        due = self._left() == 0
        if due:
            self._put_off()
        for now in found:
            name = now.name
            if not self._waits and self._is_told(name, now, due):
                self._told[name] = now
                if name == FIRST:
                    self._reason = ""
                    self._put_off()
                self._page.tell(name, now.body)

    def _is_told(self, name: str, now: Shown, due: bool) -> bool:
        before = self._told.get(name)
        if before is None or (due and name == FIRST):
            return True
        if now is before:
            return False
        return now.rows != before.rows if due else now.lasting != before.lasting

    def _expect(self) -> None:
        """Have it told when what is looked up now does not come in time."""
        self._late = self._clock.callLater(self._left() + LOOK_SECONDS, self._is_late)

    def _is_late(self) -> None:
        self._unknown(NO_ANSWER)
        self._expect()

    def _unknown(self, reason: str) -> None:
        if reason == self._reason and self._left() > 0:
            return
        self._put_off()
        if not self._waits:
            self._reason = reason
            self._told.pop(FIRST, None)
            self._page.tell(UNKNOWN, jsontext.encode({"reason": reason}))

    # --- waiting ------------------------------------------------------------------------------------------

    def _left(self) -> float:
        """Seconds until something is told, whatever there is; 0 when that is now."""
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
