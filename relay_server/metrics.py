"""Figures for Prometheus, read from the relay's state when they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector, CollectorRegistry

from relay_server.channels.channels import Channels
from relay_server.robots.registry import Availability, RobotRegistry
from relay_server.sessions.session import Session
from relay_server.video.streams import CameraStreams


class RelayCollector(Collector):
    """Counts robots, clients, channels, streams and their viewers."""

    def __init__(
        self,
        registry: RobotRegistry,
        channels: Channels,
        videos: CameraStreams,
        sessions: Callable[[], Iterable[Session]],
    ) -> None:
        self._registry = registry
        self._channels = channels
        self._videos = videos
        self._sessions = sessions

    def collect(self) -> Iterator[Metric]:
        """One reading."""
        robots = GaugeMetricFamily("switchboard_robots", "Robots by state", labels=["state"])
        states = [robot.state for robot in self._registry]
        for state in Availability:
            robots.add_metric([state.value], states.count(state))
        yield robots
        sessions = list(self._sessions())
        yield GaugeMetricFamily("switchboard_clients", "Clients connected", len(sessions))
        yield GaugeMetricFamily("switchboard_channels", "Channels in use", len(list(self._channels)))
        streams = list(self._videos)
        yield GaugeMetricFamily("switchboard_video_streams", "Streams of cameras", len(streams))
        yield GaugeMetricFamily(
            "switchboard_video_viewers",
            "Viewers of streams",
            sum(len(stream.viewers) for stream in streams),
        )
        yield GaugeMetricFamily(
            "switchboard_client_waiting_bytes",
            "Bytes that wait for slow clients",
            sum(session.outbox.waiting_bytes for session in sessions),
        )
        yield GaugeMetricFamily(
            "switchboard_client_dropped_samples",
            "Samples dropped for clients connected now, because they were slow",
            sum(session.outbox.dropped for session in sessions),
        )


def registry_of(*collectors: Collector) -> CollectorRegistry:
    """A registry of its own for one relay."""
    registry = CollectorRegistry(auto_describe=False)
    for collector in collectors:
        registry.register(collector)
    return registry
