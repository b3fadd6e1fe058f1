"""All streams of the camera process, and the cameras they share."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.protocol import Factory
from twisted.internet.threads import deferToThreadPool
from twisted.python.failure import Failure
from twisted.python.threadpool import ThreadPool

from relay_protocol.errors import NotFound, SwitchboardError, Unavailable
from robot_client.camera import check_installed
from robot_client.camera.feed import Closes, Feed
from robot_client.camera.lines import Answer, Close, Ended, Line, Log, Open, Settings, Silent, Taken
from robot_client.camera.shot import Made, Shot, Wish
from robot_client.camera.stream import Busy, Stream
from robot_client.clocks import now_ns
from robot_client.link import VideoLink
from robot_client.tls import endpoint, explain, split_address
from robot_client.transport import LinkProtocol

Source = tuple[str, str]
"""What makes two streams share a camera: where its pictures come from, and by which quality of service."""


class Studio:
    """Opens and closes streams as the daemon says.

    :param reactor: its clock must be monotonic
    :param tell: to the daemon
    """

    def __init__(self, reactor: Any, settings: Settings, tell: Callable[[Answer], None]) -> None:
        self._reactor = reactor
        self._settings = settings
        self._tell = tell
        self._streams: dict[str, Stream] = {}
        self._dialling: dict[str, Deferred[Any]] = {}
        self._feeds: dict[Source, Feed] = {}
        self._views: set[_View] = set()
        self._ros: Any = None
        self._silent: frozenset[str] = frozenset()
        self._threads = ThreadPool(0, settings.streams, "pictures")
        self._threads.start()

    def take(self, line: Line) -> None:
        """One line of the daemon."""
        if isinstance(line, Open):
            self._open(line)
        elif isinstance(line, Close):
            self._close(line.stream, line.why)
        elif isinstance(line, Silent):
            self._silent = frozenset(line.topics)

    def stop(self, why: str) -> None:
        """Close all, and leave the graph; what was written still leaves."""
        for name in {*self._dialling, *self._streams}:
            self._close(name, why)
        ros, self._ros = self._ros, None
        if ros is not None:
            ros.close()

    # --- streams -------------------------------------------------------------------------------------------

    def _open(self, line: Open) -> None:
        self._tell(Taken(stream=line.stream))
        self._close(line.stream, "it is opened anew")
        factory = Factory.forProtocol(lambda: self._make_protocol(line))
        factory.noisy = False
        own = self._settings
        try:
            host, port = split_address(line.address or own.address)
            where = endpoint(self._reactor, host, port, own.tls, own.ca, own.server_name)
        except SwitchboardError as error:
            self._tell(Ended(stream=line.stream, why=str(error)))
            return
        self._dialling[line.stream] = attempt = where.connect(factory)
        attempt.addErrback(self._unreachable, line.stream)
        attempt.addBoth(lambda _: self._dialled(line.stream, attempt))

    def _make_protocol(self, line: Open) -> LinkProtocol:
        video = VideoLink(line.ticket, now_ns, line.heartbeat)
        return LinkProtocol(video, lambda protocol: self._make_stream(line, protocol), self._reactor)

    def _make_stream(self, line: Open, protocol: LinkProtocol) -> Stream:
        stream = Stream(line, protocol, self.watch, self._reactor, self._gone)
        self._streams[line.stream] = stream
        return stream

    def _dialled(self, name: str, attempt: Deferred[Any]) -> None:
        if self._dialling.get(name) is attempt:
            del self._dialling[name]

    def _unreachable(self, failure: Failure, name: str) -> None:
        if not isinstance(failure.value, CancelledError):
            self._tell(Ended(stream=name, why=explain(failure)))

    def _gone(self, stream: Stream, why: str) -> None:
        name = stream.line.stream
        if self._streams.get(name) is stream:
            del self._streams[name]
            self._tell(Ended(stream=name, why=why))

    def _close(self, name: str, why: str) -> None:
        attempt = self._dialling.pop(name, None)
        if attempt is not None:
            attempt.cancel()
        stream = self._streams.pop(name, None)
        if stream is not None:
            stream.close(why)

    # --- cameras -------------------------------------------------------------------------------------------

    def watch(self, line: Open, on_shot: Callable[[Shot], None]) -> _View:
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
        # Quality of service is ROS's; what is no topic may be there to be opened once.
        source = (line.source, "") if line.source else (line.topic, line.settings.qos)
        feed = self._feeds.get(source)
        if feed is None:
            feed = self._feeds[source] = self._make_feed(line)
        view = _View(feed, line, on_shot, self._work, lambda: self._unwatch(source, view))
        self._views.add(view)
        return view

    def _unwatch(self, source: Source, view: _View) -> None:
        self._views.discard(view)
        feed = self._feeds[source]
        if not feed.listeners:
            del self._feeds[source]
            feed.close()

    def _make_feed(self, line: Open) -> Feed:
        name = line.topic or line.camera
        feed = Feed(name, self._reactor, self._reactor.callFromThread, self._tell)
        try:
            feed.source = self._subscribe(line, feed) if line.topic else self._capture(line, feed)
        except BaseException:
            feed.abandon()
            raise
        return feed

    def _subscribe(self, line: Open, feed: Feed) -> Closes:
        from robot_client.camera.making import message_shot

        def arrived(cdr: bytes) -> None:
            if line.topic in self._silent:
                return
            feed.put(message_shot(time.time_ns(), self._reactor.seconds(), cdr, line.compressed))

        subscribed: Closes = self._in_ros().subscribe(line.topic, line.compressed, line.settings.qos, arrived)
        return subscribed

    def _capture(self, line: Open, feed: Feed) -> Closes:
        from robot_client.camera.capture import Capture
        from robot_client.camera.making import pixels_shot

        def tell(level: str, text: str) -> None:
            self._reactor.callFromThread(self._tell, Log(level=level, text=f"camera {line.camera} {text}"))

        return Capture(
            line.source,
            lambda pixels: feed.put(pixels_shot(time.time_ns(), self._reactor.seconds(), pixels)),
            tell,
        )

    def _in_ros(self) -> Any:
        """The node of this process, made when the first camera of ROS is wanted."""
        if self._ros is None:
            try:
                from robot_client.platforms.ros2_camera import RosCameras
            except ImportError as error:
                raise Unavailable(f"no ROS 2 found ({error})") from None
            self._ros = RosCameras(self._settings.node)
        return self._ros

    def _work(self, make: Callable[[Shot, Wish], Made], shot: Shot, wish: Wish) -> Deferred[Made]:
        return deferToThreadPool(self._reactor, self._threads, make, shot, wish)


class _View:
    """A camera as one stream has it."""

    def __init__(
        self,
        feed: Feed,
        line: Open,
        on_shot: Callable[[Shot], None],
        work: Callable[[Callable[[Shot, Wish], Made], Shot, Wish], Deferred[Made]],
        on_close: Callable[[], None],
    ) -> None:
        from robot_client.camera.making import Maker

        self._feed = feed
        self._on_shot = on_shot
        self._work = work
        self._maker = Maker(line.settings)
        self._on_close = on_close
        feed.listeners.add(on_shot)

    @property
    def fps(self) -> float:
        """Pictures per second, as they came of late."""
        return self._feed.fps

    def make(self, shot: Shot, wish: Wish) -> Deferred[Made]:
        """Make a picture to be sent, in a thread."""
        return self._work(self._maker.make, shot, wish)

    def close(self) -> None:
        """Want it no more."""
        self._feed.listeners.discard(self._on_shot)
        self._on_close()
