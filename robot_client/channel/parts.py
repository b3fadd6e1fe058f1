"""What the parts of a channel need of its link, and what they share."""

from __future__ import annotations

from collections.abc import Sized
from typing import Protocol

from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import Invalid, SwitchboardError
from robot_client.platforms.base import Platform

MAX_OPEN = 1000
"""Subscriptions, publications, calls, goals and offers of each kind on one channel."""

_AROUND = 2048
"""Room for everything in a message but its ``cdr``: names and id are at most 255 characters each."""


class ChannelWriter(Protocol):
    """What a channel needs of its link."""

    @property
    def room(self) -> int:
        """Bytes of sample frames that should be written now."""

    def say(self, message: link.Message) -> None:
        """Send a message; it is never dropped."""

    def write(self, frames: list[bytes]) -> None:
        """Send sample frames; may pause the uplink."""


class NotNow(SwitchboardError):
    """A request of the right form that this channel can't take."""


def check_room(table: Sized, what: str) -> None:
    """See that one more of a kind may be open.

    :param what: the kind, in the plural
    :raises NotNow: there are :data:`MAX_OPEN`
    """
    if len(table) >= MAX_OPEN:
        raise NotNow(f"this channel has {MAX_OPEN} {what} open; end some first")


def arguments(cdr: str | None, what: str) -> bytes:
    """The bytes of a request.

    :param what: what they are for, for the errors
    :raises SwitchboardError: there are none, or they are not base64
    """
    if cdr is None:
        raise NotNow(f"the arguments of {what} must come as CDR")
    return link.from_base64(cdr, "cdr")


class ChannelPart:
    """A part of a channel that takes CDR from the relay's messages to the platform, and back.

    :param frame_limit: largest frame the relay takes, bytes
    """

    def __init__(self, wire: ChannelWriter, platform: Platform, frame_limit: int) -> None:
        self._wire = wire
        self._platform = platform
        self._limit = frame_limit
        self._log = Logger("channel")

    def _to_cdr(self, body: bytes, what: str) -> str:
        """Bytes for the ``cdr`` of a message.

        :param what: what they are, for the error
        :raises Invalid: the message would be larger than the relay takes, which costs the whole link
        """
        if (len(body) + 2) // 3 * 4 + _AROUND > self._limit:
            raise Invalid(f"{what} has {len(body)} bytes, more than fit into one message to the relay")
        return link.to_base64(body)
