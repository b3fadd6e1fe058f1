"""Decoders for each kind of link and each end, and the one encoder."""

from __future__ import annotations

import msgspec

from relay_protocol import frames, jsontext
from relay_protocol.link.channel import RelayChannel, RobotChannel
from relay_protocol.link.control_link import RelayControl, RobotControl
from relay_protocol.link.files import RelayFiles, RobotFiles
from relay_protocol.link.handshake import HandshakeReply, HandshakeRequest
from relay_protocol.link.video import RelayVideo, RobotVideo
from relay_protocol.message import Message

handshake_request_decoder: msgspec.json.Decoder[HandshakeRequest] = msgspec.json.Decoder(HandshakeRequest)
handshake_reply_decoder: msgspec.json.Decoder[HandshakeReply] = msgspec.json.Decoder(HandshakeReply)
robot_control_decoder: msgspec.json.Decoder[RobotControl] = msgspec.json.Decoder(RobotControl)
relay_control_decoder: msgspec.json.Decoder[RelayControl] = msgspec.json.Decoder(RelayControl)
robot_channel_decoder: msgspec.json.Decoder[RobotChannel] = msgspec.json.Decoder(RobotChannel)
relay_channel_decoder: msgspec.json.Decoder[RelayChannel] = msgspec.json.Decoder(RelayChannel)
robot_video_decoder: msgspec.json.Decoder[RobotVideo] = msgspec.json.Decoder(RobotVideo)
relay_video_decoder: msgspec.json.Decoder[RelayVideo] = msgspec.json.Decoder(RelayVideo)

robot_files_decoder: msgspec.json.Decoder[RobotFiles] = msgspec.json.Decoder(RobotFiles)
relay_files_decoder: msgspec.json.Decoder[RelayFiles] = msgspec.json.Decoder(RelayFiles)


def frame(message: Message) -> bytes:
    """A message as a kind-0 frame."""
    return frames.encode_json(jsontext.encode(message))
