"""Base of a channel's handlers: writes to the link, checks requests, encodes CDR."""

from __future__ import annotations

from collections.abc import Sized
from typing import Protocol

from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import Invalid, SwitchboardError
from robot_client.platforms.base import Platform

MAX_OPEN = 1000
"""Most subscriptions, publications, calls, goals and advertisements of each kind on one channel."""

_OVERHEAD = 2048
"""Bytes of a message besides its ``cdr``: names and id have at most 255 characters each."""


class ChannelWriter(Protocol):
    """The link of a channel, as its handlers see it."""

    @property
    def room(self) -> int:
        """Bytes of sample frames that may be written now."""

    def send(self, message: link.Message) -> None:
        """Send a message; messages are never dropped."""

    def write(self, frames: list[bytes]) -> None:
        """Send sample frames; may pause the sample queue."""


class RequestRejected(SwitchboardError):
    """A well-formed request that this channel can't carry out."""


def check_room(table: Sized, kind: str) -> None:
    """Check that one more of a kind may be open.

    :param kind: plural, for the error
    :raises RequestRejected: there are :data:`MAX_OPEN`
    """
    if len(table) >= MAX_OPEN:
        raise RequestRejected(
            f"this channel has {MAX_OPEN} open {kind}, the most there may be; end some first"
        )


def decode_cdr(cdr: str | None, what: str) -> bytes:
    """The bytes in the ``cdr`` of a message.

    :param what: name of what they are for, for the error
    :raises SwitchboardError: there is no ``cdr``, or it is not base64
    """
    if cdr is None:
        raise RequestRejected(f"the arguments of {what} must be CDR")
    return link.from_base64(cdr, "cdr")


class ChannelHandler:
    """A handler of one kind of messages on one channel.

    :param frame_limit: largest frame the relay accepts, bytes
    """

    def __init__(self, writer: ChannelWriter, platform: Platform, frame_limit: int) -> None:
        self._writer = writer
        self._platform = platform
        self._frame_limit = frame_limit
        self._log = Logger("channel")

    def _encode_cdr(self, body: bytes, what: str) -> str:
        """The ``cdr`` of a message.

        :param what: name of the bytes, for the error
        :raises Invalid: the message would exceed the relay's limit, which would close the link
        """
        if (len(body) + 2) // 3 * 4 + _OVERHEAD > self._frame_limit:
            raise Invalid(f"{what} has {len(body)} bytes, more than fit into one message to the relay")
        return link.to_base64(body)
