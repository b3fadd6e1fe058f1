"""Messages that a client sends in fragments (rosbridge v2 protocol, section 3.1.1; SPEC section 1.6)."""

from __future__ import annotations

from collections.abc import Callable

from relay_protocol import limits, rosbridge
from relay_protocol.errors import Invalid, Refused
from relay_server.common.clock import Clock, Timer, cancel

PARTS = 16_384
"""Fragments of one message, and of all that are unfinished: each takes memory beside its bytes."""


class _Unfinished:
    """A message of which something has come."""

    __slots__ = ("bytes", "parts", "since", "total", "touched")

    def __init__(self, total: int, since: int) -> None:
        self.total = total
        self.since = since
        self.parts: dict[int, bytes] = {}
        self.bytes = 0
        self.touched = 0.0


class FragmentAssembler:
    """The unfinished messages of one client. What they take is what has come of them, whatever they announce.

    :param not_before: the moment before which what comes now can't have been sent, see
        :class:`relay_server.sessions.message_age.MessageAge`
    :param finished: takes the text of a message that is whole, and that moment for its first fragment: a
        command is as old as its beginning
    :param most: bytes that may have come of all of them
    :param given_up: takes the words about one that is not, and its id
    """

    # Every client has one of these, and hardly any uses it.
    __slots__ = (
        "_bytes",
        "_clock",
        "_dropped",
        "_finished",
        "_given_up",
        "_most",
        "_not_before",
        "_parts",
        "_timer",
        "_unfinished",
    )

    def __init__(
        self,
        clock: Clock,
        not_before: Callable[[], int],
        finished: Callable[[bytes, int], None],
        given_up: Callable[[str, rosbridge.Id], None],
        most: int = limits.CLIENT_MESSAGE,
    ) -> None:
        self._clock = clock
        self._not_before = not_before
        self._finished = finished
        self._given_up = given_up
        self._most = most
        self._unfinished: dict[str | int, _Unfinished] = {}
        self._dropped: dict[str | int, None] = {}
        self._parts = 0
        self._bytes = 0
        self._timer: Timer | None = None

    def end(self) -> None:
        """The client is gone."""
        self._unfinished.clear()
        cancel(self._timer)
        self._timer = None

    def take(self, part: rosbridge.Fragment) -> None:
        """One more fragment.

        :raises Invalid: it does not fit what came before; all of its message is let go
        :raises Refused: too much is unfinished; all of its message is let go
        """
        if isinstance(part.id, str) and len(part.id) > limits.LABEL:
            raise Invalid(f"'id' of a fragment may have {limits.LABEL} characters")
        if part.num == 0:
            self._dropped.pop(part.id, None)
        elif part.id in self._dropped:
            # The rest of a message that was refused already.
            return
        try:
            message = self._add(part, part.data.encode())
        except (Invalid, Refused):
            self._drop(part.id)
            raise
        if len(message.parts) == message.total:
            self._remove(part.id)
            self._finished(b"".join(message.parts[number] for number in range(message.total)), message.since)

    def _add(self, part: rosbridge.Fragment, data: bytes) -> _Unfinished:
        _check(part)
        message = self._unfinished.get(part.id)
        if message is None:
            if len(self._unfinished) >= limits.FRAGMENTS:
                raise Refused(f"{limits.FRAGMENTS} messages in fragments are unfinished already")
            message = self._unfinished[part.id] = _Unfinished(part.total, self._not_before())
        if part.total != message.total:
            raise Invalid(f"'total' was {message.total} before and is {part.total} now")
        if part.num in message.parts:
            raise Invalid(f"fragment {part.num} came twice")
        if self._bytes + len(data) > self._most:
            raise Refused(f"messages in fragments have more than {self._most} bytes together")
        if self._parts >= PARTS:
            raise Refused(f"messages in fragments have more than {PARTS} fragments together")
        message.parts[part.num] = data
        message.bytes += len(data)
        message.touched = self._clock.seconds()
        self._parts += 1
        self._bytes += len(data)
        if self._timer is None:
            self._timer = self._clock.callLater(limits.FRAGMENT_SECONDS, self._look)
        return message

    def _remove(self, id: str | int) -> _Unfinished | None:
        message = self._unfinished.pop(id, None)
        if message is not None:
            self._parts -= len(message.parts)
            self._bytes -= message.bytes
        return message

    def _drop(self, id: str | int) -> None:
        self._remove(id)
        self._dropped[id] = None
        if len(self._dropped) > limits.FRAGMENTS:
            self._dropped.pop(next(iter(self._dropped)))

    def _look(self) -> None:
        """Give up what has not gone on for too long."""
        self._timer = None
        oldest = self._clock.seconds() - limits.FRAGMENT_SECONDS
        for id in [id for id, each in self._unfinished.items() if each.touched <= oldest]:
            message = self._remove(id)
            assert message is not None
            self._given_up(
                f"a message in fragments is given up: {len(message.parts)} of {message.total} came, "
                f"and then nothing for {limits.FRAGMENT_SECONDS:g} s",
                id,
            )
        if self._unfinished:
            next_at = min(each.touched for each in self._unfinished.values()) + limits.FRAGMENT_SECONDS
            self._timer = self._clock.callLater(max(0.0, next_at - self._clock.seconds()), self._look)


def _check(part: rosbridge.Fragment) -> None:
    if not 1 <= part.total <= PARTS:
        raise Invalid(f"'total' must be 1 to {PARTS}, not {str(part.total)[:20]}")
    if not 0 <= part.num < part.total:
        raise Invalid(f"'num' must be 0 to {part.total - 1}, not {str(part.num)[:20]}")
    if not part.data:
        raise Invalid("'data' of a fragment must not be empty")
