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
from robot_client.camera.frame import Encoded, EncodeRequest, Frame
from robot_client.camera.ipc import (
    Answer,
    CameraSettings,
    CloseStream,
    Line,
    LogLine,
    NoFrames,
    OpenStream,
    StreamAccepted,
    StreamEnded,
)
from robot_client.camera.latest_frame import LatestFrame, Origin
from robot_client.camera.rtt_probe import RttProbe
from robot_client.camera.stream import Busy, EncodedStream
from robot_client.link.protocol import VideoLink
from robot_client.link.tls import endpoint, explain, split_address
from robot_client.link.transport import LinkProtocol
from robot_client.twisted_types import DelayedCall

LINGER = 30.0
"""Seconds for which a slow camera is kept that nobody watches: who comes again in vain finds what came meanwhile. The
process does not live longer without streams either.
"""


class CameraSource(NamedTuple):
    """What makes two streams share a camera: all by which it is opened, and nothing else.

    :param topic: empty for a camera without ROS
    :param compressed: as in :class:`~robot_client.camera.ipc.OpenStream`
    :param qos: as in :class:`~relay_protocol.link.video.VideoSettings`
    :param address: of a camera without ROS
    """

    topic: str = ""
    compressed: bool = False
    qos: str = ""
    address: str = ""


def _source_of(line: OpenStream) -> CameraSource:
    if line.topic:
        return CameraSource(line.topic, line.compressed, line.settings.qos)
    # Quality of service is ROS's; what is no topic may be there to be opened once.
    return CameraSource(address=line.source)


def _ros_cameras(node: str) -> Any:
    try:
        from robot_client.platforms.ros2.camera import RosCameras
    except ImportError as error:
        raise Unavailable(f"no ROS 2 found ({error})") from None
    return RosCameras(node)


