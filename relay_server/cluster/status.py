"""Which relays the cluster has, and how loaded each of them is. Every relay answers for itself over the bus."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Literal

import msgspec
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from twisted.internet.defer import Deferred, gatherResults

from relay_protocol.errors import SwitchboardError
from relay_server.cluster.bus import ClusterBus
from relay_server.cluster.drain import Drain
from relay_server.cluster.homes import ClusterHomes
from relay_server.cluster.relays import RelayDirectory, RelayInfo

ANSWER_SECONDS = 2.0
"""Seconds in which a relay must answer."""
MOST_LAG = 1e6
CPU_SECONDS = 1.0
"""Least seconds over which the load of the CPU is measured."""


class RelayLoad(msgspec.Struct, frozen=True):
    """The figures of one relay, by itself.

    :param draining: whether robots and clients are asked to use another relay
    :param robots: connected to it
    :param clients: whose sessions are there; those of forwarded clients are at the robot's relay
    :param forwarded: websockets that it forwards to other relays
    :param cpu: share of one core, averaged since the question before; 1 is one core
    :param lag_s: age of the newest change of rights and users that it has not read yet, at most
    """

    draining: bool
    robots: int
    clients: int
    forwarded: int
    cpu: float
    lag_s: float


class RelayStatus(msgspec.Struct, frozen=True):
    """One relay of a cluster.

    :param id: new in each run of the relay
    :param address: at which the other relays reach it
    :param version: of the software
    :param protocol: version of what relays say to each other
    :param uptime_s: seconds since its start
    :param own: whether it is the relay that answers
    :param state: `incompatible`: the relay that answers can't work with it; `silent`: it has not answered in time
    :param homes: robots whose home it is, by the relay that answers
    :param load: its figures, if it has answered
    """

    id: str
    address: str
    version: str
    protocol: int
    uptime_s: float
    own: bool
    state: Literal["ready", "draining", "incompatible", "silent"]
    homes: int
    load: RelayLoad | None = None


class ClusterState(msgspec.Struct, frozen=True):
    """The relays of a cluster.

    :param bus: whether the relay that answers is connected to the bus; if not, the others are as it last saw them
    """

    bus: bool
    relays: list[RelayStatus]


class LoadMeter:
    """Measures this relay.

    :param robots: number of robots connected here
    :param clients: number of sessions here
    :param forwarded: number of websockets that are forwarded
    :param lag: seconds since changes were read
    """

    def __init__(
        self,
        drain: Drain,
        robots: Callable[[], int],
        clients: Callable[[], int],
        forwarded: Callable[[], int],
        lag: Callable[[], float],
    ) -> None:
        self._drain = drain
        self._robots = robots
        self._clients = clients
        self._forwarded = forwarded
        self._lag = lag
        self._measured = time.monotonic(), time.process_time()
        self._cpu = 0.0

    def measure(self) -> RelayLoad:
        """The figures now."""
        return RelayLoad(
            draining=self._drain.begun,
            robots=self._robots(),
            clients=self._clients(),
            forwarded=self._forwarded(),
            cpu=round(self._cpu_share(), 3),
            lag_s=round(min(self._lag(), MOST_LAG), 3),
        )

    def _cpu_share(self) -> float:
        now, used = time.monotonic(), time.process_time()
        seconds = now - self._measured[0]
        if seconds >= CPU_SECONDS:
            self._cpu = (used - self._measured[1]) / seconds
            self._measured = now, used
        return self._cpu


class ClusterStatus(Collector):
    """The state of all relays, for people and for Prometheus.

    :param own: id of this relay
    """

    def __init__(
        self, bus: ClusterBus, relays: RelayDirectory, homes: ClusterHomes, meter: LoadMeter, own: str
    ) -> None:
        self._bus = bus
        self._relays = relays
        self._homes = homes
        self._meter = meter
        self._own = own
        self._unsubscribe: Callable[[], None] = _nothing
        self._shown: list[RelayStatus] = []

    def start(self) -> None:
        """Answer the other relays."""
        self._unsubscribe = self._bus.subscribe(_subject(self._own), self._answer)

    def stop(self) -> None:
        """Answer no longer."""
        self._unsubscribe()

    async def read(self) -> ClusterState:
        """The state of all relays; those that do not answer are among them."""
        relays = sorted(self._relays, key=lambda each: each.started)
        requests = [Deferred.fromCoroutine(self._status(each)) for each in relays]
        return ClusterState(self._bus.connected, await gatherResults(requests))

    async def _status(self, relay: RelayInfo) -> RelayStatus:
        load = await self._load(relay)
        state: Literal["ready", "draining", "incompatible", "silent"] = "ready"
        if not relay.compatible:
            state = "incompatible"
        elif load is None:
            state = "silent"
        elif load.draining:
            state = "draining"
        return RelayStatus(
            id=relay.id,
            address=relay.address,
            version=relay.version,
            protocol=relay.protocol,
            uptime_s=round(max(0.0, time.time() - relay.started), 1),
            own=relay.id == self._own,
            state=state,
            homes=self._homes.count(relay.id),
            load=load,
        )

    async def _load(self, relay: RelayInfo) -> RelayLoad | None:
        if relay.id == self._own:
            return self._meter.measure()
        try:
            answer = await self._bus.request(_subject(relay.id), b"", ANSWER_SECONDS)
            return msgspec.json.decode(answer, type=RelayLoad)
        except (SwitchboardError, msgspec.DecodeError):
            return None

    def _answer(self, subject: str, body: bytes) -> bytes:
        return msgspec.json.encode(self._meter.measure())

    async def refresh(self) -> None:
        """Read the state that :meth:`collect` shows."""
        self._shown = (await self.read()).relays

    def collect(self) -> Iterator[Metric]:
        """See ``Collector``. Each relay shows all, since a load balancer or several workers may choose any of them."""
        relays = len(list(self._relays))
        yield GaugeMetricFamily(
            "switchboard_cluster_relays", "Live relays of the cluster, this one included", relays
        )
        connected = int(self._bus.connected)
        yield GaugeMetricFamily(
            "switchboard_cluster_bus_connected", "Whether the bus is connected", connected
        )
        answers = GaugeMetricFamily(
            "switchboard_cluster_answers", "Whether the relay has answered", labels=["relay"]
        )
        for relay in self._shown:
            answers.add_metric([relay.address], int(relay.load is not None))
        yield answers
        for name, text, figure in _FIGURES:
            family = GaugeMetricFamily(name, text, labels=["relay"])
            for relay in self._shown:
                if relay.load is not None:
                    family.add_metric([relay.address], figure(relay.load))
            yield family


_FIGURES: tuple[tuple[str, str, Callable[[RelayLoad], float]], ...] = (
    ("switchboard_cluster_robots", "Robots connected to the relay", lambda load: load.robots),
    ("switchboard_cluster_clients", "Clients that work with its robots", lambda load: load.clients),
    (
        "switchboard_cluster_forwarded_websockets",
        "Websockets that it forwards to other relays",
        lambda load: load.forwarded,
    ),
    ("switchboard_cluster_cpu_share", "Share of one core that it uses", lambda load: load.cpu),
    ("switchboard_cluster_draining", "Whether it is drained", lambda load: load.draining),
    (
        "switchboard_cluster_lag_seconds",
        "Seconds since it read changes of rights and users",
        lambda load: load.lag_s,
    ),
)
"""Metrics of each relay: name, description, and value."""


def _subject(relay: str) -> str:
    return f"relays.{relay}.load"


def _nothing() -> None:
    """Nothing is subscribed yet."""
