"""What time it is where a robot lives: the relay's wall clock, or the simulated time that the robot's ``/clock`` tells.

Source: ROS 2 design, "Clock and Time": with ``use_sim_time`` time is what ``/clock`` said last, and 0 before it said
anything.
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
from relay_server.channels.robot_link import RobotLinkState
from relay_server.channels.samples import Sample
from relay_server.channels.subscriptions import Subscriptions
from relay_server.common.clock import Clock
from relay_server.common.cpu_quota import UserQuotas

TOPIC = "/clock"
TYPE = "rosgraph_msgs/msg/Clock"

THROTTLE_MS = 20
"""Simulators tell the time up to a thousand times a second; stamps that are exact to this are exact enough."""

_NOBODY = -1
_CDR = {b"\x00\x01": "<iI", b"\x00\x00": ">iI"}


class RobotClock:
    """Follows a robot's ``/clock`` while its time is simulated, as one more member of its channel.

    :param wall_ns: Unix time in nanoseconds
    """

    log = Logger()
    user = _NOBODY
    plain_instead = 0
    queued_bytes = 0
    allowance = UserQuotas(lambda: 0.0, lambda: 0.0).of(_NOBODY)
    """Nothing is taken from it: ticks are read as the robot sends them."""

    def __init__(
        self, clock: Clock, wire: RobotLinkState, subscriptions: Subscriptions, wall_ns: Callable[[], int]
    ) -> None:
        self._clock = clock
        self._wire = wire
        self._subscriptions = subscriptions
        self._wall_ns = wall_ns
        self._newest = 0
        self._following = False

    def now_ns(self) -> int:
        """The robot's time, nanoseconds: since 1970, or since the simulation began."""
        return self._newest if self._wire.robot.description.sim_time else self._wall_ns()

    def follow(self) -> None:
        """The channel has opened, or the robot has described itself: subscribe to ``/clock``, or no longer."""
        wanted = self._wire.robot.description.sim_time
        if self._following and not wanted:
            self._following = False
            self._subscriptions.remove(self, TOPIC)
            self.lost()
        elif wanted and not self._following:
            ticks = _Ticks(self._clock, self, TOPIC)
            # As the robot sends it: the type need not be known.
            ticks.add(
                rosbridge.Subscribe(topic=TOPIC, throttle_rate=THROTTLE_MS), MessageEncoding("cbor-raw")
            )
            try:
                self._subscriptions.add(self, ticks, TYPE, None)
                self._following = True
            except SwitchboardError as error:
                self.tell("error", str(error))

    def lost(self) -> None:
        """The link is gone; nobody knows what time it will be when it is back."""
        self._newest = 0

    def tell(self, level: str, text: str, id: rosbridge.Id = None) -> None:
        """What a client would be told goes to the log."""
        self.log.warn(
            "the simulated time of {robot}: {text}", robot=self._wire.robot.full, text=text, severity=level
        )

    def dropped(self, listener: ClientSubscription) -> None:
        """None is queued."""

    def deliver(self, listener: ClientSubscription, parcel: Sample) -> None:
        """Keep the newest."""
        told = nanoseconds(parcel.body)
        if told is not None:
            self._newest = told


class _Ticks(ClientSubscription):
    """The robot throttles already: every sample that comes is taken at once."""

    def offer(self, sample: Sample) -> None:
        self.replay(sample)


class _Time(msgspec.Struct):
    sec: Annotated[int, msgspec.Meta(ge=0, lt=2**31)]
    nanosec: Annotated[int, msgspec.Meta(ge=0, lt=10**9)]


class _Clock(msgspec.Struct):
    clock: _Time


_clock_decoder: msgspec.json.Decoder[_Clock] = msgspec.json.Decoder(_Clock)


def nanoseconds(body: bytes) -> int | None:
    """What a ``rosgraph_msgs/msg/Clock`` says, in CDR with its header or as JSON; ``None`` when it is none."""
    order = _CDR.get(body[:2])
    try:
        if order is None:
            told = jsontext.decode(_clock_decoder, body).clock
            return told.sec * 10**9 + told.nanosec
        sec, nanosec = struct.unpack_from(order, body, 4)
    except (SwitchboardError, struct.error):
        return None
    return int(sec * 10**9 + nanosec) if sec >= 0 and nanosec < 10**9 else None
