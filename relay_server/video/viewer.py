"""One viewer of one camera, from the desk that let him in until he leaves; and cameras as one may see them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Protocol

import msgspec

from relay_protocol import link
from relay_protocol.errors import NotFound, Refused, SwitchboardError
from relay_protocol.rights import Operation
from relay_server.access import Permit
from relay_server.robots.registry import RobotState
from relay_server.video.frames import VideoFrameInfo
from relay_server.video.ports import NO_CAMERA, differing
from relay_server.video.stream import CameraStream
from relay_server.video.streams import CameraStreams


class FrameSink(Protocol):
    """What a viewer looks at: an answer over HTTP, a websocket."""

    def picture(self, picture: VideoFrameInfo) -> None:
        """There is a new picture."""

    def playing(self, playing: link.Playing) -> None:
        """What the robot sends from now on."""

    def instead(self, other: dict[str, Any]) -> None:
        """What is shown from now on is not what was asked for but another form of the camera, because the robot is at
        its limit. Told before the first picture, if it is so then, and whenever it changes.

        :param other: the parameters by which it differs, as they are in it; none: it is what was asked for
        """

    def ended(self, error: SwitchboardError) -> None:
        """There is nothing to see, or no more. Called once, and not after :meth:`CameraViewer.leave`."""


def check_view(permit: Permit, camera: str, transport: str = "") -> None:
    """Whether this may be seen.

    :param transport: as in :class:`~relay_protocol.link.video.VideoSettings`; with it the robot may show another topic
    :raises NotFound: no right to; said like that there is no such camera
    """
    if not _may_view(permit, camera, transport):
        raise NotFound(NO_CAMERA)


def _may_view(permit: Permit, camera: str, transport: str) -> bool:
    shown = {"compressed": link.compressed_of, "raw": link.raw_of}.get(transport, str)(camera)
    return all(permit.judge(Operation.VIEW, each).allowed for each in {camera, shown})


class CameraViewer:
    """A viewer, as a stream has him. His right is judged again whenever rights change.

    :param permit: kept till the end, then given to ``over`` with all the rest
    :param over: called once, when nothing is watched any more
    :param snapshot: for one picture
    """

    def __init__(
        self,
        permit: Permit,
        robot: RobotState,
        camera: str,
        settings: link.VideoSettings,
        screen: FrameSink,
        *,
        address: str,
        over: Callable[[CameraViewer], None],
        snapshot: bool = False,
    ) -> None:
        self.permit = permit
        self.robot = robot
        self.camera = camera
        self.settings = settings
        self.address = address
        self.snapshot = snapshot
        self.pictures = 0
        """How many there were for this viewer."""
        self._screen = screen
        self._over = over
        self._stream: CameraStream | None = None
        permit.on_change = self._rights_changed
        permit.on_revoke = self.end

    @property
    def user(self) -> int:
        """Whose it is."""
        return self.permit.principal.user_id

    @property
    def name(self) -> str:
        """What the user is called at this robot."""
        return self.robot.name_of(self.permit.principal.name, self.permit.principal.realm)

    @property
    def about(self) -> dict[str, Any]:
        """What is told of it in the journal."""
        return {"camera": self.camera, **({"snapshot": True} if self.snapshot else {})}

    def begin(self, videos: CameraStreams) -> None:
        """Watch.

        :raises NotFound: without the right to
        :raises Unavailable: too many do
        """
        check_view(self.permit, self.camera, self.settings.transport)
        stream = videos.watch(self.robot, self.camera, self.settings, self, newest=True)
        self._stream = stream
        if stream.settings != self.settings:
            self._screen.instead(differing(self.settings, stream.settings))

    def start_anew(self) -> None:
        """A picture of H.264 was left out: show nothing before the next one that stands alone."""
        if self._stream is not None:
            self._stream.start_anew(self)

    def leave(self) -> None:
        """The viewer wants no more; a second time does nothing."""
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.detach(self)
            self._over(self)

    def end(self, error: SwitchboardError) -> None:
        """There is no more for him to see, and he is told why."""
        if self._stream is not None:
            self.leave()
            self._screen.ended(error)

    # --- Viewer -------------------------------------------------------------------------------------------

    def picture(self, picture: VideoFrameInfo) -> None:
        """From the stream."""
        self.pictures += 1
        self._screen.picture(picture)

    def playing(self, playing: link.Playing) -> None:
        """From the stream."""
        self._screen.playing(playing)

    def moved(self, stream: CameraStream) -> None:
        """To another stream."""
        self._stream = stream
        self._screen.instead(differing(self.settings, stream.settings))

    def ended(self, error: SwitchboardError) -> None:
        """Detached by the stream."""
        self.end(error)

    # --- rights -------------------------------------------------------------------------------------------

    def _rights_changed(self) -> None:
        if not _may_view(self.permit, self.camera, self.settings.transport):
            self.end(Refused(f"your right to view {self.camera} was revoked"))


def view(camera: link.Camera, streams: Iterable[CameraStream]) -> dict[str, Any]:
    """A camera as users see it (SPEC section 1.8)."""
    return {
        "name": camera.name,
        "type": camera.type,
        "encoding": camera.encoding or None,
        "width": camera.width or None,
        "height": camera.height or None,
        "fps": camera.fps or None,
        "seen": camera.seen or None,
        "streams": [_shown(stream) for stream in streams if stream.camera == camera.name],
    }


def _shown(stream: CameraStream) -> dict[str, Any]:
    playing = stream.told or stream.failed
    return {
        "viewers": len(stream.viewers),
        "state": stream.state.name.lower(),
        "settings": msgspec.structs.asdict(stream.settings),
        "playing": None if playing is None else msgspec.structs.asdict(playing),
    }
