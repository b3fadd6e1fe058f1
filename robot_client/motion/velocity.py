"""Reads and writes the speeds in a motion command in place. Pure: bytes in, bytes out.

Each supported type has a :class:`VelocityAccess`. CDR offsets follow from the types' definitions
(``geometry_msgs/Twist``: six doubles; ``TwistStamped``: a header before them). Doubles are aligned to 8 bytes, counted
from the end of the encapsulation header (DDSI-RTPS 2.2, section 10).
"""

from __future__ import annotations

import math
import struct
from typing import Any, NamedTuple, Protocol

import msgspec

TWIST = "geometry_msgs/msg/Twist"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"

Vector = tuple[float, float, float]

_ENCAPSULATION = 4
"""Bytes of the encapsulation header; alignment counts from its end."""
_STAMP_SIZE = 8
_SPEEDS_SIZE = 48
_SIX_DOUBLES = (struct.Struct(">6d"), struct.Struct("<6d"))
_LENGTH = (struct.Struct(">I"), struct.Struct("<I"))
_AXES = ("x", "y", "z")


class Velocity(NamedTuple):
    """Commanded velocity: linear in metres per second, angular in radians per second, each along x, y and z."""

    linear: Vector
    angular: Vector

    @property
    def finite(self) -> bool:
        """Whether no component is infinite or NaN."""
        return all(map(math.isfinite, self.linear)) and all(map(math.isfinite, self.angular))

    @property
    def moves(self) -> bool:
        """Whether any component is not zero."""
        return any(self.linear) or any(self.angular)

    def times(self, share: float) -> Velocity:
        """Scale all components by ``share``."""
        return Velocity(scaled(self.linear, share), scaled(self.angular, share))


STILL = Velocity((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def scaled(vector: Vector, share: float) -> Vector:
    """Scale a vector by ``share``."""
    x, y, z = vector
    return (x * share, y * share, z * share)


class VelocityAccess(Protocol):
    """Access to the speeds in commands of one type and encoding."""

    def read(self, body: bytes) -> Velocity | None:
        """The speeds of a command; ``None``: it is malformed."""

    def write(self, body: bytes, velocity: Velocity) -> bytes:
        """The same command with other speeds; ``body`` must be readable by :meth:`read`."""


def velocity_access(type: str, encoding: str) -> VelocityAccess | None:
    """Access to the speeds of a type; ``None``: it is not supported.

    :param type: full name of the message type
    :param encoding: ``cdr`` or ``json``
    """
    return _ACCESS.get((type, encoding))


class _CdrAccess:
    """Plain CDR version 1, in either byte order.

    :param stamped: whether a ``std_msgs/Header`` precedes the speeds
    """

    def __init__(self, stamped: bool) -> None:
        self._stamped = stamped

    def read(self, body: bytes) -> Velocity | None:
        start = self._start(body)
        if start is None:
            return None
        x, y, z, roll, pitch, yaw = _SIX_DOUBLES[body[1]].unpack_from(body, start)
        return Velocity((x, y, z), (roll, pitch, yaw))

    def write(self, body: bytes, velocity: Velocity) -> bytes:
        start = self._start(body)
        if start is None:
            raise ValueError("the command does not hold its speeds where they should be")
        changed = bytearray(body)
        _SIX_DOUBLES[body[1]].pack_into(changed, start, *velocity.linear, *velocity.angular)
        return bytes(changed)

    def _start(self, body: bytes) -> int | None:
        """Offset of the first of the six doubles; ``None``: malformed, or bytes follow the last double."""
        if len(body) < _ENCAPSULATION + _SPEEDS_SIZE or body[0] or body[1] > 1:
            return None
        start = _ENCAPSULATION
        if self._stamped:
            (length,) = _LENGTH[body[1]].unpack_from(body, _ENCAPSULATION + _STAMP_SIZE)
            start += _STAMP_SIZE + 4 + length
            start += (_ENCAPSULATION - start) % 8
        return start if start + _SPEEDS_SIZE == len(body) else None


class _JsonAccess:
    """A JSON object of objects; a missing number is 0.

    :param stamped: whether the speeds are in the member ``twist``
    """

    def __init__(self, stamped: bool) -> None:
        self._stamped = stamped

    def read(self, body: bytes) -> Velocity | None:
        try:
            twist = self._twist(msgspec.json.decode(body))
            return Velocity(_vector(twist.get("linear", {})), _vector(twist.get("angular", {})))
        except (msgspec.DecodeError, AttributeError, TypeError, ValueError, OverflowError):
            return None

    def write(self, body: bytes, velocity: Velocity) -> bytes:
        message = msgspec.json.decode(body)
        twist = self._twist(message)
        twist["linear"] = dict(zip(_AXES, velocity.linear, strict=True))
        twist["angular"] = dict(zip(_AXES, velocity.angular, strict=True))
        return msgspec.json.encode(message)

    def _twist(self, message: Any) -> Any:
        return message.setdefault("twist", {}) if self._stamped else message


def _vector(value: Any) -> Vector:
    x, y, z = (_number(value.get(axis, 0.0)) for axis in _AXES)
    return (x, y, z)


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError("a speed is no number")
    return float(value)


_ACCESS: dict[tuple[str, str], VelocityAccess] = {
    (TWIST, "cdr"): _CdrAccess(stamped=False),
    (TWIST_STAMPED, "cdr"): _CdrAccess(stamped=True),
    (TWIST, "json"): _JsonAccess(stamped=False),
    (TWIST_STAMPED, "json"): _JsonAccess(stamped=True),
}
