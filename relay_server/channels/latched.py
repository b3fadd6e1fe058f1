"""The latched (transient-local) samples of one topic, for clients that subscribe later.

Only the middleware knows what its publishers still keep: the depth of each is not in the graph (Fast DDS does not
announce it), and rclpy does not tell which publisher a sample is of. So the relay keeps bodies, and for each new
subscriber the robot says which of them are still kept (SPEC 2.5, ``kept`` of ``subscribe``). Of a robot that can't say
that, the relay replays as many of the last samples as the topic has publishers.
"""

from __future__ import annotations

from collections.abc import Callable

from relay_protocol import limits
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.robot_link import Subscriber
from relay_server.channels.samples import Sample
from relay_server.common.clock import Clock, Timer, cancel

MOST = 1000
"""Latched samples kept of one topic."""

MOST_UNTOLD = 64
"""Latched samples kept of one topic of a robot that can't say which are still kept: one for each publisher."""

KEPT_BYTES = limits.ROBOT_FRAME
"""Most bytes of latched samples kept for one topic, and most that wait for its type."""

HOLD_SECONDS = 0.5
"""A new subscriber gets no live samples for so long, unless the robot repeats them: older ones are to come first."""

ASK_SECONDS = 0.1
"""Least time from one request for what is kept to the next of the same topic."""


class _Joiner:
    """A subscription that is to get what publishers keep.

    :param since: the newest stamp it has had, or could have had
    :param live: whether it gets samples as they come; else those after ``since`` are given by :class:`Latched`
    """

    __slots__ = ("given", "listener", "live", "since", "timer")

    def __init__(self, listener: ClientSubscription, since: int, live: bool) -> None:
        self.listener = listener
        self.since = since
        self.live = live
        self.given: set[int] = set()
        self.timer: Timer | None = None

    def give(self, stamp: int, sample: Sample) -> None:
        """Replay a sample, once."""
        if stamp not in self.given and not (self.live and stamp > self.since):
            self.given.add(stamp)
            self.listener.replay(sample)


