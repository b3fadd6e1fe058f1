"""The speeds in a motion command, read and written in place. Pure: bytes in, bytes out.

A type whose speeds stand somewhere known has a :class:`VelocityAccess` here. The offsets of CDR follow from the types'
definitions (``geometry_msgs/Twist``: six doubles; ``TwistStamped``: a header before them) and from the alignment of
doubles to 8 bytes behind the encapsulation (DDSI-RTPS 2.2, section 10).
"""

from __future__ import annotations

import math
import struct
from typing import Any, NamedTuple, Protocol

import msgspec

TWIST = "geometry_msgs/msg/Twist"
TWIST_STAMPED = "geometry_msgs/msg/TwistStamped"

Vector = tuple[float, float, float]

_HEAD = 4
"""Bytes of the encapsulation; what follows is aligned from behind it."""
_STAMP = 8
_SIZE = 48
_SIX = (struct.Struct(">6d"), struct.Struct("<6d"))
_LENGTH = (struct.Struct(">I"), struct.Struct("<I"))
_AXES = ("x", "y", "z")


class Velocity(NamedTuple):
    """What a command asks for: metres per second and radians per second, each along x, y and z."""

    linear: Vector
    angular: Vector

    @property
    def finite(self) -> bool:
        """Whether all of it are numbers that a robot could follow."""
        return all(map(math.isfinite, self.linear)) and all(map(math.isfinite, self.angular))

    @property
    def moves(self) -> bool:
        """Whether any of it is not zero."""
        return any(self.linear) or any(self.angular)

    def times(self, share: float) -> Velocity:
        """The same in all directions, at a share of the speed."""
        return Velocity(scaled(self.linear, share), scaled(self.angular, share))


STILL = Velocity((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def scaled(vector: Vector, share: float) -> Vector:
    """A vector of the same direction, at a share of the length."""
    x, y, z = vector
    return (x * share, y * share, z * share)


class VelocityAccess(Protocol):
    """How the speeds stand in commands of one type."""

    def read(self, body: bytes) -> Velocity | None:
        """The speeds of a command; ``None`` where it isn't written as it should be."""

    def write(self, body: bytes, velocity: Velocity) -> bytes:
        """The same command with other speeds; ``body`` is one that :meth:`read` understands."""


def form(type: str, encoding: str) -> VelocityAccess | None:
    """How commands of this type hold their speeds, ``None`` where that is not known.

    :param type: full name of the message type
    :param encoding: ``cdr`` or ``json``
    """
    return _FORMS.get((type, encoding))


class _Cdr:
    """Plain CDR of version 1, in either byte order.

    :param stamped: whether a header stands before the speeds
    """

    def __init__(self, stamped: bool) -> None:
        self._stamped = stamped

    def read(self, body: bytes) -> Velocity | None:
        start = self._start(body)
        if start is None:
            return None
        x, y, z, roll, pitch, yaw = _SIX[body[1]].unpack_from(body, start)
        return Velocity((x, y, z), (roll, pitch, yaw))

    def write(self, body: bytes, velocity: Velocity) -> bytes:
        start = self._start(body)
        if start is None:
            raise ValueError("the command does not hold its speeds where they should be")
        made = bytearray(body)
        _SIX[body[1]].pack_into(made, start, *velocity.linear, *velocity.angular)
        return bytes(made)

    def _start(self, body: bytes) -> int | None:
        """Where the first of the six doubles is. What is behind the last is no part of the message."""
        if len(body) < _HEAD + _SIZE or body[0] or body[1] > 1:
            return None
        start = _HEAD
        if self._stamped:
            (length,) = _LENGTH[body[1]].unpack_from(body, _HEAD + _STAMP)
            start += _STAMP + 4 + length
            start += (_HEAD - start) % 8
        return start if start + _SIZE == len(body) else None


class _Json:
    """An object of objects; a number that is left out is 0.

    :param stamped: whether the speeds are below ``twist``
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


_FORMS: dict[tuple[str, str], VelocityAccess] = {
    (TWIST, "cdr"): _Cdr(stamped=False),
    (TWIST_STAMPED, "cdr"): _Cdr(stamped=True),
    (TWIST, "json"): _Json(stamped=False),
    (TWIST_STAMPED, "json"): _Json(stamped=True),
}