class StreamManager:
    """Opens and closes streams as the daemon says.

    :param reactor: its clock must be monotonic
    :param tell: to the daemon
    :param make_ros: makes the node of this process, by its name, when the first camera of ROS is wanted; raises
        :class:`Unavailable`
    """

    def __init__(
        self,
        reactor: Any,
        settings: CameraSettings,
        tell: Callable[[Answer], None],
        make_ros: Callable[[str], Any] = _ros_cameras,
    ) -> None:
        self._reactor = reactor
        self._settings = settings
        self._tell = tell
        self._streams: dict[str, EncodedStream] = {}
        self._dialling: dict[str, Deferred[Any]] = {}
        self._make_ros = make_ros
        self._feeds: dict[CameraSource, LatestFrame] = {}
        self._lingering: dict[CameraSource, DelayedCall] = {}
        """Feeds nobody watches, and when they end."""
        self._views: set[_CameraView] = set()
        self._ways: WeakValueDictionary[str, RttProbe] = WeakValueDictionary()
        """To the relays, by address; each is kept by its streams."""
        self._ros: Any = None
        self._silent: frozenset[str] = frozenset()
        self._threads = ThreadPool(0, settings.streams, "pictures")
        self._threads.start()

    def take(self, line: Line) -> None:
        """One line of the daemon."""
        if isinstance(line, OpenStream):
            self._open(line)
        elif isinstance(line, CloseStream):
            self._close(line.stream, line.why)
        elif isinstance(line, NoFrames):
            before, self._silent = self._silent, frozenset(line.topics)
            for source, feed in list(self._feeds.items()):
                if source.topic in before - self._silent:
                    feed.speak()

    def stop(self, why: str) -> None:
        """Close all, and leave the graph; what was written still leaves."""
        for name in {*self._dialling, *self._streams}:
            self._close(name, why)
        for source in list(self._lingering):
            self._end(source)
        ros, self._ros = self._ros, None
        if ros is not None:
            ros.close()

    # --- streams -------------------------------------------------------------------------------------------

    def _open(self, line: OpenStream) -> None:
        self._tell(StreamAccepted(stream=line.stream))
        self._close(line.stream, "it is opened anew")
        factory = Factory.forProtocol(lambda: self._make_protocol(line))
        factory.noisy = False
        own = self._settings
        try:
            host, port = split_address(line.address or own.address)
            where = endpoint(self._reactor, host, port, own.tls, own.ca, own.server_name)
        except SwitchboardError as error:
            self._tell(StreamEnded(stream=line.stream, why=str(error)))
            return
        self._dialling[line.stream] = attempt = where.connect(factory)
        attempt.addErrback(self._unreachable, line.stream)
        attempt.addBoth(lambda _: self._dialled(line.stream, attempt))

    def _make_protocol(self, line: OpenStream) -> LinkProtocol:
        video = VideoLink(line.ticket, now_ns, line.heartbeat)
        return LinkProtocol(video, lambda protocol: self._make_stream(line, protocol), self._reactor)

    def _make_stream(self, line: OpenStream, protocol: LinkProtocol) -> EncodedStream:
        way = self._ways.setdefault(line.address or self._settings.address, RttProbe())
        stream = EncodedStream(
            line, protocol, self.watch, self._reactor, self._gone, way, self._settings.target
        )
        self._streams[line.stream] = stream
        return stream

    def _dialled(self, name: str, attempt: Deferred[Any]) -> None:
        if self._dialling.get(name) is attempt:
            del self._dialling[name]

    def _unreachable(self, failure: Failure, name: str) -> None:
        if not isinstance(failure.value, CancelledError):
            self._tell(StreamEnded(stream=name, why=explain(failure)))

    def _gone(self, stream: EncodedStream, why: str) -> None:
        name = stream.line.stream
        if self._streams.get(name) is stream:
            del self._streams[name]
            self._tell(StreamEnded(stream=name, why=why))

    def _close(self, name: str, why: str) -> None:
        attempt = self._dialling.pop(name, None)
        if attempt is not None:
            attempt.cancel()
        stream = self._streams.pop(name, None)
        if stream is not None:
            stream.close(why)

    # --- cameras -------------------------------------------------------------------------------------------

    def watch(self, line: OpenStream, on_shot: Callable[[Frame], None]) -> _CameraView:
        """Have a camera for a stream.

        :raises Busy: there are as many streams as there may be
        :raises NotFound: there is no such camera
        :raises Unavailable: what it takes is not installed
        """
        if len(self._views) >= self._settings.streams:
            raise Busy(f"this robot shows {self._settings.streams} streams at a time, and not one more")
        if not line.topic and not line.source:
            raise NotFound(f"there is no camera {line.camera} on this robot")
        check_installed()
        source = _source_of(line)
        feed = self._feeds.get(source)
        if feed is None:
            feed = self._feeds[source] = self._make_feed(line)
        timer = self._lingering.pop(source, None)
        if timer is not None:
            timer.cancel()
        view = _CameraView(
            feed, line, on_shot, self._work, lambda: self._latest(source), lambda: self._unwatch(source, view)
        )
        self._views.add(view)
        return view

    def _unwatch(self, source: CameraSource, view: _CameraView) -> None:
        self._views.discard(view)
        feed = self._feeds[source]
        if feed.listeners:
            return
        # What is no topic and gives nothing is broken, or a device that others wait for.
        if source.topic and feed.slow:
            self._lingering[source] = self._reactor.callLater(LINGER, self._end, source)
            if len(self._lingering) > self._settings.streams:
                self._end(next(iter(self._lingering)))
        else:
            self._end(source)

    def _end(self, source: CameraSource) -> None:
        timer = self._lingering.pop(source, None)
        if timer is not None and timer.active():
            timer.cancel()
        self._feeds.pop(source).close()

    def _make_feed(self, line: OpenStream) -> LatestFrame:
        name = line.topic or line.camera
        feed = LatestFrame(name, self._reactor, self._reactor.callFromThread, self._tell)
        try:
            feed.source = self._subscribe(line, feed) if line.topic else self._capture(line, feed)
        except BaseException:
            feed.abandon()
            raise
        return feed

    def _subscribe(self, line: OpenStream, feed: LatestFrame) -> Origin:
        from robot_client.camera.frame_maker import message_shot

        def arrived(cdr: bytes) -> None:
            shot = message_shot(time.time_ns(), self._reactor.seconds(), cdr, line.compressed)
            if line.topic in self._silent:
                feed.keep(shot)
            else:
                feed.put(shot)

        subscribed: Origin = self._in_ros().subscribe(line.topic, line.compressed, line.settings.qos, arrived)
        return subscribed

    def _capture(self, line: OpenStream, feed: LatestFrame) -> Origin:
        from robot_client.camera.capture import Capture
        from robot_client.camera.frame_maker import pixels_shot

        def tell(level: str, text: str) -> None:
            self._reactor.callFromThread(
                self._tell, LogLine(level=level, text=f"camera {line.camera} {text}")
            )

        return Capture(
            line.source,
            lambda pixels: feed.put(pixels_shot(time.time_ns(), self._reactor.seconds(), pixels)),
            tell,
        )

    def _in_ros(self) -> Any:
        if self._ros is None:
            self._ros = self._make_ros(self._settings.node)
        return self._ros

    def _latest(self, source: CameraSource) -> Frame | None:
        return None if source.topic in self._silent else self._feeds[source].latest()

    def _work(
        self, make: Callable[[Frame, EncodeRequest], Encoded], shot: Frame, wish: EncodeRequest
    ) -> Deferred[Encoded]:
        return deferToThreadPool(self._reactor, self._threads, make, shot, wish)


class _CameraView:
    """A camera as one stream has it."""

    def __init__(
        self,
        feed: LatestFrame,
        line: OpenStream,
        on_shot: Callable[[Frame], None],
        work: Callable[[Callable[[Frame, EncodeRequest], Encoded], Frame, EncodeRequest], Deferred[Encoded]],
        latest: Callable[[], Frame | None],
        on_close: Callable[[], None],
    ) -> None:
        from robot_client.camera.frame_maker import FrameMaker

        self._feed = feed
        self._on_shot = on_shot
        self._work = work
        self._maker = FrameMaker(line.settings)
        self.latest = latest
        """Gives the newest picture there is, if it is still what the camera shows and may be shown."""
        self._on_close = on_close
        feed.listeners.add(on_shot)

    @property
    def fps(self) -> float:
        """Pictures per second, as they came of late."""
        return self._feed.fps

    @property
    def latched(self) -> bool:
        """Whether its publisher keeps the latest picture for those who come later."""
        return self._feed.source.latched

    def make(self, shot: Frame, wish: EncodeRequest) -> Deferred[Encoded]:
        """Make a picture to be sent, in a thread."""
        return self._work(self._maker.make, shot, wish)

    def close(self) -> None:
        """Want it no more."""
        self._feed.listeners.discard(self._on_shot)
        self._on_close()
