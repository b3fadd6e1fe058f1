"""The message and service types of MQTT devices, and their CDR, without ROS."""

from __future__ import annotations

import struct
from typing import Any

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound
from relay_protocol.ros.well_known import TEXTS

BOOL = "std_msgs/msg/Bool"
NUMBER = "std_msgs/msg/Float64"
TEXT = "std_msgs/msg/String"
TRIGGER = "std_srvs/srv/Trigger"
SET_BOOL = "std_srvs/srv/SetBool"

TYPES = (BOOL, NUMBER, TEXT, SET_BOOL, TRIGGER)

_HEADER = b"\0\1\0\0"
"""Little endian CDR, as in RTPS 10.2.1.2."""


def encode(type: str, value: Any) -> bytes:
    """A message whose ``data`` is this value.

    :param type: :data:`BOOL`, :data:`NUMBER` or :data:`TEXT`
    """
    if type == BOOL:
        return _HEADER + bytes([bool(value)])
    if type == NUMBER:
        return _HEADER + struct.pack("<d", value)
    # A text in CDR ends at its zero byte.
    return _HEADER + _text(str(value).replace("\0", ""))


def decode(type: str, body: bytes) -> Any:
    """The ``data`` of a message, or of a request of type :data:`SET_BOOL`; ``None`` for :data:`TRIGGER`.

    :raises Invalid: the bytes are no such message
    """
    if type == TRIGGER:
        return None
    try:
        order = {0: ">", 1: "<"}[body[1]] if body[:1] == b"\0" else None
        if order is None:
            raise ValueError
        if type in (BOOL, SET_BOOL):
            return {0: False, 1: True}[body[4]]
        if type == NUMBER:
            return struct.unpack_from(order + "d", body, 4)[0]
        (length,) = struct.unpack_from(order + "I", body, 4)
        if length == 0 or len(body) < 8 + length or body[7 + length] != 0:
            raise ValueError
        return body[8 : 7 + length].decode()
    except (IndexError, KeyError, ValueError, struct.error):
        raise Invalid(f"the bytes are no {type}") from None


def response(success: bool, message: str) -> bytes:
    """A response of :data:`TRIGGER` or :data:`SET_BOOL`."""
    return _HEADER + bytes([success]) + b"\0\0\0" + _text(message)


def definition(type: str) -> link.TypeDefinition:
    """The text of a type.

    :raises NotFound: devices do not use it
    """
    if type not in TYPES:
        raise NotFound(f"the type {type} is not used by MQTT devices; there are {', '.join(TYPES)}")
    return link.TypeDefinition(type=type, text=TEXTS[type], hash="")


def _text(text: str) -> bytes:
    data = text.encode("utf-8", "replace") + b"\0"
    return struct.pack("<I", len(data)) + data
