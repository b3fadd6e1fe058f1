"""A single picture: the first that comes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred

from relay_protocol import link
from relay_protocol.errors import SwitchboardError
from relay_server.video.frames import VideoFrameInfo


class Snapshot:
    """Waits for a picture; how long is for the stream to say.

    :param seconds: the monotonic clock pictures are dated by
    """

    def __init__(self, seconds: Callable[[], float]) -> None:
        self._seconds = seconds
        self.other: dict[str, Any] = {}
        """The parameters by which it differs from what was asked for."""
        self.done: Deferred[VideoFrameInfo] = Deferred()
        """The picture; fails when there is none."""

    def picture(self, picture: VideoFrameInfo) -> None:
        """The first one that is not old already is it."""
        if not self.done.called and self._seconds() <= picture.good_until:
            self.done.callback(picture)

    def playing(self, playing: link.Playing) -> None:
        """What it is like the picture says itself."""

    def instead(self, other: dict[str, Any]) -> None:
        """The head of the answer tells it."""
        self.other = other

    def ended(self, error: SwitchboardError) -> None:
        """There is none."""
        if not self.done.called:
            self.done.errback(error)
