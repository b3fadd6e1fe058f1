"""The messages of the links between robot and relay, by the decoders of ``relay_protocol.link``."""

from __future__ import annotations

from typing import get_args

from relay_protocol import link

LINKS = [
    "handshake_request",
    "handshake_reply",
    "robot_control",
    "relay_control",
    "robot_channel",
    "relay_channel",
    "robot_video",
    "relay_video",
    "robot_files",
    "relay_files",
]
"""One end of a link each; its messages are decoded by ``link.NAME_decoder``."""

KEEPALIVE = {"ping", "pong", "bye"}
"""Messages of every link."""


def ops_of(name: str) -> set[str]:
    """The ``op`` of each message of one end."""
    return {each.__struct_config__.tag for each in get_args(getattr(link, f"{name}_decoder").type)}
