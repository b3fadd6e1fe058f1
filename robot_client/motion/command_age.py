"""How old a command can be, and when it no longer counts. Pure: stamps and times in, ages out.

SPEC 2.5, "Clocks and deadline".
"""

from __future__ import annotations

import enum

from robot_client.link.clock_offset import ClockOffset

MILLI = 1_000_000
"""Nanoseconds of a millisecond."""

EXPIRY_SHARE = 0.9
"""Share of the deadline after which a published command no longer counts."""

LINK_PROOF_EVERY = 0.1
"""Seconds between pings that prove that the link works both ways, while a client may command the robot."""


class CommandAge(enum.Enum):
    """Classification of a command by its age; ``AHEAD``: its stamp is in the future."""

    FRESH = "fresh"
    STALE = "stale"
    AHEAD = "ahead"


def freshness(stamp: int, now: int, offset: ClockOffset, deadline_ms: int) -> CommandAge:
    """Classify a command by the greatest age it can have.

    :param stamp: the relay's monotonic clock, nanoseconds, see :class:`relay_protocol.frames.CommandFrame`
    :param now: own monotonic clock, nanoseconds
    """
    oldest = offset.max_age(stamp, now)
    if oldest is None or oldest > deadline_ms * MILLI:
        return CommandAge.STALE
    return CommandAge.AHEAD if oldest < 0 else CommandAge.FRESH


def earliest_sent_of(stamp: int, now: int, offset: ClockOffset) -> int:
    """The earliest time a command can have been sent, own clock, nanoseconds; at most ``now``.

    :param stamp: as of :func:`freshness`, like ``now``
    :return: 0 while its age is unknown
    """
    oldest = offset.max_age(stamp, now)
    return 0 if oldest is None else now - max(oldest, 0)


def expires_at(
    stamp: int, now: int, offset: ClockOffset, link_proven_at: int, deadline_ms: int, within_ms: int
) -> int:
    """When a command no longer counts, nanoseconds: by its age, or because the link is not proved to work both ways.

    A client that receives nothing from the robot any more must not keep it moving.

    :param stamp: as of :func:`freshness`, which has found the command fresh
    :param link_proven_at: when the latest ping that the relay has answered was sent
    :param within_ms: time to stop
    """
    age = offset.max_age(stamp, now) or 0
    by_age = now - age + int(deadline_ms * EXPIRY_SHARE * MILLI)
    return min(by_age, link_proven_at + int(max(deadline_ms, within_ms) * EXPIRY_SHARE * MILLI))
