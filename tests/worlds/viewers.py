"""Viewers in memory, images for them, and a robot's side of a stream."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from relay_protocol.frames import VideoFrame
from relay_server.video.frames import VideoFrameInfo
from relay_server.video.stream import CameraStream
from tests.worlds.relay import MemoryLink, World

CAMERA = "/camera/image"
OTHER = "/rear/image"

SPS, PPS, IDR, SLICE = b"\x67\x42\xc0\x1e", b"\x68\xce\x3c\x80", b"\x65\x88\x84\x21", b"\x41\x9a\x21\x6c"
"""Units of H.264, as far as anybody looks."""


def units(*contents: bytes) -> bytes:
    """Units of H.264 with their start codes."""
    return b"".join(b"\x00\x00\x00\x01" + content for content in contents)


KEY = units(SPS, PPS, IDR)
DELTA = units(SLICE)


@cache
def jpeg(width: int = 32, height: int = 24) -> bytes:
    """A black image."""
    return cv2.imencode(".jpg", np.zeros((height, width, 3), np.uint8))[1].tobytes()


@cache
def png(width: int = 32, height: int = 24) -> bytes:
    """A black image."""
    return cv2.imencode(".png", np.zeros((height, width, 3), np.uint8))[1].tobytes()


class Watcher:
    """A viewer that stores its frames and statuses."""

    def __init__(self, user: int = 7) -> None:
        self.user = user
        self.pictures: list[VideoFrameInfo] = []
        self.played: list[link.StreamStatus] = []
        self.stream: CameraStream | None = None
        self.error: SwitchboardError | None = None

    def watch(
        self, world: World, settings: link.VideoSettings | None = None, camera: str = CAMERA
    ) -> CameraStream:
        """Joins; no callback comes before that is done."""
        stream = world.videos.watch(world.robot, camera, settings or link.VideoSettings(), self)
        assert not self.pictures and not self.played and self.error is None and self.stream is None
        self.stream = stream
        return stream

    def leave(self) -> None:
        assert self.stream is not None
        self.stream.detach(self)

    @property
    def numbers(self) -> list[int]:
        """Numbers of the received frames."""
        return [picture.number for picture in self.pictures]

    def frame_received(self, picture: VideoFrameInfo) -> None:
        """Stores it."""
        assert self.error is None, "a picture after the end"
        self.pictures.append(picture)

    def status_changed(self, playing: link.StreamStatus) -> None:
        """Stores it."""
        assert self.error is None, "told after the end"
        self.played.append(playing)

    def moved(self, stream: CameraStream) -> None:
        """Switches to another stream."""
        assert self.stream is not None
        assert self not in self.stream.viewers
        assert self in stream.viewers
        self.stream = stream

    def ended(self, error: SwitchboardError) -> None:
        """Stores the end."""
        assert self.error is None, "ended twice"
        assert self.stream is not None
        assert self not in self.stream.viewers, "not detached"
        self.error = error


def robot_comes(world: World, *cameras: str, streams: int = 0) -> None:
    """The robot registers and reports its cameras, and its limit of streams."""
    world.control = MemoryLink()
    world.registry.registered(world.robot, world.control)
    has = [link.Camera(name=name, width=640, height=480) for name in cameras or (CAMERA, OTHER)]
    world.registry.cameras(world.robot, link.Cameras(cameras=has, streams=streams))


def asked(world: World) -> list[link.OpenVideo]:
    """Streams requested from the robot since the last call."""
    world.clock.advance(0)
    return world.control.take(link.OpenVideo)


def robot_joins(world: World) -> MemoryLink:
    """The robot connects with the latest ticket."""
    stream = world.videos.redeem(asked(world)[-1].ticket)
    assert stream is not None
    end = MemoryLink()
    stream.joined(end)
    return end


def shows(
    world: World, stream: CameraStream, number: int = 1, body: bytes | None = None, late: float = 0.0
) -> None:
    """The robot sends a frame.

    :param late: its additional delay in seconds
    """
    stamp = round((world.clock.seconds() + 1.7e9 - late) * 1e9)
    stream.frame_received(VideoFrame(number, stamp, jpeg() if body is None else body))