class Latched:
    """See the module's text.

    :param ask: asks the robot which samples publishers keep; :meth:`asked` follows when that goes out
    :param changed: called when another set of members is to get live samples
    """

    def __init__(self, clock: Clock, ask: Callable[[], None], changed: Callable[[], None]) -> None:
        self._clock = clock
        self._ask = ask
        self._changed = changed
        self.memory = ""
        """Names the robot's memory of stamps: under the same name, a stamp means the same sample. Empty: there is none.
        """
        self.wanted = False
        """Whether the robot is to be asked."""
        self.newest = 0
        self._most = 1
        self._samples: dict[int, Sample] = {}
        self._bytes = 0
        self._joiners: dict[Subscriber, _Joiner] = {}
        self._told: set[int] = set()
        """Stamps that the robot has said are kept, since nobody waited for that."""
        self._open = 0
        """Requests that the robot has not done with."""
        self._since = 0
        """The newest stamp when the robot was last asked."""
        self._asked_at = -ASK_SECONDS
        self._timer: Timer | None = None

    @property
    def stamps(self) -> list[int]:
        """Stamps of the samples whose bodies the relay has."""
        return sorted(self._samples)

    @property
    def size(self) -> int:
        """Bytes kept."""
        return self._bytes

    def holds(self, member: Subscriber) -> bool:
        """Whether a member gets no live samples yet."""
        joiner = self._joiners.get(member)
        return joiner is not None and not joiner.live

    def robot(self, memory: str, publishers: int) -> None:
        """The robot has subscribed, or its publishers have changed."""
        if memory != self.memory:
            self.forget()
            self.memory = memory
        self._most = MOST if memory else min(max(publishers, 1), MOST_UNTOLD)
        self._trim()

    def begin(self, stamp: int) -> None:
        """The topic is latched from now on; samples up to this stamp came before that was known."""
        self.newest = max(self.newest, stamp)

    def forget(self) -> None:
        """The samples are not those of the topic any more."""
        self.lost()
        self._samples.clear()
        self._bytes = self.newest = 0

    def lost(self) -> None:
        """The link is gone. A robot with the same memory goes on with its stamps: nobody gets a sample twice."""
        cancel(self._timer)
        self._timer = None
        self._open, self.wanted = 0, False
        self._told.clear()
        for joiner in self._joiners.values():
            cancel(joiner.timer)
        self._joiners.clear()
        if not self.memory:
            self._samples.clear()
            self._bytes = 0

    # --- subscribers --------------------------------------------------------------------------------------

    def join(
        self, member: Subscriber, listener: ClientSubscription, live: bool, since: int | None = None
    ) -> None:
        """Give a member what publishers keep.

        :param live: whether it has the topic already, by another subscription
        :param since: the latest stamp when it subscribed; ``None`` for now
        """
        if not self.memory:
            for sample in list(self._samples.values()):
                listener.replay(sample)
            return
        self.leave(member)
        joiner = self._joiners[member] = _Joiner(listener, self.newest if since is None else since, live)
        if not live:
            joiner.timer = self._clock.callLater(HOLD_SECONDS, self._release, joiner)
        self.wanted = True
        if self._timer is None:
            pause = self._asked_at + ASK_SECONDS - self._clock.seconds()
            if pause > 0:
                self._timer = self._clock.callLater(pause, self._ask_now)
            else:
                self._ask()
        self._changed()

    def leave(self, member: Subscriber) -> None:
        """A member has gone."""
        joiner = self._joiners.pop(member, None)
        if joiner is not None:
            cancel(joiner.timer)

    def asked(self) -> None:
        """The robot has been sent the request."""
        self.wanted = False
        self._open += 1
        self._since = self.newest
        self._asked_at = self._clock.seconds()

    def _ask_now(self) -> None:
        self._timer = None
        if self.wanted:
            self._ask()

    def _release(self, joiner: _Joiner) -> None:
        """Live from now on. What came live and was not repeated is given; what is older than that was replaced."""
        cancel(joiner.timer)
        joiner.timer = None
        if joiner.live:
            return
        after = max(joiner.given, default=joiner.since)
        for stamp in self.stamps:
            if stamp > max(after, joiner.since):
                joiner.give(stamp, self._samples[stamp])
        joiner.live, joiner.since = True, self.newest
        self._changed()

    # --- samples ------------------------------------------------------------------------------------------

    def take(self, stamp: int, sample: Sample) -> bool:
        """Take a sample from the robot; whether it is new to all who get live samples.

        :param stamp: of the frame. One that is not newer than all before it repeats a sample, without its body where
            the relay has that; 0 ends what was asked for.
        """
        if not self.memory:
            self.newest += 1
            self._keep(self.newest, sample)
            return True
        if stamp > self.newest:
            self.newest = stamp
            self._keep(stamp, sample)
            return True
        if stamp == 0 and not sample.size:
            self._ended()
            return False
        known = self._samples.get(stamp)
        if known is None:
            if not sample.size:
                return False
            known = sample
            self._keep(stamp, sample)
        if stamp in self._samples:
            self._told.add(stamp)
        for joiner in list(self._joiners.values()):
            joiner.give(stamp, known)
        return False

    def _ended(self) -> None:
        """The robot has done with a request: what no publisher keeps any more is forgotten."""
        self._open = max(0, self._open - 1)
        if self._open or self.wanted:
            return
        for stamp in self.stamps:
            if stamp <= self._since and stamp not in self._told:
                self._drop(stamp)
        self._told.clear()
        for joiner in list(self._joiners.values()):
            self._release(joiner)
        self._joiners.clear()

    def _keep(self, stamp: int, sample: Sample) -> None:
        self._samples[stamp] = sample
        self._bytes += sample.size
        self._trim()

    def _trim(self) -> None:
        """The newest count, as far as they are not too large together."""
        # One is kept however large it is.
        while len(self._samples) > self._most or (self._bytes > KEPT_BYTES and len(self._samples) > 1):
            self._drop(min(self._samples))

    def _drop(self, stamp: int) -> None:
        self._bytes -= self._samples.pop(stamp).size
        self._told.discard(stamp)
        for joiner in self._joiners.values():
            joiner.given.discard(stamp)
