"""Pictures as ``sensor_msgs/msg/CompressedImage``, which every viewer of recordings shows."""

from __future__ import annotations

import struct

TYPE = "sensor_msgs/msg/CompressedImage"

_RULE = "=" * 80

TEXT = f"""\
std_msgs/Header header
string format
uint8[] data
{_RULE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_RULE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""

_HEAD = b"\x00\x01\x00\x00"
_SUFFIX = "/compressed"


def topic_of(camera: str) -> str:
    """The topic of a camera's pictures; image_transport's name for them."""
    return camera if camera.endswith(_SUFFIX) else camera + _SUFFIX


def message(picture: bytes, stamp: int, codec: str) -> bytes:
    """A picture as a message in CDR.

    :param picture: the bytes of a file
    :param stamp: when it was taken, nanoseconds since 1970
    :param codec: ``jpeg`` or ``png``
    """
    out = bytearray(_HEAD)
    out += struct.pack("<iI", *divmod(stamp, 10**9))
    # The frame is not known here: pictures come without the message they were in.
    for text in ("", codec):
        body = text.encode() + b"\x00"
        out += struct.pack("<I", len(body)) + body
        # Four-byte numbers begin at multiples of four, counted from behind the head, which has four bytes too.
        out += bytes(-len(out) % 4)
    return bytes(out + struct.pack("<I", len(picture)) + picture)
