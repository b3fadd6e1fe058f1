"""Messages that a client sends in fragments (rosbridge v2 protocol, section 3.1.1; SPEC 1.6)."""

from __future__ import annotations

from collections.abc import Callable

from relay_protocol import limits, rosbridge
from relay_protocol.errors import Invalid, Refused
from relay_server.common.clock import Clock, Timer, cancel
from relay_server.common.unfinished import PIECE_OVERHEAD, UnfinishedCount, time_limit

PARTS = 16_384
"""Most fragments of one message, and of all incomplete messages of a client; each takes memory beside its bytes."""


class _Incomplete:
    """A message of which some fragments have come."""

    __slots__ = ("begun", "bytes", "earliest_sent", "parts", "total", "touched")

    def __init__(self, total: int, earliest_sent: int, begun: float) -> None:
        self.total = total
        self.begun = begun
        self.earliest_sent = earliest_sent
        self.parts: dict[int, bytes] = {}
        self.bytes = 0
        self.touched = begun

    @property
    def held(self) -> int:
        """Bytes that it counts for."""
        return self.bytes + PIECE_OVERHEAD * len(self.parts)

    @property
    def expires(self) -> float:
        """Seconds of the clock at which it is dropped if no further fragment comes."""
        return min(self.touched + limits.FRAGMENT_SECONDS, self.begun + time_limit(self.bytes))


class FragmentAssembler:
    """Joins the fragments of one client's messages. Memory is used for what has come, not for what is announced.

    :param earliest_sent: of a message that comes now; see :class:`relay_server.sessions.message_age.MessageAge`
    :param on_complete: called with the text of a whole message, and ``earliest_sent`` of its first fragment, as a
        command is as old as its beginning
    :param on_expire: called with an error text and the id of a message whose fragments came too slowly
    :param user_bytes: counts their bytes against the user
    :param most: most bytes of all incomplete messages together
    """

    # Every client has one, and few use it.
    __slots__ = (
        "_bytes",
        "_clock",
        "_dropped",
        "_earliest_sent",
        "_incomplete",
        "_most",
        "_on_complete",
        "_on_expire",
        "_parts",
        "_timer",
        "_user_bytes",
    )

    def __init__(
        self,
        clock: Clock,
        earliest_sent: Callable[[], int],
        on_complete: Callable[[bytes, int], None],
        on_expire: Callable[[str, rosbridge.Id], None],
        user_bytes: UnfinishedCount,
        most: int = limits.CLIENT_MESSAGE,
    ) -> None:
        self._clock = clock
        self._earliest_sent = earliest_sent
        self._on_complete = on_complete
        self._on_expire = on_expire
        self._user_bytes = user_bytes
        self._most = most
        self._incomplete: dict[str | int, _Incomplete] = {}
        self._dropped: dict[str | int, None] = {}
        self._parts = 0
        self._bytes = 0
        self._timer: Timer | None = None

    def end(self) -> None:
        """The client is gone."""
        for id in list(self._incomplete):
            self._remove(id)
        cancel(self._timer)
        self._timer = None

    def add(self, part: rosbridge.Fragment) -> None:
        """Add a fragment; after an error all of its message is dropped.

        :raises Invalid: it does not fit the fragments before
        :raises Refused: the client has too many, or too large, incomplete messages
        """
        if isinstance(part.id, str) and len(part.id) > limits.LABEL_LENGTH:
            raise Invalid(f"'id' of a fragment may have {limits.LABEL_LENGTH} characters")
        if part.num == 0:
            self._dropped.pop(part.id, None)
        elif part.id in self._dropped:
            # It belongs to a message that was dropped already.
            return
        try:
            message = self._add(part, part.data.encode())
        except (Invalid, Refused):
            self._drop(part.id)
            raise
        if len(message.parts) == message.total:
            self._remove(part.id)
            self._on_complete(
                b"".join(message.parts[number] for number in range(message.total)), message.earliest_sent
            )

    def _add(self, part: rosbridge.Fragment, data: bytes) -> _Incomplete:
        _check(part)
        message = self._incomplete.get(part.id)
        if message is None:
            if len(self._incomplete) >= limits.INCOMPLETE_MESSAGES:
                raise Refused(f"{limits.INCOMPLETE_MESSAGES} messages in fragments are unfinished already")
            message = self._incomplete[part.id] = _Incomplete(
                part.total, self._earliest_sent(), self._clock.seconds()
            )
        if part.total != message.total:
            raise Invalid(f"'total' was {message.total} before and is {part.total} now")
        if part.num in message.parts:
            raise Invalid(f"fragment {part.num} came twice")
        if self._bytes + len(data) > self._most:
            raise Refused(f"messages in fragments have more than {self._most} bytes together")
        if self._parts >= PARTS:
            raise Refused(f"messages in fragments have more than {PARTS} fragments together")
        if not self._user_bytes.take(len(data) + PIECE_OVERHEAD):
            raise Refused(self._user_bytes.refusal)
        message.parts[part.num] = data
        message.bytes += len(data)
        message.touched = self._clock.seconds()
        self._parts += 1
        self._bytes += len(data)
        if self._timer is None:
            self._timer = self._clock.callLater(limits.FRAGMENT_SECONDS, self._expire)
        return message

    def _remove(self, id: str | int) -> _Incomplete | None:
        message = self._incomplete.pop(id, None)
        if message is not None:
            self._parts -= len(message.parts)
            self._bytes -= message.bytes
            self._user_bytes.give_back(message.held)
        return message

    def _drop(self, id: str | int) -> None:
        self._remove(id)
        self._dropped[id] = None
        if len(self._dropped) > limits.INCOMPLETE_MESSAGES:
            self._dropped.pop(next(iter(self._dropped)))

    def _expire(self) -> None:
        """Drop messages whose fragments have stopped coming, or come too slowly."""
        self._timer = None
        now = self._clock.seconds()
        for id in [id for id, each in self._incomplete.items() if each.expires <= now]:
            message = self._remove(id)
            assert message is not None
            stopped = now >= message.touched + limits.FRAGMENT_SECONDS
            when = (
                f"came, and then none for {limits.FRAGMENT_SECONDS:g}"
                if stopped
                else f"came in {now - message.begun:.0f}"
            )
            self._on_expire(
                f"a message in fragments is dropped: {len(message.parts)} of {message.total} {when} s", id
            )
        if self._incomplete:
            next_at = min(each.expires for each in self._incomplete.values())
            self._timer = self._clock.callLater(max(0.0, next_at - self._clock.seconds()), self._expire)


def _check(part: rosbridge.Fragment) -> None:
    if not 1 <= part.total <= PARTS:
        raise Invalid(f"'total' must be 1 to {PARTS}, not {str(part.total)[:20]}")
    if not 0 <= part.num < part.total:
        raise Invalid(f"'num' must be 0 to {part.total - 1}, not {str(part.num)[:20]}")
    if not part.data:
        raise Invalid("'data' of a fragment must not be empty")
