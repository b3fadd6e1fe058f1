"""The latched (transient-local) samples of one topic, for clients that subscribe later.

Only the middleware knows which samples its publishers still keep: Fast DDS does not announce the depth of a publisher,
and rclpy does not report which publisher sent a sample. So the relay stores bodies, and for each new subscriber the
robot reports which of them are still kept (SPEC 2.5, ``known_stamps`` of ``subscribe``). For a robot that can't report
this, the relay replays as many of the last samples as the topic has publishers.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from relay_protocol import limits
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.members import ChannelMember
from relay_server.channels.samples import Sample
from relay_server.common.clock import Clock, Timer, cancel

MAX_SAMPLES = 1000
"""Most latched samples stored of one topic."""

MAX_STAMPS = 4 * MAX_SAMPLES
"""Most stamps of samples that came, also of those that are not stored any more."""

MAX_UNREPORTED = 64
"""Most latched samples, one for each publisher, of a robot that can't report which are still kept."""

LATCHED_BYTES = limits.ROBOT_FRAME
"""Most bytes of latched samples stored for one topic, and most that wait for its type."""

REPLAY_SECONDS = 0.5
"""Longest time in which a new subscriber receives no live samples, as the robot has to repeat older ones first."""

REQUEST_SECONDS = 0.1
"""Least seconds between two requests to the robot for one topic."""


class _Joiner:
    """A subscription that waits for the samples that publishers keep.

    :param since: the newest stamp when it subscribed
    :param live: whether it receives new samples directly; else :class:`LatchedSamples` replays those after ``since``
    """

    __slots__ = ("live", "received", "since", "subscription", "timer")

    def __init__(self, subscription: ClientSubscription, since: int, live: bool) -> None:
        self.subscription = subscription
        self.since = since
        self.live = live
        self.received: set[int] = set()
        self.timer: Timer | None = None

    def replay(self, stamp: int, sample: Sample) -> None:
        """Replay a sample, unless the subscription has received it."""
        if stamp not in self.received and not (self.live and stamp > self.since):
            self.received.add(stamp)
            self.subscription.replay(sample)


