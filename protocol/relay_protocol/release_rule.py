"""When a source must release the controls before it may command motion again: one rule for relay and robot.

A stream is the commands of one source, for example of one connection to one topic. A stream that went on commanding
while it was not permitted must be released first: a user who held the stick all the time does not move the robot the
moment it is permitted again. A stream is released by a command that is zero, or by silence of :data:`RELEASE_NS`
(SPEC 1.7 and 2.5). Reconnecting does not count as a release.

Times are nanoseconds of one monotonic clock. ``now`` is when a command arrived, ``earliest_sent`` the earliest moment
at which it can have been sent. Silence ends at ``earliest_sent``: a link that stalls makes none.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, NamedTuple, TypeVar

RELEASE_NS = 500_000_000
"""Silence of this length is a release."""

RECONNECT_NS = 5_000_000_000
"""After a link is back, a first command within this time may continue one from before. A later one does not."""

HELD_NS = 1_000_000_000
"""A client that was alive later than this after its last command has released the controls before it was lost. Pings
show no shorter time."""

QUEUED_NS = 300_000_000_000
"""The first commands of a new connection may have waited for it in a queue of the client, this long at most."""

Key = TypeVar("Key", bound=Hashable)


def is_released(last: int, earliest_sent: int) -> bool:
    """Whether the silence between two commands is a release.

    :param last: arrival of the earlier one
    :param earliest_sent: of the later one
    """
    return earliest_sent - last >= RELEASE_NS


class CommandStream:
    """One stream.

    :ivar last: arrival of its latest command
    :ivar must_release: it commands nothing before it is released
    :ivar never_contended: no source has had control since it began. Programs take a free robot in this way: they send
        commands until the robot is theirs
    :ivar began: whether its latest command was the first
    """

    __slots__ = ("began", "last", "must_release", "never_contended")

    def __init__(self, last: int, *, must_release: bool = False) -> None:
        self.last = last
        self.must_release = must_release
        self.never_contended = True
        self.began = True


class CommandStreams(Generic[Key]):
    """The latest streams, by key; the one that was silent longest is forgotten first.

    :param capacity: most streams that are remembered; ``None`` where the caller forgets them
    """

    __slots__ = ("_capacity", "_streams")

    def __init__(self, capacity: int | None = None) -> None:
        self._capacity = capacity
        self._streams: OrderedDict[Key, CommandStream] = OrderedDict()

    def __contains__(self, key: Key) -> bool:
        return key in self._streams

    def __len__(self) -> int:
        return len(self._streams)

    def note_command(
        self, key: Key, now: int, earliest_sent: int, *, silence_releases: bool = True
    ) -> CommandStream:
        """A command that moves has arrived; its stream, a new one after a release.

        :param silence_releases: false while no silence counts, as in a stop
        """
        stream = self._streams.get(key)
        if stream is None or (silence_releases and is_released(stream.last, earliest_sent)):
            self._streams.pop(key, None)
            self._make_room(now, keep_refused=not silence_releases)
            stream = self._streams[key] = CommandStream(now)
        else:
            stream.began = False
            stream.last = now
            self._streams.move_to_end(key)
        return stream

    def refused(self, key: Key, now: int) -> None:
        """A command that moves was not permitted: the stream must be released."""
        self._streams.pop(key, None)
        self._make_room(now)
        self._streams[key] = CommandStream(now, must_release=True)

    def zero(self, key: Key) -> None:
        """A command that is zero has arrived: the stream is released."""
        self._streams.pop(key, None)

    def pop(self, key: Key) -> int | None:
        """Forget a stream; when its latest command arrived, ``None`` where there was none."""
        stream = self._streams.pop(key, None)
        return None if stream is None else stream.last

    def last(self, key: Key) -> int | None:
        """When the latest command of a stream arrived, ``None`` where there is none."""
        stream = self._streams.get(key)
        return None if stream is None else stream.last

    def must_release(self, key: Key, earliest_sent: int) -> bool:
        """Whether a command of this stream is refused until it is released."""
        stream = self._streams.get(key)
        return stream is not None and stream.must_release and not is_released(stream.last, earliest_sent)

    def all_must_release(self) -> None:
        """No stream goes on: the robot was stopped, or its link lost."""
        for stream in self._streams.values():
            stream.must_release = True

    def require_release(self, condition: Callable[[Key, CommandStream], bool]) -> None:
        """Streams that meet a condition must be released."""
        for key, stream in self._streams.items():
            stream.must_release = stream.must_release or condition(key, stream)

    def restart_silence(self, now: int) -> None:
        """Silence counts from now on: what was sent before need not have arrived."""
        for stream in self._streams.values():
            stream.last = now

    def forget_released(self, now: int, *, keep_refused: bool = False) -> None:
        """Forget streams that silence has released.

        :param keep_refused: keep those that must be released, as in a stop, where no silence counts
        """
        for key, stream in list(self._streams.items()):
            if is_released(stream.last, now) and not (keep_refused and stream.must_release):
                del self._streams[key]

    def _make_room(self, now: int, *, keep_refused: bool = False) -> None:
        if self._capacity is None or len(self._streams) < self._capacity:
            return
        # Released ones first: new streams must not have one forgotten that must be released.
        self.forget_released(now, keep_refused=keep_refused)
        if len(self._streams) >= self._capacity:
            self._streams.popitem(last=False)


class _LostConnection(NamedTuple):
    """A connection of a user that has ended.

    :param commanded: arrival of its latest command
    :param ended: when it was known to have ended; ``None`` where its user had released, or closed it
    """

    commanded: int
    ended: int | None


class ReconnectGuard:
    """Users whose connection ended while they commanded, for the relay.

    Libraries reconnect by themselves, go on commanding, and send what waited in their queues meanwhile. Nothing
    distinguishes that from a program that was started again, so it is judged by time and by how the connection ended.

    :param capacity: most users that are remembered; the least recent are forgotten first
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._lost: OrderedDict[int, _LostConnection] = OrderedDict()

    def connection_ended(self, user: int, commanded: int, now: int, *, released: bool) -> None:
        """A connection has ended, or nothing arrives by it any more.

        :param commanded: arrival of its latest command
        :param released: whether its user is known to have released the controls
        """
        before = self._lost.pop(user, None)
        ended = None if released else now
        if before is not None:
            commanded = max(commanded, before.commanded)
            ended = before.ended if ended is None else ended
        self._lost[user] = _LostConnection(commanded, ended)
        while len(self._lost) > self._capacity:
            self._lost.popitem(last=False)

    def forget(self, user: int) -> None:
        """The user has requested control explicitly, or released it: commands from now on are meant."""
        self._lost.pop(user, None)

    def may_be_queued(self, user: int, opened: int, now: int) -> bool:
        """Whether a command by a new connection may have waited for it since the earlier one was lost.

        :param opened: when the new connection was opened
        """
        away = self._away(user, opened)
        return away is not None and RECONNECT_NS < away <= QUEUED_NS and not is_released(opened, now)

    def silent_since(self, user: int, opened: int) -> int | None:
        """From when on silence of a new connection counts as a release; ``None`` where none is needed.

        :param opened: when the new connection was opened
        """
        lost, away = self._lost.get(user), self._away(user, opened)
        if lost is None:
            return None
        if away is None:
            return lost.commanded
        # Nothing could arrive without a connection: that is no silence.
        return max(lost.commanded, opened) if away <= RECONNECT_NS else None

    def _away(self, user: int, opened: int) -> int | None:
        lost = self._lost.get(user)
        return None if lost is None or lost.ended is None else opened - lost.ended


