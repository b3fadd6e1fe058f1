"""Cameras and the video link: what a robot can show, how the relay wants it, what goes over a link of its own."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from relay_protocol import limits
from relay_protocol.link.common import Bye, Ping, Pong
from relay_protocol.link.fields import Label, Name, Reasoned, cut
from relay_protocol.message import Message

Side = Annotated[int, Meta(ge=0, le=limits.PICTURE_SIDE)]

Shown = Annotated[int, Meta(ge=1, le=limits.PICTURE_SIDE)]
Count = Annotated[int, Meta(ge=0, le=2**32 - 1)]
Rate = Annotated[float, Meta(ge=0, le=1e6)]

Codec = Literal["jpeg", "png", "h264"]


_COMPRESSED = "/compressed"
"""What image_transport adds to the name of a topic for its compressed pictures."""


def raw_of(camera: str) -> str:
    """The topic of a camera's raw pictures, by that or by the one of its compressed pictures."""
    return camera.removesuffix(_COMPRESSED)


def compressed_of(camera: str) -> str:
    """The topic of a camera's compressed pictures, by that or by the one of its raw pictures."""
    return raw_of(camera) + _COMPRESSED


class VideoSettings(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, order=True):
    """How a picture is wanted. Two viewers who want the same share one stream.

    The edits are done in this order: crop, rotate, invert, scale, stamp.

    :param width: pixels; 0 follows from ``height`` and the picture's own proportions, or is the picture's own
    :param height: pixels; like ``width``
    :param quality: of JPEG, 1 to 100; H.264 derives its own from it
    :param fps: most pictures per second; 0 for all there are
    :param crop: x, y, width, height of the part to show, in pixels of the camera; all 0 for the whole
    :param rotate: clockwise, degrees
    :param invert: turned by 180 degrees (as web_video_server has it)
    :param stamp: time burned in
    :param codec: ``png`` is for single pictures
    :param qos: profile of the subscription: ``""`` matches the publisher, else ``sensor_data`` or ``default``
    :param transport: ``raw``, ``compressed``, or ``""`` for what the robot thinks best
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
    """Something that gives pictures. What is known only once it was looked at stays at its default till then.

    :param name: of its topic; a camera without ROS has a name of the same form
    :param type: of the topic; ``""`` for a camera without ROS
    :param encoding: of the last picture: ``rgb8``, ``16UC1``, ``jpeg``, …
    :param width: of the last picture, pixels
    :param height: of the last picture, pixels
    :param fps: pictures per second, as they came of late
    :param seen: when they were like this, Unix time at the robot: its last picture by the time this was told
    """

    name: Name
    type: Name = ""
    encoding: Label = ""
    width: Count = 0
    height: Count = 0
    fps: Rate = 0.0
    seen: Annotated[float, Meta(ge=0, le=1e11)] = 0.0


class Cameras(Message, frozen=True, kw_only=True):
    """Robot, control link: all cameras I have; after ``welcome`` and whenever they change.

    :param streams: most I show at a time; 0 when I don't know
    """

    cameras: Annotated[list[Camera], Meta(max_length=limits.CAMERAS)] = msgspec.field(default_factory=list)
    streams: Count = 0


class OpenVideo(Message, frozen=True, kw_only=True):
    """Relay, control link: dial, ``join`` with this ticket, and show this camera there.

    :param stream: name of the stream, which ``joined`` says again as ``channel``
    :param address: ``host:port`` to dial; empty for the address of the control link
    """

    stream: Label
    ticket: Label
    camera: Name
    settings: VideoSettings
    address: str = ""


class CloseVideo(Message, frozen=True, kw_only=True):
    """Relay, control link: nobody watches this stream any more."""

    stream: Label


class Playing(Message, frozen=True, kw_only=True):
    """Robot, video link: what I send from now on, which is less than was asked for where the uplink is thin.

    :param width: pixels
    :param height: pixels
    :param quality: of JPEG
    :param fps: pictures per second aimed at; 0 for all there are
    :param reduced: how far it is below what was asked for: 0 as asked, 1 the least there is
    :param delay_ms: from the picture's arrival at the robot's daemon to the relay's word that it is there
    :param encoding: of the camera's own pictures
    :param source_fps: pictures per second the camera gives
    :param latched: its publisher keeps the latest picture for those who come later, however old it is
    :param trouble: why no picture has come for a while though the camera gives some, in words; empty while all is well
    """

    width: Shown
    height: Shown
    quality: Annotated[int, Meta(ge=0, le=100)]
    fps: Rate = 0.0
    reduced: Annotated[float, Meta(ge=0, le=1)] = 0.0
    delay_ms: Annotated[float, Meta(ge=0, le=1e9)] | None = None
    encoding: Label = ""
    source_fps: Rate = 0.0
    latched: bool = False
    trouble: str = ""

    def __post_init__(self) -> None:
        """Words are cut."""
        cut(self, "trouble")


class NotPlaying(Reasoned, frozen=True, kw_only=True):
    """Robot, video link: this can't be shown, and the link ends.

    :param busy: the robot encodes as many streams as it can; one that is there already can be shared
    """

    reason: str
    busy: bool = False


class Took(Message, frozen=True, kw_only=True):
    """Relay, video link: the picture of this number is here, or a part. The robot measures its uplink by it.

    :param upto: bytes of a picture in parts that are here; ``None`` when all of it is
    """

    number: int
    upto: int | None = None


class KeyFrame(Message, frozen=True, kw_only=True):
    """Relay, video link: somebody joined a stream of H.264; begin anew with a key frame."""


RobotVideo = Playing | NotPlaying | Ping | Pong | Bye
RelayVideo = Took | KeyFrame | Ping | Pong | Bye
