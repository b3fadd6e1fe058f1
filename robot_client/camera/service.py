"""The daemon's cameras: the list that the relay receives, and streams, opened and closed as the relay
requests."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from relay_protocol import limits, link
from robot_client.camera.ipc import CameraSeen, OpenStream
from robot_client.camera.supervisor import CameraSupervisor
from robot_client.platforms.base import GraphView
from robot_client.twisted_types import DelayedCall, ReactorClock

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
REPORT_INTERVAL = 1.0
"""Least seconds between two ``cameras`` messages."""


class DaemonCameras:
    """The cameras of one robot.

    :param configured: sources of cameras without ROS, by name
    :param supervisor: of the camera process
    :param send: sends a message to the relay
    :param address: returns that of the control link
    """

    def __init__(
        self,
        configured: Mapping[str, str],
        supervisor: CameraSupervisor,
        send: Callable[[link.Message], None],
        clock: ReactorClock,
        address: Callable[[], str],
    ) -> None:
        self._address = address
        self._configured = configured
        self._supervisor = supervisor
        self._send = send
        self._clock = clock
        self._topics: dict[str, str] = {}
        self._seen: dict[str, CameraSeen] = {}
        self._heartbeat = limits.HEARTBEAT_SECONDS
        self._reported: list[link.Camera] | None = None
        self._reported_at = float("-inf")
        self._timer: DelayedCall | None = None
        supervisor.on_seen = self._on_seen

    def registered(self, heartbeat: float) -> None:
        """Report all cameras to the relay.

        :param heartbeat: seconds, for the links of streams
        """
        self._heartbeat = heartbeat
        self._reported = None
        self._report()

    def link_lost(self, reason: str) -> None:
        """Close all streams, since the control link is lost."""
        self._reported = None
        self._supervisor.close_all(reason)

    def update_graph(self, view: GraphView) -> None:
        """Find the cameras in the graph."""
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
        """Open a stream. If there is no such camera, the process reports that on the stream's link."""
        source = self._configured.get(message.camera, "")
        topic, type = self._topic_of(message.camera, message.settings.transport) if not source else ("", "")
        self._supervisor.open(
            OpenStream(
                stream=message.stream,
                ticket=message.ticket,
                camera=message.camera,
                settings=message.settings,
                topic=topic,
                compressed=type == COMPRESSED,
                source=source,
                address=message.address or self._address(),
                heartbeat=self._heartbeat,
            )
        )

    def close(self, message: link.CloseVideo) -> None:
        """Close a stream."""
        self._supervisor.close(message.stream, "the relay closed it")

    def inhibit(self, topics: Iterable[str]) -> None:
        """Set the inhibited topics; their cameras show nothing new."""
        self._supervisor.inhibit(topics)

    def _topic_of(self, camera: str, transport: str) -> tuple[str, str]:
        """Topic and type to subscribe to: that with the requested transport if it exists, else the camera's
        own."""
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
        if self._reported is not None and self._timer is None:
            wait = max(0.0, self._reported_at + REPORT_INTERVAL - self._clock.seconds())
            self._timer = self._clock.callLater(wait, self._report_again)

    def _report_again(self) -> None:
        self._timer = None
        if self._reported is not None:
            self._report()

    def _report(self) -> None:
        cameras = self._cameras()
        if cameras != self._reported:
            self._reported = cameras
            self._reported_at = self._clock.seconds()
            self._send(link.Cameras(cameras=cameras, streams=self._supervisor.max_streams))

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
