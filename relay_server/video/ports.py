"""The two ends of a stream, as the stream uses them: the robot's link, and those who watch."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from msgspec import structs

from relay_protocol import link
from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.video.frames import VideoFrameInfo

if TYPE_CHECKING:
    from relay_server.video.stream import CameraStream


NO_CAMERA = "there is no such camera, or you have no right to view it"
"""Which of both is nobody's business."""


class NoFrame(Unavailable):
    """All that is needed is there, but no picture came in time."""

    code = "nothing_came"


class EncoderUnavailable(Unavailable):
    """The robot can't make these pictures in the form of H.264; in another one it may."""

    code = "not_made"


class TooManyStreamStarts(Unavailable):
    """Somebody begins ever new streams; he may again after ``retry_after`` seconds."""

    code = "too_often"

    def __init__(self, robot: str, retry_after: float) -> None:
        super().__init__(
            f"you begin streams of robot {robot} faster than it can; try again in {int(retry_after) + 1} s"
        )
        self.retry_after = retry_after


def differing(wanted: link.VideoSettings, shown: link.VideoSettings) -> dict[str, Any]:
    """The parameters by which a form of a camera differs from the one that was asked for, as they are in it."""
    asked = structs.asdict(wanted)
    return {name: value for name, value in structs.asdict(shown).items() if value != asked[name]}


class StreamRequest(NamedTuple):
    """What a viewer came for.

    :param settings: the form he asked for, which is another one than he is shown while the robot is at its limit
    :param newest: whether he wants to see the newest picture of a slow camera until the next one comes
    :param first: whether he gets a place that becomes free before others do: a recording can't be made again. Pictures
        that come too late to be shown he takes as well
    """

    settings: link.VideoSettings
    newest: bool = False
    first: bool = False


class VideoPort(Protocol):
    """The robot's end of a stream."""

    def send(self, message: link.Message) -> None:
        """Queue a message that must not be lost."""

    def close(self, reason: str) -> None:
        """Say ``bye`` and end the connection."""


class ViewerPort(Protocol):
    """Somebody who watches. Nothing is told before :meth:`Videos.watch` has returned."""

    @property
    def user(self) -> int:
        """Whose it is: what one person may watch is bounded over all of his connections."""

    def picture(self, picture: VideoFrameInfo) -> None:
        """There is a new picture; the viewer keeps the newest until it can take it.

        One that leaves out a picture of H.264 says so by :meth:`CameraStream.start_anew`.
        """

    def playing(self, playing: link.Playing) -> None:
        """What the robot sends from now on."""

    def moved(self, stream: CameraStream) -> None:
        """From now on it is this stream that is watched, and left by ``detach``: the nearest one, because the robot is
        at its limit, or, when there is a place again, the one that was asked for.
        """

    def ended(self, error: SwitchboardError) -> None:
        """The stream can't be had, or no more. Called once; the viewer is detached already."""
