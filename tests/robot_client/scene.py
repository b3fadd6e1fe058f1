"""One channel on the memory platform, and a recorder in place of its link."""

from __future__ import annotations

from typing import Any, cast

from twisted.internet.task import Clock

from relay_protocol import link
from relay_protocol.frames import CommandFrame, FrameDecoder, SampleFrame
from relay_protocol.link import MotionPolicy
from robot_client.channel.channel import RobotChannel
from robot_client.channel.parts import ChannelWriter
from robot_client.link.clock_offset import ClockOffset
from robot_client.link.transport import MOST_AT_ONCE
from robot_client.motion.authority import Authority
from robot_client.motion.gate import MotionGate
from robot_client.motion.guard_port import NoGuard
from robot_client.motion.motion import MotionControl
from robot_client.platforms.base import GraphView
from robot_client.platforms.memory import TWIST, MemoryPlatform

STRING = "std_msgs/msg/String"
DRIVER = 7
"""The source that holds control."""


class Recorder(ChannelWriter):
    def __init__(self) -> None:
        self.said: list[Any] = []
        self.writes: list[list[bytes]] = []

    def say(self, message: link.Message) -> None:
        self.said.append(message)

    @property
    def room(self) -> int:
        """As much as is written at once."""
        return MOST_AT_ONCE

    def write(self, frames: list[bytes]) -> None:
        self.writes.append(frames)


class Scene:
    def __init__(self) -> None:
        self.clock = Clock()
        self.clock.advance(100)
        self.platform = MemoryPlatform(GraphView(topics={"/chat": link.Topic(types=[STRING])}))
        self.wire = Recorder()
        self.offset = ClockOffset()
        self.offset.add(self.now(), self.now(), self.now())
        policy = MotionPolicy(types=[TWIST], services=["/arm/*"], actions=["/navigate_to_pose"])
        self.authority = Authority()
        self.authority.hold(DRIVER, "ann", "operator", 0)
        self.silent: dict[str, bool] = {}
        self.desk = MotionControl(policy, self.platform, self.clock, self.now, NoGuard(), self.authority)
        self.gate = MotionGate(policy, self.platform, self.authority, self.now)
        self.channel = RobotChannel(
            "c1",
            self.wire,
            self.offset,
            self.platform,
            self.desk,
            self.clock,
            2**24,
            self.gate,
            self.silent,
            wall=lambda: 777,
        )

    def now(self) -> int:
        return round(self.clock.seconds() * 1e9)

    def ask(self, message: link.Message) -> Any:
        self.channel.handle(message)
        return self.wire.said[-1] if self.wire.said else None

    def frames(self) -> list[SampleFrame]:
        data = b"".join(piece for write in self.wire.writes for piece in write)
        return cast("list[SampleFrame]", FrameDecoder(2**25).feed(data))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 100)):
            self.clock.advance(0.01)

    def drive(self, body: bytes, source: int = DRIVER) -> None:
        self.channel.command(CommandFrame(5, self.now(), source, body))
