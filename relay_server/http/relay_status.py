"""``/healthz``, ``/readyz``, ``/livez`` and ``/metrics``: the health of the relay, and its figures for Prometheus."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable, Iterator

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from prometheus_client.registry import Collector
from twisted.internet.defer import succeed

from relay_protocol.errors import Refused, Unavailable
from relay_protocol.realms import DEFAULT_REALM
from relay_server.channels.channel import Channels
from relay_server.http.endpoint import ApiRequest, Document, endpoint
from relay_server.http.media_types import MediaType
from relay_server.http.openapi.operation import Credential, HealthInfo
from relay_server.robots.registry import Availability, RobotRegistry
from relay_server.sessions.context import ClientContext
from relay_server.video.streams import CameraStreams


class RelayCollector(Collector):
    """Counts robots, clients, channels, streams and their viewers."""

    def __init__(
        self,
        registry: RobotRegistry,
        channels: Channels,
        videos: CameraStreams,
        clients: Callable[[], Iterable[ClientContext]],
    ) -> None:
        self._registry = registry
        self._channels = channels
        self._videos = videos
        self._clients = clients

    def collect(self) -> Iterator[Metric]:
        """See ``Collector``."""
        robots = GaugeMetricFamily("switchboard_robots", "Robots by state", labels=["state"])
        states = [robot.state for robot in self._registry]
        for state in Availability:
            robots.add_metric([state.value], states.count(state))
        yield robots
        clients = list(self._clients())
        yield GaugeMetricFamily("switchboard_clients", "Clients connected", len(clients))
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
            "Bytes queued for slow clients",
            sum(client.port.waiting_bytes for client in clients),
        )
        yield GaugeMetricFamily(
            "switchboard_client_dropped_samples",
            "Samples dropped for connected clients that were too slow",
            sum(client.drops for client in clients),
        )


def registry_of(*collectors: Collector) -> CollectorRegistry:
    """The registry of one relay."""
    registry = CollectorRegistry(auto_describe=False)
    for collector in collectors:
        registry.register(collector)
    return registry


class StatusEndpoints:
    """The state of the relay itself.

    :param healthy: whether the database answers
    :param draining: whether clients and robots are to use another relay
    :param refresh: prepares metrics of other relays
    """

    def __init__(
        self,
        healthy: Callable[[], Awaitable[bool]],
        metrics: CollectorRegistry,
        draining: Callable[[], bool] = lambda: False,
        refresh: Callable[[], Awaitable[None]] = lambda: succeed(None),
    ) -> None:
        self._healthy = healthy
        self._draining = draining
        self._metrics = metrics
        self._refresh = refresh

    @endpoint(
        "GET",
        "/healthz",
        tag="relay",
        summary="Health of the relay and its database",
        returns="they do",
        credential=Credential.NONE,
        errors=(503,),
    )
    async def health(self, request: ApiRequest) -> HealthInfo:
        await self._check_database()
        return {"status": "ok"}

    @endpoint(
        "GET",
        "/readyz",
        tag="relay",
        summary="Whether a load balancer may send clients and robots here",
        more="A relay that is being drained answers 503. One whose database does not answer says 200: what is known is "
        "served, and robots can be stopped.",
        returns="it may",
        credential=Credential.NONE,
        errors=(503,),
    )
    async def ready(self, request: ApiRequest) -> HealthInfo:
        if self._draining():
            raise Unavailable("this relay is being drained; use another one")
        return {"status": "ok"}

    @endpoint(
        "GET",
        "/livez",
        tag="relay",
        summary="Whether the relay still works",
        more="It always says so. A relay that gives no answer for a minute hangs, and should be started again.",
        returns="it does",
        credential=Credential.NONE,
    )
    async def live(self, request: ApiRequest) -> HealthInfo:
        return {"status": "ok"}

    async def _check_database(self) -> None:
        if not await self._healthy():
            raise Unavailable("the database does not answer: open connections continue, new logins fail")

    @endpoint(
        "GET",
        "/metrics",
        tag="relay",
        summary="Figures for Prometheus",
        more="For administrators.",
        returns="figures",
        forms=(MediaType("text/plain"),),
    )
    async def metrics(self, request: ApiRequest) -> Document:
        principal = request.principal
        if not principal.admin or principal.realm != DEFAULT_REALM:
            raise Refused(
                f"metrics are for administrators of the realm '{DEFAULT_REALM}', since they cover all realms"
            )
        await self._refresh()
        return Document(generate_latest(self._metrics), CONTENT_TYPE_LATEST)
