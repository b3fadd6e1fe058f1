"""How messages are read, link by link and end by end, and written."""

from __future__ import annotations

import msgspec

from relay_protocol import frames, jsontext
from relay_protocol.link.answers import RobotChannel
from relay_protocol.link.control import RelayControl, RobotControl
from relay_protocol.link.handshake import Opening, OpeningReply
from relay_protocol.link.requests import RelayChannel
from relay_protocol.link.video import RelayVideo, RobotVideo
from relay_protocol.message import Message

opening_decoder: msgspec.json.Decoder[Opening] = msgspec.json.Decoder(Opening)
opening_reply_decoder: msgspec.json.Decoder[OpeningReply] = msgspec.json.Decoder(OpeningReply)
robot_control_decoder: msgspec.json.Decoder[RobotControl] = msgspec.json.Decoder(RobotControl)
relay_control_decoder: msgspec.json.Decoder[RelayControl] = msgspec.json.Decoder(RelayControl)
robot_channel_decoder: msgspec.json.Decoder[RobotChannel] = msgspec.json.Decoder(RobotChannel)
relay_channel_decoder: msgspec.json.Decoder[RelayChannel] = msgspec.json.Decoder(RelayChannel)
robot_video_decoder: msgspec.json.Decoder[RobotVideo] = msgspec.json.Decoder(RobotVideo)
relay_video_decoder: msgspec.json.Decoder[RelayVideo] = msgspec.json.Decoder(RelayVideo)


def frame(message: Message) -> bytes:
    """A message as a kind-0 frame, ready for the wire."""
    return frames.encode_json(jsontext.encode(message))
