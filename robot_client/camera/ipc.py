"""Messages between the daemon and its camera process: one JSON object per line on two pipes."""

from __future__ import annotations

import msgspec

from relay_protocol.link import VideoSettings
from relay_protocol.message import lower_tag


class _IpcMessage(
    msgspec.Struct, tag_field="op", tag=lower_tag, omit_defaults=True, frozen=True, kw_only=True
):
    pass


class CameraSettings(_IpcMessage, frozen=True, kw_only=True):
    """First message of the daemon.

    :param address: ``host:port`` of the relay, used if a stream has none
    :param tls: whether the link to it is TLS
    :param ca: PEM file of the only trusted authorities, empty for the system's
    :param server_name: name in the relay's certificate, empty for the host
    :param node: name of the node that subscribes to cameras
    :param streams: most streams at a time
    :param target: longest delay that rate control aims for, seconds
    """

    address: str
    tls: bool = False
    ca: str = ""
    server_name: str = ""
    node: str
    streams: int
    target: float = 0.3


class OpenStream(_IpcMessage, frozen=True, kw_only=True):
    """Dial, join with this ticket, and stream this camera.

    :param stream: name of the stream
    :param camera: the relay's name for the camera
    :param topic: to subscribe to; empty for a camera without ROS
    :param compressed: whether its messages are ``CompressedImage``
    :param source: of a camera without ROS, if there is no topic; without both there is no such camera
    :param address: ``host:port`` to dial; empty for the address of the control link
    :param heartbeat: seconds, as agreed on the control link
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
    """End a stream.

    :param reason: for the relay
    """

    stream: str
    reason: str


class InhibitTopics(_IpcMessage, frozen=True, kw_only=True):
    """All topics that are inhibited now."""

    topics: list[str]


class CameraAlive(_IpcMessage, frozen=True, kw_only=True):
    """The process is alive; sent every second."""


class StreamAccepted(_IpcMessage, frozen=True, kw_only=True):
    """The process has received :class:`OpenStream`."""

    stream: str


class CameraSeen(_IpcMessage, frozen=True, kw_only=True):
    """Format and rate of a camera.

    :param encoding: of the last frame
    :param width: of the last frame, pixels
    :param height: of the last frame, pixels
    :param fps: recent frames per second; 0 if unknown
    :param at: arrival of the last frame, Unix time
    """

    camera: str
    encoding: str
    width: int
    height: int
    fps: float
    at: float


class StreamEnded(_IpcMessage, frozen=True, kw_only=True):
    """A stream has ended."""

    stream: str
    reason: str


class LogLine(_IpcMessage, frozen=True, kw_only=True):
    """A line for the daemon's log.

    :param level: ``info``, ``warn``, ``error``
    """

    level: str
    text: str


DaemonMessage = CameraSettings | OpenStream | CloseStream | InhibitTopics
CameraMessage = CameraAlive | StreamAccepted | CameraSeen | StreamEnded | LogLine

daemon_decoder: msgspec.json.Decoder[DaemonMessage] = msgspec.json.Decoder(DaemonMessage)
camera_decoder: msgspec.json.Decoder[CameraMessage] = msgspec.json.Decoder(CameraMessage)
_encoder = msgspec.json.Encoder()


def encode(message: DaemonMessage | CameraMessage) -> bytes:
    """A message as a line with its end."""
    return _encoder.encode(message) + b"\n"
