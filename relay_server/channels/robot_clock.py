"""The time of a robot: the relay's wall clock, or the simulated time that is published on the robot's ``/clock``.

Source: ROS 2 design, "Clock and Time": with ``use_sim_time`` the time is that of the latest message of ``/clock``,
and 0 before the first.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Annotated

import msgspec
from twisted.logger import Logger

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import SwitchboardError
from relay_server.channels.client_subscription import ClientSubscription
from relay_server.channels.encodings import MessageEncoding
from relay_server.channels.link_state import RobotLinkState
from relay_server.channels.samples import Sample
from relay_server.channels.subscriptions import Subscriptions
from relay_server.common.clock import Clock

TOPIC = "/clock"
TYPE = "rosgraph_msgs/msg/Clock"

THROTTLE_MS = 20
"""Least milliseconds between two messages. Simulators publish up to a thousand a second; stamps can be coarser."""

_NO_USER = -1
_CDR = {b"\x00\x01": "<iI", b"\x00\x00": ">iI"}


FORWARD_SECONDS = 10.0
MOST_SPEED = 100.0
"""Simulated time jumps forward if it is :data:`FORWARD_SECONDS` ahead of a simulation that is so many times as fast as
real time."""


class RobotClock:
    """Subscribes to a robot's ``/clock`` while its time is simulated, as one more subscriber of its channel.

    :param wall_ns: Unix time in nanoseconds
    """

    log = Logger()
    user = _NO_USER
    plain_instead = 0
    queued_bytes = 0

    def __init__(
        self,
        clock: Clock,
        link_state: RobotLinkState,
        subscriptions: Subscriptions,
        wall_ns: Callable[[], int],
    ) -> None:
        self._clock = clock
        self._link_state = link_state
        self._subscriptions = subscriptions
        self._wall_ns = wall_ns
        self._newest = 0
        self._latest_known = 0
        """As the newest time, but kept while the time is unknown: the simulation may have begun again meanwhile."""
        self._following = False
        self.jumps = 0
        """How often the simulated time has jumped back."""
        self.on_jump: list[Callable[[float], None]] = []
        """Called with the seconds by which the simulated time has jumped, negative if back, before any sample with the
        new time is delivered."""
        self._known_at: float | None = None
        """When the latest time came; ``None``: time is unknown."""

    def now_ns(self) -> int:
        """The robot's time, nanoseconds: since 1970, or since the simulation began."""
        return self._newest if self._link_state.robot.description.sim_time else self._wall_ns()

    def follow(self) -> None:
        """Subscribe to ``/clock`` or unsubscribe, as the channel has opened or the robot's description has changed."""
        wanted = self._link_state.robot.description.sim_time
        if self._following and not wanted:
            self._following = False
            self._subscriptions.remove(self, TOPIC)
            self.lost()
        elif wanted and not self._following:
            subscription = _ClockSubscription(self._clock, self, TOPIC)
            # cbor-raw is what the robot sends, so the type's definition is not needed.
            subscription.add(
                rosbridge.Subscribe(topic=TOPIC, throttle_rate=THROTTLE_MS), MessageEncoding("cbor-raw")
            )
            try:
                self._subscriptions.add(self, subscription, TYPE, None)
                self._following = True
            except SwitchboardError as error:
                self.notify("error", str(error))

    def lost(self) -> None:
        """The link is lost; the time is unknown until the next message."""
        self._newest = 0
        self._known_at = None

    def warn_of_drops(self, text: str, id: rosbridge.Id = None) -> None:
        """Log it."""
        self.notify("warning", text)

    def notify(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """Log a status."""
        self.log.warn(
            "the simulated time of {robot}: {text}",
            robot=self._link_state.robot.full,
            text=text,
            severity=level,
        )

    def dropped(self, subscription: ClientSubscription) -> None:
        """Nothing: no sample is queued here."""

    def deliver(self, subscription: ClientSubscription, sample: Sample) -> None:
        """Store the time of a sample."""
        time = nanoseconds(sample.body)
        if time is None:
            return
        step = (time - self._latest_known) / 1e9
        now, before = self._clock.seconds(), self._known_at
        self._newest = self._latest_known = time
        self._known_at = now
        if step < 0:
            self.jumps += 1
        elif before is None or step < FORWARD_SECONDS + MOST_SPEED * (now - before):
            return
        for notify in list(self.on_jump):
            notify(step)


class _ClockSubscription(ClientSubscription):
    """A subscription without a throttle of its own, as the robot throttles already."""

    def receive(self, sample: Sample) -> None:
        self.replay(sample)


class _Time(msgspec.Struct):
    sec: Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
    nanosec: Annotated[int, msgspec.Meta(ge=0, lt=10**9)]


class _Clock(msgspec.Struct):
    clock: _Time


_clock_decoder: msgspec.json.Decoder[_Clock] = msgspec.json.Decoder(_Clock)


def nanoseconds(body: bytes) -> int | None:
    """The time in a ``rosgraph_msgs/msg/Clock``; ``None`` if the body is no such message.

    :param body: CDR with its header, or JSON
    """
    order = _CDR.get(body[:2])
    try:
        if order is None:
            time = jsontext.decode(_clock_decoder, body).clock
            return time.sec * 10**9 + time.nanosec
        sec, nanosec = struct.unpack_from(order, body, 4)
    except (SwitchboardError, struct.error):
        return None
    return int(sec * 10**9 + nanosec) if sec >= 0 and nanosec < 10**9 else None