class StreamsBeforeLoss:
    """Sources and users that commanded before the robot's link to the relay was lost, for the robot.

    :param capacity: most sources, users and streams of each kind that are remembered
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self.lost = False
        """Whether there is no link, and was one."""
        self._restored: int | None = None
        """When the present link began, if there was one before."""
        self._commanded: dict[int, None] = {}
        """Sources that have commanded since the present link began, the latest last."""
        self._commanded_before: dict[int, None] = {}
        self._holders: dict[str, None] = {}
        """Users who have had control since the present link began, the latest last."""
        self._holders_before: dict[str, None] = {}
        """After a restart of the relay they come under another number."""
        self._seen_again: dict[tuple[int, str], None] = {}
        """Sources and topics with a command soon after the link was restored."""
        self._released: dict[tuple[str, str], None] = {}
        """Users and topics they have released since then, by any connection."""

    def note_command(self, source: int) -> None:
        """A command of any kind has arrived."""
        self._note(self._commanded, source)

    def decided_on(self, source: int, topic: str, now: int) -> None:
        """The command was allowed or refused: it is no first one any more."""
        if self.restored_recently(now):
            self._note(self._seen_again, (source, topic))

    def controlled_by(self, user: str) -> None:
        """A user has got control."""
        self._note(self._holders, user)

    def released(self, user: str, topic: str) -> None:
        """The user who has control has released a topic."""
        self._note(self._released, (user, topic))

    def link_lost(self) -> None:
        """From now on those that have commanded are those from before."""
        self._restored = None
        for source in self._commanded:
            self._note(self._commanded_before, source)
        self._commanded.clear()
        for user in self._holders:
            self._note(self._holders_before, user)
        self._holders.clear()
        self.lost = True

    def link_restored(self, now: int) -> None:
        """There is a link again."""
        self.lost = False
        self._restored = now
        self._seen_again.clear()
        self._released.clear()

    def restored_recently(self, now: int) -> bool:
        """Whether a stream from before may not have arrived yet: its channel link has to be restored first."""
        return self._restored is not None and now - self._restored < RECONNECT_NS

    def continues(self, source: int, topic: str, holder_user: str | None, now: int) -> bool:
        """Whether the first command of a stream may continue one from before the link was lost.

        :param holder_user: the user, where the source has control; ``None`` otherwise
        """
        if not self.restored_recently(now) or (source, topic) in self._seen_again:
            return False
        return source in self._commanded_before or (
            holder_user is not None and self.held_on(holder_user, topic)
        )

    def held_on(self, user: str, topic: str) -> bool:
        """Whether a user had control before the link was lost, and has not released the topic since."""
        return user in self._holders_before and (user, topic) not in self._released

    def _note(self, known: dict[Key, None], key: Key) -> None:
        known.pop(key, None)
        known[key] = None
        if len(known) > self._capacity:
            del known[next(iter(known))]
