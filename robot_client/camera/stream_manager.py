"""All streams of the camera process, and the cameras they share."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.protocol import Factory
from twisted.internet.threads import deferToThreadPool
from twisted.python.failure import Failure
from twisted.python.threadpool import ThreadPool

from relay_protocol.clocks import now_ns
from relay_protocol.errors import NotFound, SwitchboardError, Unavailable
from robot_client.camera import check_installed
from robot_client.camera.frame import Encoded, EncodeRequest, Frame, FrameSource, LatestFrame
from robot_client.camera.ipc import (
    CameraMessage,
    CameraSettings,
    CloseStream,
    DaemonMessage,
    InhibitTopics,
    LogLine,
    OpenStream,
    StreamAccepted,
    StreamEnded,
)
from robot_client.camera.rate_control import RttProbe
from robot_client.camera.stream import EncodedStream, StreamLimitReached
from robot_client.link.links import VideoLink
from robot_client.link.tls import endpoint, explain, split_address
from robot_client.link.transport import LinkProtocol
from robot_client.twisted_types import DelayedCall

LINGER = 30.0
"""Seconds for which a slow camera stays open without viewers, so that the next viewer gets the frame that
arrived meanwhile. The process does not live longer without streams either.
"""


class CameraSource(NamedTuple):
    """Everything by which a camera is opened; streams with the same value share it.

    :param topic: empty for a camera without ROS
    :param compressed: as in :class:`~robot_client.camera.ipc.OpenStream`
    :param qos: as in :class:`~relay_protocol.link.video.VideoSettings`
    :param address: of a camera without ROS
    """

    topic: str = ""
    compressed: bool = False
    qos: str = ""
    address: str = ""


def _source_of(request: OpenStream) -> CameraSource:
    if request.topic:
        return CameraSource(request.topic, request.compressed, request.settings.qos)
    # Without the quality of service, which is ROS's: a device can be opened only once.
    return CameraSource(address=request.source)


def _ros_cameras(node: str) -> Any:
    try:
        from robot_client.platforms.ros2.camera import RosCameras
    except ImportError as error:
        raise Unavailable(f"no ROS 2 found ({error})") from None
    return RosCameras(node)


class StreamManager:
    """Opens and closes streams as the daemon requests.

    :param reactor: its clock must be monotonic
    :param send: sends a message to the daemon
    :param build_ros: builds the node of this process, by its name, for the first ROS camera; raises
        :class:`Unavailable`
    """

    def __init__(
        self,
        reactor: Any,
        settings: CameraSettings,
        send: Callable[[CameraMessage], None],
        build_ros: Callable[[str], Any] = _ros_cameras,
    ) -> None:
        self._reactor = reactor
        self._settings = settings
        self._send = send
        self._streams: dict[str, EncodedStream] = {}
        self._dialling: dict[str, Deferred[Any]] = {}
        self._build_ros = build_ros
        self._cameras: dict[CameraSource, LatestFrame] = {}
        self._lingering: dict[CameraSource, DelayedCall] = {}
        """Cameras without viewers, and the timers that close them."""
        self._views: set[_CameraView] = set()
        self._rtt_probes: WeakValueDictionary[str, RttProbe] = WeakValueDictionary()
        """By address of the relay; its streams keep each alive."""
        self._ros: Any = None
        self._inhibited: frozenset[str] = frozenset()
        self._threads = ThreadPool(0, settings.streams, "encoding")
        self._threads.start()

    def handle(self, message: DaemonMessage) -> None:
        """Handle a message of the daemon."""
        if isinstance(message, OpenStream):
            self._open(message)
        elif isinstance(message, CloseStream):
            self._close(message.stream, message.reason)
        elif isinstance(message, InhibitTopics):
            before, self._inhibited = self._inhibited, frozenset(message.topics)
            for source, camera in list(self._cameras.items()):
                if source.topic in before - self._inhibited:
                    camera.release()

    def stop(self, reason: str) -> None:
        """Close all streams and the node; what was written is still sent."""
        for name in {*self._dialling, *self._streams}:
            self._close(name, reason)
        for source in list(self._lingering):
            self._close_camera(source)
        ros, self._ros = self._ros, None
        if ros is not None:
            ros.close()

    # --- streams -------------------------------------------------------------------------------------------

    def _open(self, request: OpenStream) -> None:
        self._send(StreamAccepted(stream=request.stream))
        self._close(request.stream, "the relay opened it again")
        factory = Factory.forProtocol(lambda: self._build_protocol(request))
        factory.noisy = False
        own = self._settings
        try:
            host, port = split_address(request.address or own.address)
            relay = endpoint(self._reactor, host, port, own.tls, own.ca, own.server_name)
        except SwitchboardError as error:
            self._send(StreamEnded(stream=request.stream, reason=str(error)))
            return
        self._dialling[request.stream] = attempt = relay.connect(factory)
        attempt.addErrback(self._dial_failed, request.stream)
        attempt.addBoth(lambda _: self._dialled(request.stream, attempt))

    def _build_protocol(self, request: OpenStream) -> LinkProtocol:
        video = VideoLink(request.ticket, now_ns, request.heartbeat)
        return LinkProtocol(video, lambda protocol: self._build_stream(request, protocol), self._reactor)

    def _build_stream(self, request: OpenStream, protocol: LinkProtocol) -> EncodedStream:
        rtt_probe = self._rtt_probes.setdefault(request.address or self._settings.address, RttProbe())
        stream = EncodedStream(
            request,
            protocol,
            self.open_view,
            self._reactor,
            self._stream_closed,
            rtt_probe,
            self._settings.target,
        )
        self._streams[request.stream] = stream
        return stream

    def _dialled(self, name: str, attempt: Deferred[Any]) -> None:
        if self._dialling.get(name) is attempt:
            del self._dialling[name]

    def _dial_failed(self, failure: Failure, name: str) -> None:
        if not isinstance(failure.value, CancelledError):
            self._send(StreamEnded(stream=name, reason=explain(failure)))

    def _stream_closed(self, stream: EncodedStream, reason: str) -> None:
        name = stream.request.stream
        if self._streams.get(name) is stream:
            del self._streams[name]
            self._send(StreamEnded(stream=name, reason=reason))

    def _close(self, name: str, reason: str) -> None:
        attempt = self._dialling.pop(name, None)
        if attempt is not None:
            attempt.cancel()
        stream = self._streams.pop(name, None)
        if stream is not None:
            stream.close(reason)

    # --- cameras -------------------------------------------------------------------------------------------

    def open_view(self, request: OpenStream, on_frame: Callable[[Frame], None]) -> _CameraView:
        """Open a camera for a stream.

        :raises StreamLimitReached: there are as many streams as set
        :raises NotFound: there is no such camera
        :raises Unavailable: a required package is not installed
        """
        if len(self._views) >= self._settings.streams:
            raise StreamLimitReached(
                f"this robot is set to show at most {self._settings.streams} streams at a time"
            )
        if not request.topic and not request.source:
            raise NotFound(f"there is no camera {request.camera} on this robot")
        check_installed()
        source = _source_of(request)
        camera = self._cameras.get(source)
        if camera is None:
            camera = self._cameras[source] = self._open_camera(request)
        timer = self._lingering.pop(source, None)
        if timer is not None:
            timer.cancel()
        view = _CameraView(
            camera,
            request,
            on_frame,
            self._in_thread,
            lambda: self._latest(source),
            lambda: self._view_closed(source, view),
        )
        self._views.add(view)
        return view

    def _view_closed(self, source: CameraSource, view: _CameraView) -> None:
        self._views.discard(view)
        camera = self._cameras[source]
        if camera.listeners:
            return
        # A device that delivers nothing is broken, or other programs wait for it; so only topics stay open.
        if source.topic and camera.slow:
            self._lingering[source] = self._reactor.callLater(LINGER, self._close_camera, source)
            if len(self._lingering) > self._settings.streams:
                self._close_camera(next(iter(self._lingering)))
        else:
            self._close_camera(source)

    def _close_camera(self, source: CameraSource) -> None:
        timer = self._lingering.pop(source, None)
        if timer is not None and timer.active():
            timer.cancel()
        self._cameras.pop(source).close()

    def _open_camera(self, request: OpenStream) -> LatestFrame:
        name = request.topic or request.camera
        camera = LatestFrame(name, self._reactor, self._reactor.callFromThread, self._send)
        try:
            open_source = self._subscribe if request.topic else self._capture
            camera.source = open_source(request, camera)
        except BaseException:
            camera.cancel()
            raise
        return camera

    def _subscribe(self, request: OpenStream, camera: LatestFrame) -> FrameSource:
        from robot_client.camera.encoder import frame_from_message

        def on_message(cdr: bytes) -> None:
            frame = frame_from_message(time.time_ns(), self._reactor.seconds(), cdr, request.compressed)
            if request.topic in self._inhibited:
                camera.withhold(frame)
            else:
                camera.put(frame)

        if self._ros is None:
            self._ros = self._build_ros(self._settings.node)
        source: FrameSource = self._ros.subscribe(
            request.topic, request.compressed, request.settings.qos, on_message
        )
        return source

    def _capture(self, request: OpenStream, camera: LatestFrame) -> FrameSource:
        from robot_client.camera.capture import Capture
        from robot_client.camera.encoder import frame_from_pixels

        def on_log(level: str, text: str) -> None:
            line = LogLine(level=level, text=f"camera {request.camera} {text}")
            self._reactor.callFromThread(self._send, line)

        return Capture(
            request.source,
            lambda pixels: camera.put(frame_from_pixels(time.time_ns(), self._reactor.seconds(), pixels)),
            on_log,
        )

    def _latest(self, source: CameraSource) -> Frame | None:
        return None if source.topic in self._inhibited else self._cameras[source].latest()

    def _in_thread(
        self, encode: Callable[[Frame, EncodeRequest], Encoded], frame: Frame, request: EncodeRequest
    ) -> Deferred[Encoded]:
        return deferToThreadPool(self._reactor, self._threads, encode, frame, request)


class _CameraView:
    """One stream's view of a camera; see :class:`~robot_client.camera.stream.CameraViewPort`."""

    def __init__(
        self,
        camera: LatestFrame,
        request: OpenStream,
        on_frame: Callable[[Frame], None],
        in_thread: Callable[
            [Callable[[Frame, EncodeRequest], Encoded], Frame, EncodeRequest], Deferred[Encoded]
        ],
        latest: Callable[[], Frame | None],
        on_close: Callable[[], None],
    ) -> None:
        from robot_client.camera.encoder import FrameEncoder

        self._camera = camera
        self._on_frame = on_frame
        self._in_thread = in_thread
        self._encoder = FrameEncoder(request.settings)
        self.latest = latest
        self._on_close = on_close
        camera.listeners.add(on_frame)

    @property
    def fps(self) -> float:
        return self._camera.fps

    @property
    def latched(self) -> bool:
        return self._camera.source.latched

    def encode(self, frame: Frame, request: EncodeRequest) -> Deferred[Encoded]:
        return self._in_thread(self._encoder.encode, frame, request)

    def close(self) -> None:
        self._camera.listeners.discard(self._on_frame)
        self._on_close()
