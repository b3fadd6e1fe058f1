"""The daemon's side of cameras: which there are, told to the relay; streams, opened and closed as it wants them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from relay_protocol import limits, link
from robot_client.camera.ipc import CameraSeen, OpenStream
from robot_client.camera.supervisor import CameraSupervisor
from robot_client.platforms.base import GraphView
from robot_client.twisted_types import DelayedCall, ReactorClock

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
TELL_EVERY = 1.0
"""Seconds between two words of ``cameras``, at least."""


class DaemonCameras:
    """Knows the cameras of one robot.

    :param configured: cameras without ROS: what to open, by name
    :param keeper: of the process that shows them
    :param say: to the relay
    """

    def __init__(
        self,
        configured: Mapping[str, str],
        keeper: CameraSupervisor,
        say: Callable[[link.Message], None],
        clock: ReactorClock,
    ) -> None:
        self._configured = configured
        self._keeper = keeper
        self._say = say
        self._clock = clock
        self._topics: dict[str, str] = {}
        self._seen: dict[str, CameraSeen] = {}
        self._heartbeat = limits.HEARTBEAT_SECONDS
        self._told: list[link.Camera] | None = None
        self._told_at = float("-inf")
        self._timer: DelayedCall | None = None
        keeper.on_seen = self._on_seen

    def registered(self, heartbeat: float) -> None:
        """The relay knows us now; tell it all.

        :param heartbeat: seconds, for the links to come
        """
        self._heartbeat = heartbeat
        self._told = None
        self._tell()

    def unregistered(self, why: str) -> None:
        """The control link is gone, and all streams with it."""
        self._told = None
        self._keeper.close_all(why)

    def look(self, view: GraphView) -> None:
        """Take note of the graph."""
        topics = {
            name: type
            for name, topic in view.topics.items()
            for type in topic.types
            if type in (IMAGE, COMPRESSED) and topic.publishers and name not in self._configured
            if "/_" not in name
        }
        if topics != self._topics:
            self._topics = topics
            self._seen = {
                name: seen for name, seen in self._seen.items() if name in topics or name in self._configured
            }
            self._changed()

    def open(self, message: link.OpenVideo) -> None:
        """The relay wants to see a camera; the process says so on the stream's link when there is none."""
        source = self._configured.get(message.camera, "")
        topic, type = self._topic_of(message.camera, message.settings.transport) if not source else ("", "")
        self._keeper.open(
            OpenStream(
                stream=message.stream,
                ticket=message.ticket,
                camera=message.camera,
                settings=message.settings,
                topic=topic,
                compressed=type == COMPRESSED,
                source=source,
                address=message.address,
                heartbeat=self._heartbeat,
            )
        )

    def close(self, message: link.CloseVideo) -> None:
        """Nobody watches any more."""
        self._keeper.close(message.stream, "nobody watches any more")

    def silence(self, topics: Iterable[str]) -> None:
        """Let these topics show nothing new, and all others go on."""
        self._keeper.silence(topics)

    def _topic_of(self, camera: str, transport: str) -> tuple[str, str]:
        """Topic and type to subscribe to: the other one of the pair when that is asked for and there."""
        type = self._topics.get(camera, "")
        other = camera
        if transport == "compressed" and type != COMPRESSED:
            other = link.compressed_of(camera)
        elif transport == "raw" and type != IMAGE:
            other = link.raw_of(camera)
        if other in self._topics:
            return other, self._topics[other]
        return (camera, type) if type else ("", "")

    def _on_seen(self, seen: CameraSeen) -> None:
        if seen.camera in self._topics or seen.camera in self._configured:
            self._seen[seen.camera] = seen
            self._changed()

    def _changed(self) -> None:
        if self._told is not None and self._timer is None:
            wait = max(0.0, self._told_at + TELL_EVERY - self._clock.seconds())
            self._timer = self._clock.callLater(wait, self._tell_again)

    def _tell_again(self) -> None:
        self._timer = None
        if self._told is not None:
            self._tell()

    def _tell(self) -> None:
        cameras = self._cameras()
        if cameras != self._told:
            self._told = cameras
            self._told_at = self._clock.seconds()
            self._say(link.Cameras(cameras=cameras, streams=self._keeper.most))

    def _cameras(self) -> list[link.Camera]:
        types = {**self._topics, **dict.fromkeys(self._configured, "")}
        known = sorted(name for name in types if len(name) <= limits.NAME)[: limits.CAMERAS]
        return [self._camera(name, types[name]) for name in known]

    def _camera(self, name: str, type: str) -> link.Camera:
        seen = self._seen.get(name)
        if seen is None:
            return link.Camera(name=name, type=type)
        return link.Camera(
            name=name,
            type=type,
            encoding=seen.encoding,
            width=seen.width,
            height=seen.height,
            fps=seen.fps,
            seen=seen.at,
        )