class LatchedSamples:
    """Stores latched samples and replays them; see the module's docstring.

    :param send_request: requests from the robot which samples publishers keep, and calls :meth:`request_sent`
    :param changed: called when the set of members that receive live samples has changed
    """

    def __init__(self, clock: Clock, send_request: Callable[[], None], changed: Callable[[], None]) -> None:
        self._clock = clock
        self._send_request = send_request
        self._changed = changed
        self.memory = ""
        """Name of the robot's memory of stamps: under the same name, a stamp means the same sample. Empty: the robot
        has no memory."""
        self.request_due = False
        """Whether a request is due."""
        self.newest = 0
        self._came: set[int] = set()
        """Stamps of the samples that came, without those up to :attr:`_earliest`."""
        self._earliest = 0
        """Samples up to this stamp are taken to have come."""
        self._limit = 1
        self._samples: dict[int, Sample] = {}
        self._bytes = 0
        self._joiners: dict[ChannelMember, _Joiner] = {}
        self._fresh_until = 0.0
        """Samples that come until then are counted as those that publishers keep. Infinite until the first has come."""
        self._fresh: set[int] = set()
        """Their stamps."""
        self._kept_before = 0
        """How many there were before the robot subscribed again."""
        self._confirmed: set[int] = set()
        """Stamps that the robot has reported as kept, since the last time no request was open."""
        self._open_requests = 0
        """Requests that the robot has not completed."""
        self._newest_at_request = 0
        """The newest stamp when the last request was sent."""
        self._requested_at = -REQUEST_SECONDS
        self._timer: Timer | None = None

    @property
    def stamps(self) -> list[int]:
        """Stamps of the stored samples, ascending."""
        return sorted(self._samples)

    @property
    def size(self) -> int:
        """Bytes of the stored samples."""
        return self._bytes

    @property
    def kept(self) -> int:
        """About how many samples the publishers keep: as many as came together when the robot had just subscribed."""
        fresh = len(self._fresh)
        return max(fresh, self._kept_before) if self._clock.seconds() < self._fresh_until else fresh

    def waits_for_replay(self, member: ChannelMember) -> bool:
        """Whether a member does not receive live samples yet."""
        joiner = self._joiners.get(member)
        return joiner is not None and not joiner.live

    def robot_subscribed(self, memory: str, publishers: int) -> None:
        """Handle that the robot has subscribed, or that its publishers have changed.

        :param memory: see :attr:`memory`
        :param publishers: how many the topic has
        """
        if memory != self.memory:
            self.forget()
            self.memory = memory
        self._limit = MAX_SAMPLES if memory else min(max(publishers, 1), MAX_UNREPORTED)
        self._trim()

    def begin(self, stamp: int) -> None:
        """Note that the topic is latched; samples up to this stamp came before that was known."""
        self.newest = max(self.newest, stamp)
        self._earliest = max(self._earliest, stamp)

    def begin_count(self) -> None:
        """Count the samples that publishers keep, as the robot is about to send them."""
        self._kept_before = self.kept
        self._fresh.clear()
        self._fresh_until = math.inf

    def forget(self) -> None:
        """Drop all samples, as they are no longer those of the topic."""
        self.lost()
        self._samples.clear()
        self._bytes = self.newest = self._earliest = 0
        self._came.clear()
        self._fresh.clear()

    def lost(self) -> None:
        """Handle the loss of the link. Samples stay: a robot with the same memory continues with its stamps."""
        cancel(self._timer)
        self._timer = None
        self._open_requests, self.request_due = 0, False
        self._confirmed.clear()
        for joiner in self._joiners.values():
            cancel(joiner.timer)
        self._joiners.clear()
        if not self.memory:
            self._samples.clear()
            self._bytes = 0

    # --- subscribers --------------------------------------------------------------------------------------

    def join(
        self, member: ChannelMember, subscription: ClientSubscription, live: bool, since: int | None = None
    ) -> None:
        """Replay to a member the samples that publishers keep.

        :param live: whether it receives the topic already, by another subscription
        :param since: the latest stamp when it subscribed; ``None``: that of now
        """
        if not self.memory:
            for sample in list(self._samples.values()):
                subscription.replay(sample)
            return
        self.leave(member)
        joiner = self._joiners[member] = _Joiner(subscription, self.newest if since is None else since, live)
        if not live:
            joiner.timer = self._clock.callLater(REPLAY_SECONDS, self._release, joiner)
        self.request_due = True
        if self._timer is None:
            pause = self._requested_at + REQUEST_SECONDS - self._clock.seconds()
            if pause > 0:
                self._timer = self._clock.callLater(pause, self._send_due_request)
            else:
                self._send_request()
        self._changed()

    def leave(self, member: ChannelMember) -> None:
        """Remove a member."""
        joiner = self._joiners.pop(member, None)
        if joiner is not None:
            cancel(joiner.timer)

    def request_sent(self) -> None:
        """Note that the request was sent."""
        self.request_due = False
        self._open_requests += 1
        self._newest_at_request = self.newest
        self._requested_at = self._clock.seconds()
        self.begin_count()

    def _send_due_request(self) -> None:
        self._timer = None
        if self.request_due:
            self._send_request()

    def _release(self, joiner: _Joiner) -> None:
        """Make a joiner live. It receives newer samples that the robot did not repeat; older ones were replaced."""
        cancel(joiner.timer)
        joiner.timer = None
        if joiner.live:
            return
        after = max(joiner.received, default=joiner.since)
        for stamp in self.stamps:
            if stamp > max(after, joiner.since):
                joiner.replay(stamp, self._samples[stamp])
        joiner.live, joiner.since = True, self.newest
        self._changed()

    # --- samples ------------------------------------------------------------------------------------------

    def add(self, frame_stamp: int, sample: Sample) -> bool:
        """Take a sample from the robot; return whether it is new to all members that receive live samples.

        :param frame_stamp: one that came before repeats a sample; the body is empty if the relay has it. 0 with an
            empty body ends a request. Those of several publishers may come in another order than at first.
        """
        if not self.memory:
            self.newest += 1
            self._count(self.newest)
            self._store(self.newest, sample)
            return True
        if frame_stamp:
            self._count(frame_stamp)
        if frame_stamp > self.newest:
            self.newest = frame_stamp
            self._note(frame_stamp)
            self._store(frame_stamp, sample)
            return True
        if sample.size and frame_stamp > self._earliest and frame_stamp not in self._came:
            self._add_late(frame_stamp, sample)
            return True
        if frame_stamp == 0 and not sample.size:
            self._request_ended()
            return False
        known = self._samples.get(frame_stamp)
        if known is None:
            if not sample.size:
                return False
            known = sample
            self._store(frame_stamp, sample)
        if frame_stamp in self._samples:
            self._confirmed.add(frame_stamp)
        for joiner in list(self._joiners.values()):
            joiner.replay(frame_stamp, known)
        return False

    def _add_late(self, stamp: int, sample: Sample) -> None:
        """Take a sample that is new, but older than another that has come."""
        self._note(stamp)
        self._store(stamp, sample)
        if stamp in self._samples:
            self._confirmed.add(stamp)
        for joiner in list(self._joiners.values()):
            if joiner.live:
                joiner.received.add(stamp)
            else:
                joiner.replay(stamp, sample)

    def _count(self, stamp: int) -> None:
        now = self._clock.seconds()
        if now >= self._fresh_until or len(self._fresh) >= MAX_SAMPLES:
            return
        if not self._fresh:
            self._fresh_until = now + REPLAY_SECONDS
        self._fresh.add(stamp)

    def _note(self, stamp: int) -> None:
        self._came.add(stamp)
        if len(self._came) > MAX_STAMPS:
            # Half at once, so that not every further sample costs a search.
            came = sorted(self._came)
            self._earliest = came[MAX_STAMPS // 2]
            self._came = set(came[MAX_STAMPS // 2 + 1 :])

    def _request_ended(self) -> None:
        """End a request, and drop the samples that no publisher keeps any more."""
        self._open_requests = max(0, self._open_requests - 1)
        if self._open_requests or self.request_due:
            return
        for stamp in self.stamps:
            if stamp <= self._newest_at_request and stamp not in self._confirmed:
                self._drop(stamp)
        self._confirmed.clear()
        for joiner in list(self._joiners.values()):
            self._release(joiner)
        self._joiners.clear()

    def _store(self, stamp: int, sample: Sample) -> None:
        self._samples[stamp] = sample
        self._bytes += sample.size
        self._trim()

    def _trim(self) -> None:
        """Drop the oldest samples beyond the limits of count and bytes."""
        # A single sample is stored whatever its size.
        while len(self._samples) > self._limit or (self._bytes > LATCHED_BYTES and len(self._samples) > 1):
            self._drop(min(self._samples))

    def _drop(self, stamp: int) -> None:
        self._bytes -= self._samples.pop(stamp).size
        self._confirmed.discard(stamp)
        for joiner in self._joiners.values():
            joiner.received.discard(stamp)
