"""The statuses that a client shows: each is sent once while it lasts, and is taken back when it is over."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from relay_server.common.token_bucket import TokenBucket
from relay_server.foxglove import messages

STATUSES_A_SECOND = 5.0
STATUSES_AT_ONCE = 100.0
"""Limits of the statuses that one client causes; beyond them they are left out, and one status says so."""

REMEMBERED = 256
"""Most statuses that are remembered as shown; the one that was shown least recently is forgotten first."""

EVENT_SECONDS = 10.0
"""Seconds for which an event is shown, such as a refusal. A state is shown as long as it lasts."""

SUBSCRIPTION_PREFIX, CHANNEL_PREFIX = "subscribe:", "channel:"
"""Beginnings of ids of statuses that last as long as the client's subscription or advertisement: they come once."""

LEVELS = {"info": messages.INFO, "warning": messages.WARNING, "error": messages.ERROR}

_LEFT_OUT = "left-out"
_LEFT_OUT_TEXT = "more went wrong than is shown here; /relay/status has the counts"


class _ShownStatus(NamedTuple):
    """:param ends: seconds of the clock at which it is taken back"""

    level: str
    text: str
    ends: float

    def equals(self, other: _ShownStatus | None) -> bool:
        """Whether a client would see no difference."""
        return other is not None and (self.level, self.text) == (other.level, other.text)


class StatusList:
    """The statuses of one client.

    :param send: sends websocket frames
    :param seconds: a monotonic clock
    """

    __slots__ = ("_bucket", "_seconds", "_send", "_shown")

    def __init__(self, send: Callable[[bytes], None], seconds: Callable[[], float]) -> None:
        self._send = send
        self._seconds = seconds
        self._bucket = TokenBucket(STATUSES_A_SECOND, STATUSES_AT_ONCE, seconds)
        self._shown: dict[str, _ShownStatus] = {}

    def show(self, level: str, text: str, id: str, seconds: float | None = None) -> None:
        """Show a status in place of the one with the same id; an equal one is not sent again, but lasts longer.

        :param level: one of :data:`LEVELS`
        :param seconds: until :meth:`remove_ended` takes it back; ``None``: it is a state, which lasts
        """
        status = _ShownStatus(level, text, self._end_after(seconds))
        if not status.equals(self._shown.get(id)) and not self._bucket.take():
            id, status = _LEFT_OUT, _ShownStatus("warning", _LEFT_OUT_TEXT, self._end_after(EVENT_SECONDS))
        before = self._shown.pop(id, None)
        self._shown[id] = status
        if len(self._shown) > REMEMBERED:
            del self._shown[next(iter(self._shown))]
        if not status.equals(before):
            self._send_status(id, status)

    def end_later(self, id: str) -> None:
        """Take a status back after :data:`EVENT_SECONDS`, if it is shown."""
        status = self._shown.get(id)
        if status is not None:
            self._shown[id] = status._replace(ends=self._end_after(EVENT_SECONDS))

    def _end_after(self, seconds: float | None) -> float:
        return math.inf if seconds is None else self._seconds() + seconds

    def repeat(self) -> None:
        """Send again all statuses that are shown."""
        for id, status in self._shown.items():
            self._send_status(id, status)

    def _send_status(self, id: str, status: _ShownStatus) -> None:
        self._send(messages.status(LEVELS[status.level], status.text, id))

    def remove(self, id: str) -> None:
        """Take a status back, if it is shown."""
        if self._shown.pop(id, None) is not None:
            self._send(messages.remove_status([id]))

    def remove_ended(self) -> None:
        """Take back the events that have been shown long enough."""
        now = self._seconds()
        ended = [id for id, status in self._shown.items() if status.ends <= now]
        for id in ended:
            del self._shown[id]
        if ended:
            self._send(messages.remove_status(ended))
