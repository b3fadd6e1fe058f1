"""Cameras and the video link (SPEC 2.6): the robot's cameras, the settings of a stream, and its messages."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from relay_protocol import limits
from relay_protocol.link.common import Bye, Ping, Pong
from relay_protocol.link.fields import Label, Name, Reasoned, cut
from relay_protocol.message import Message

Side = Annotated[int, Meta(ge=0, le=limits.IMAGE_SIDE)]

FrameSide = Annotated[int, Meta(ge=1, le=limits.IMAGE_SIDE)]
Count = Annotated[int, Meta(ge=0, le=2**32 - 1)]
Rate = Annotated[float, Meta(ge=0, le=1e6)]

Codec = Literal["jpeg", "png", "h264"]


_COMPRESSED = "/compressed"
"""Suffix of a topic of compressed images (ROS package image_transport)."""


def raw_of(camera: str) -> str:
    """The topic of a camera's raw images, from either of its topics."""
    return camera.removesuffix(_COMPRESSED)


def compressed_of(camera: str) -> str:
    """The topic of a camera's compressed images, from either of its topics."""
    return raw_of(camera) + _COMPRESSED


class VideoSettings(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, order=True):
    """Settings of a stream. Viewers with equal settings share one stream.

    Transforms are applied in this order: crop, rotate, invert, scale, stamp.

    :param width: pixels; 0 keeps the proportions by ``height``, or the camera's own width
    :param height: pixels; like ``width``
    :param quality: of JPEG, 1 to 100; H.264 derives its own from it
    :param fps: highest frame rate, Hz; 0 for all frames
    :param crop: x, y, width, height in pixels of the camera; all 0 for the whole frame
    :param rotate: degrees, clockwise
    :param invert: turn by 180 degrees (as web_video_server does)
    :param stamp: draw the time into the frame
    :param codec: ``png`` is for single frames
    :param qos: of the subscription: ``""`` matches the publisher, else ``sensor_data`` or ``default``
    :param transport: ``raw``, ``compressed``, or ``""`` for the robot's choice
    """

    width: Side = 0
    height: Side = 0
    quality: Annotated[int, Meta(ge=1, le=100)] = 80
    fps: Annotated[float, Meta(ge=0, le=1000)] = 0.0
    crop: tuple[Side, Side, Side, Side] = (0, 0, 0, 0)
    rotate: Literal[0, 90, 180, 270] = 0
    invert: bool = False
    stamp: bool = False
    codec: Codec = "jpeg"
    qos: Literal["", "sensor_data", "default"] = ""
    transport: Literal["", "raw", "compressed"] = ""


class Camera(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A camera. Fields of the last frame keep their defaults until a frame has been received.

    :param name: of its topic; a camera without ROS has a name of the same form
    :param type: of the topic; ``""`` for a camera without ROS
    :param encoding: of the last frame: ``rgb8``, ``16UC1``, ``jpeg``, …
    :param width: of the last frame, pixels
    :param height: of the last frame, pixels
    :param fps: frames per second, measured recently
    :param seen: when the last frame was received, Unix time at the robot, seconds
    """

    name: Name
    type: Name = ""
    encoding: Label = ""
    width: Count = 0
    height: Count = 0
    fps: Rate = 0.0
    seen: Annotated[float, Meta(ge=0, le=1e11)] = 0.0


class Cameras(Message, frozen=True, kw_only=True):
    """Robot, control link: all its cameras; after ``welcome`` and after every change.

    :param streams: most streams at a time; 0 when unknown
    """

    cameras: Annotated[list[Camera], Meta(max_length=limits.CAMERAS)] = msgspec.field(default_factory=list)
    streams: Count = 0


class OpenVideo(Message, frozen=True, kw_only=True):
    """Relay, control link: dial, ``join`` with this ticket, and stream this camera there.

    :param stream: id of the stream; ``joined`` repeats it as ``channel``
    :param address: ``host:port`` to dial; empty for the address of the control link
    """

    stream: Label
    ticket: Label
    camera: Name
    settings: VideoSettings
    address: str = ""


class CloseVideo(Message, frozen=True, kw_only=True):
    """Relay, control link: this stream has no viewers any more."""

    stream: Label


class StreamStatus(Message, frozen=True, kw_only=True):
    """Robot, video link: what is sent from now on, which is less than requested when the uplink is slow.

    :param width: pixels
    :param height: pixels
    :param quality: of JPEG
    :param fps: target frame rate, Hz; 0 for all frames
    :param reduced: how far this is below the request: 0 as requested, 1 the lowest possible
    :param delay_ms: milliseconds from the frame's arrival at the daemon to the relay's ``frame_ack``
    :param encoding: of the camera's own frames
    :param source_fps: frame rate of the camera, Hz
    :param latched: the publisher keeps its latest frame for late subscribers, however old it is
    :param problem: why no frame has been sent for a while although the camera delivers; empty when all is well
    :param damaged: frames of the camera that could not be shown, since the link was opened
    """

    width: FrameSide
    height: FrameSide
    quality: Annotated[int, Meta(ge=0, le=100)]
    fps: Rate = 0.0
    reduced: Annotated[float, Meta(ge=0, le=1)] = 0.0
    delay_ms: Annotated[float, Meta(ge=0, le=1e9)] | None = None
    encoding: Label = ""
    source_fps: Rate = 0.0
    latched: bool = False
    problem: str = ""
    damaged: Annotated[int, Meta(ge=0)] = 0

    def __post_init__(self) -> None:
        cut(self, "problem")


class StreamRefused(Reasoned, frozen=True, kw_only=True):
    """Robot, video link: the stream is not possible, and the link ends.

    :param busy: the robot encodes as many streams as it can; an existing one may be shared
    """

    reason: str
    busy: bool = False


class FrameAck(Message, frozen=True, kw_only=True):
    """Relay, video link: this frame, or a part of it, has been received. The robot measures its uplink by it.

    :param received: bytes of a frame in parts received so far; ``None`` for the whole frame
    """

    number: int
    received: int | None = None


class RequestKeyFrame(Message, frozen=True, kw_only=True):
    """Relay, video link: send a key frame next, because a viewer joined a stream of H.264."""


RobotVideo = StreamStatus | StreamRefused | Ping | Pong | Bye
RelayVideo = FrameAck | RequestKeyFrame | Ping | Pong | Bye
