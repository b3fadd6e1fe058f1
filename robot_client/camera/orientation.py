"""What a JPEG says of how it should be turned (Exif 2.32, section 4.6.5.1: tag 274), which browsers obey.

A picture that is made anew says nothing of it, so one that goes out as it came must not either: else it would turn
whenever the uplink becomes thin. How the camera hangs is for who watches to ask for (``rotate``).
"""

from __future__ import annotations

import struct

_EXIF = b"Exif\0\0"
_APP1, _SOS = 0xE1, 0xDA
_ORIENTATION = 0x0112
_UPRIGHT = 1

_MOST_SEGMENTS = 64
"""Before the picture; an Exif segment is among the first."""


def without_orientation(file: bytes) -> bytes:
    """The same JPEG, less the Exif segments that would have it turned; mostly the very same. No pixel is touched.

    :param file: a whole JPEG
    """
    at, found = 2, []
    for _ in range(_MOST_SEGMENTS):
        if file[at : at + 1] != b"\xff" or at + 4 > len(file) or file[at + 1] == _SOS:
            break
        end = at + 2 + int.from_bytes(file[at + 2 : at + 4], "big")
        if file[at + 1] == _APP1 and _turns(file[at + 4 : end]):
            found.append((at, end))
        at = end
    for start, end in reversed(found):
        file = file[:start] + file[end:]
    return file


def _turns(segment: bytes) -> bool:
    """Whether an APP1 segment is Exif that tells another orientation than that of the pixels."""
    if not segment.startswith(_EXIF):
        return False
    tiff = segment[len(_EXIF) :]
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return False
    try:
        (first,) = struct.unpack_from(order + "I", tiff, 4)
        (count,) = struct.unpack_from(order + "H", tiff, first)
        for entry in range(count):
            tag, _, _, value = struct.unpack_from(order + "HHIH", tiff, first + 2 + 12 * entry)
            if tag == _ORIENTATION:
                return bool(value != _UPRIGHT)
    except struct.error:
        pass
    return False
