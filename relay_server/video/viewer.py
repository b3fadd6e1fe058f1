"""Viewers of cameras: their rights, their snapshots, and the facts about cameras that they may see."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Protocol

import msgspec
from twisted.internet.defer import Deferred

from relay_protocol import link
from relay_protocol.errors import NotFound, Refused, SwitchboardError
from relay_protocol.rights import Operation
from relay_server.access import Permit
from relay_server.robots.registry import RobotState
from relay_server.video.errors import NO_CAMERA
from relay_server.video.frames import VideoFrameInfo
from relay_server.video.stream import CameraStream, differing
from relay_server.video.streams import CameraStreams


class FrameSink(Protocol):
    """Where a viewer's frames go: an HTTP response, a websocket."""

    def frame_received(self, frame: VideoFrameInfo) -> None:
        """A new frame."""

    def status_changed(self, playing: link.StreamStatus) -> None:
        """The status of the stream, which holds from the next frame on."""

    def settings_differ(self, other: dict[str, Any]) -> None:
        """The stream differs from the requested one, because the robot is at its limit.

        Called before the first frame if it differs then, and at every change.

        :param other: the parameters that differ, with their values in the stream; empty when nothing differs
        """

    def ended(self, error: SwitchboardError) -> None:
        """The stream is not available, or no longer. Called once, and not after :meth:`CameraViewer.leave`."""


def check_view(permit: Permit, camera: str, transport: str = "") -> None:
    """Check the right to view a camera.

    :param transport: as in :class:`~relay_protocol.link.video.VideoSettings`; it may name another topic
    :raises NotFound: no right; worded as if there were no such camera
    """
    if not _may_view(permit, camera, transport):
        raise NotFound(NO_CAMERA)


def _may_view(permit: Permit, camera: str, transport: str) -> bool:
    shown = {"compressed": link.compressed_of, "raw": link.raw_of}.get(transport, str)(camera)
    return all(permit.decide(Operation.VIEW, each).allowed for each in {camera, shown})


class CameraViewer:
    """A viewer of a stream. Its right is judged again whenever rights change.

    :param permit: held until the end, then handed to ``on_end`` with the viewer
    :param on_end: called once, when nothing is watched any more
    :param snapshot: whether it is for one image
    """

    def __init__(
        self,
        permit: Permit,
        robot: RobotState,
        camera: str,
        settings: link.VideoSettings,
        sink: FrameSink,
        *,
        address: str,
        on_end: Callable[[CameraViewer], None],
        snapshot: bool = False,
    ) -> None:
        self.permit = permit
        self.robot = robot
        self.camera = camera
        self.settings = settings
        self.address = address
        self.snapshot = snapshot
        self.frames = 0
        """Frames shown to this viewer."""
        self._sink = sink
        self._on_end = on_end
        self._stream: CameraStream | None = None
        permit.on_change = self._rights_changed
        permit.on_revoke = self.end

    @property
    def user(self) -> int:
        """The user's number."""
        return self.permit.principal.user_id

    @property
    def name(self) -> str:
        """The user's name at this robot."""
        return self.robot.name_of(self.permit.principal.name, self.permit.principal.realm)

    @property
    def event_data(self) -> dict[str, Any]:
        """The data of its events."""
        return {"camera": self.camera, **({"snapshot": True} if self.snapshot else {})}

    def start(self, streams: CameraStreams) -> None:
        """Start watching.

        :raises NotFound: no right to view the camera
        :raises Unavailable: there are too many viewers
        """
        check_view(self.permit, self.camera, self.settings.transport)
        stream = streams.watch(self.robot, self.camera, self.settings, self, newest=True)
        self._stream = stream
        if stream.settings != self.settings:
            self._sink.settings_differ(differing(self.settings, stream.settings))

    def request_keyframe(self) -> None:
        """A frame of H.264 was dropped: show nothing before the next key frame."""
        if self._stream is not None:
            self._stream.request_keyframe(self)

    def leave(self) -> None:
        """Stop watching. A second call does nothing."""
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.detach(self)
            self._on_end(self)

    def end(self, error: SwitchboardError) -> None:
        """Stop watching, and give the viewer the reason."""
        if self._stream is not None:
            self.leave()
            self._sink.ended(error)

    # --- ViewerPort ----------------------------------------------------------------------------------------

    def frame_received(self, frame: VideoFrameInfo) -> None:
        self.frames += 1
        self._sink.frame_received(frame)

    def status_changed(self, playing: link.StreamStatus) -> None:
        self._sink.status_changed(playing)

    def moved(self, stream: CameraStream) -> None:
        self._stream = stream
        self._sink.settings_differ(differing(self.settings, stream.settings))

    def ended(self, error: SwitchboardError) -> None:
        self.end(error)

    # --- rights -------------------------------------------------------------------------------------------

    def _rights_changed(self) -> None:
        if not _may_view(self.permit, self.camera, self.settings.transport):
            self.end(Refused(f"your right to view {self.camera} was revoked"))


def camera_info(camera: link.Camera, streams: Iterable[CameraStream]) -> dict[str, Any]:
    """A camera as users see it (SPEC 1.8)."""
    return {
        "name": camera.name,
        "type": camera.type,
        "encoding": camera.encoding or None,
        "width": camera.width or None,
        "height": camera.height or None,
        "fps": camera.fps or None,
        "seen": camera.seen or None,
        "streams": [_stream_info(stream) for stream in streams if stream.camera == camera.name],
    }


def _stream_info(stream: CameraStream) -> dict[str, Any]:
    playing = stream.status or stream.last_status
    return {
        "viewers": len(stream.viewers),
        "state": stream.state.name.lower(),
        "settings": msgspec.structs.asdict(stream.settings),
        "stream_status": None if playing is None else msgspec.structs.asdict(playing),
    }


class Snapshot:
    def __init__(self, seconds: Callable[[], float]) -> None:
        self._seconds = seconds
        self.other: dict[str, Any] = {}
        """Waits for the first frame; the stream decides how long.

        :param seconds: the monotonic clock of ``good_until``
        """
        self.done: Deferred[VideoFrameInfo] = Deferred()
        """The parameters that differ from the requested ones."""

    def frame_received(self, frame: VideoFrameInfo) -> None:
        """The frame; fails when there is none."""
        if not self.done.called and self._seconds() <= frame.good_until:
            self.done.callback(frame)

    def status_changed(self, playing: link.StreamStatus) -> None:
        """Takes the first frame that is not old."""

    def settings_differ(self, other: dict[str, Any]) -> None:
        """Ignored: the frame has headers with its own parameters."""
        self.other = other

    def ended(self, error: SwitchboardError) -> None:
        if not self.done.called:
            self.done.errback(error)
