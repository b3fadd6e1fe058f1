"""What the daemon and its camera process tell each other: one JSON object per line on two pipes."""

from __future__ import annotations

import msgspec

from relay_protocol.link import VideoSettings
from relay_protocol.message import lower_tag


class _IpcMessage(
    msgspec.Struct, tag_field="line", tag=lower_tag, omit_defaults=True, frozen=True, kw_only=True
):
    pass


class CameraSettings(_IpcMessage, frozen=True, kw_only=True):
    """The daemon's first word.

    :param address: ``host:port`` of the relay, where ``open`` says none
    :param tls: whether the link to it is TLS
    :param ca: PEM file of the only authorities trusted, empty for the system's
    :param server_name: name the certificate must bear, empty for the host
    :param node: name of the node that subscribes to cameras
    :param streams: most of them at a time
    :param target: delay to stay under, seconds
    """

    address: str
    tls: bool = False
    ca: str = ""
    server_name: str = ""
    node: str
    streams: int
    target: float = 0.3


class OpenStream(_IpcMessage, frozen=True, kw_only=True):
    """Dial, join with this ticket, and show this camera there.

    :param stream: name of the stream
    :param camera: as the relay calls it
    :param topic: to subscribe to; empty for a camera without ROS
    :param compressed: whether its messages are ``CompressedImage``
    :param source: of a camera without ROS, where there is no topic; with neither there is no such camera
    :param address: ``host:port`` to dial; empty for the address of the control link
    :param heartbeat: seconds, as the control link agreed
    """

    stream: str
    ticket: str
    camera: str
    settings: VideoSettings
    topic: str = ""
    compressed: bool = False
    source: str = ""
    address: str = ""
    heartbeat: float


class CloseStream(_IpcMessage, frozen=True, kw_only=True):
    """Nobody watches this stream any more.

    :param why: for the relay
    """

    stream: str
    why: str


class NoFrames(_IpcMessage, frozen=True, kw_only=True):
    """Topics that say nothing from now on, all there are; others do again."""

    topics: list[str]


class CameraAlive(_IpcMessage, frozen=True, kw_only=True):
    """The process lives; said every second."""


class StreamAccepted(_IpcMessage, frozen=True, kw_only=True):
    """The process has read that it is to open this stream."""

    stream: str


class CameraSeen(_IpcMessage, frozen=True, kw_only=True):
    """What a camera's pictures are like.

    :param encoding: of the last picture
    :param width: of the last picture, pixels
    :param height: of the last picture, pixels
    :param fps: pictures per second, as they came of late; 0 before that can be told
    :param at: when the last picture came, Unix time
    """

    camera: str
    encoding: str
    width: int
    height: int
    fps: float
    at: float


class StreamEnded(_IpcMessage, frozen=True, kw_only=True):
    """A stream is no more."""

    stream: str
    why: str


class LogLine(_IpcMessage, frozen=True, kw_only=True):
    """Something for the daemon's log.

    :param level: ``info``, ``warn``, ``error``
    """

    level: str
    text: str


Line = CameraSettings | OpenStream | CloseStream | NoFrames
Answer = CameraAlive | StreamAccepted | CameraSeen | StreamEnded | LogLine

decoder: msgspec.json.Decoder[Line] = msgspec.json.Decoder(Line)
answer_decoder: msgspec.json.Decoder[Answer] = msgspec.json.Decoder(Answer)
_encoder = msgspec.json.Encoder()


def encode(line: Line | Answer) -> bytes:
    """A line with its end."""
    return _encoder.encode(line) + b"\n"
