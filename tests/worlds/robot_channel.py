"""One channel on the memory platform, and a recorder in place of its link."""

from __future__ import annotations

from typing import Any, cast

from twisted.internet.task import Clock

from relay_protocol import link
from relay_protocol.frames import CommandFrame, FrameDecoder, SampleFrame
from relay_protocol.link import MotionPolicy
from robot_client.channel.channel import RobotChannel
from robot_client.channel.handler import ChannelWriter
from robot_client.link.clock_offset import ClockOffset
from robot_client.link.transport import MAX_WRITE
from robot_client.motion.authority import Authority
from robot_client.motion.guard_port import NoGuard
from robot_client.motion.motion_control import MotionControl
from robot_client.motion.request_gate import MotionRequestGate
from robot_client.platforms.base import GraphView
from tests.worlds.memory_platform import TWIST, MemoryPlatform

STRING = "std_msgs/msg/String"
DRIVER = 7
"""The source that holds control."""


class RecordingWriter(ChannelWriter):
    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.writes: list[list[bytes]] = []

    def send(self, message: link.Message) -> None:
        self.sent.append(message)

    @property
    def room(self) -> int:
        """As much as is written at once."""
        return MAX_WRITE

    def write(self, frames: list[bytes]) -> None:
        self.writes.append(frames)


class ChannelWorld:
    def __init__(self) -> None:
        self.clock = Clock()
        self.clock.advance(100)
        self.platform = MemoryPlatform(GraphView(topics={"/chat": link.Topic(types=[STRING])}))
        self.writer = RecordingWriter()
        self.offset = ClockOffset()
        self.offset.add(self.now(), self.now(), self.now())
        policy = MotionPolicy(types=[TWIST], services=["/arm/*"], actions=["/navigate_to_pose"])
        self.authority = Authority()
        self.authority.grant_control(DRIVER, "ann", "operator", 0)
        self.inhibited: dict[str, bool] = {}
        self.motion = MotionControl(policy, self.platform, self.clock, self.now, NoGuard(), self.authority)
        self.gate = MotionRequestGate(policy, self.platform, self.authority, self.now)
        self.channel = RobotChannel(
            name="c1",
            writer=self.writer,
            offset=self.offset,
            platform=self.platform,
            motion=self.motion,
            clock=self.clock,
            frame_limit=2**24,
            gate=self.gate,
            inhibited=self.inhibited,
            wall=lambda: 777,
        )

    def now(self) -> int:
        return round(self.clock.seconds() * 1e9)

    def request(self, message: link.Message) -> Any:
        self.channel.handle(message)
        return self.writer.sent[-1] if self.writer.sent else None

    def frames(self) -> list[SampleFrame]:
        data = b"".join(piece for write in self.writer.writes for piece in write)
        return cast("list[SampleFrame]", FrameDecoder(2**25).feed(data))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 100)):
            self.clock.advance(0.01)

    def command(self, body: bytes, source: int = DRIVER) -> None:
        self.channel.publish(CommandFrame(5, self.now(), source, body))
