"""The relays of a cluster: each holds a lease under its id, with its address and what it serves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import msgspec
from twisted.internet.defer import Deferred
from twisted.internet.task import LoopingCall
from twisted.logger import Logger

from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server import VERSION
from relay_server.cluster.bus import BusLease, ClusterBus, LeaseUnavailable

LEASES = "relays"
READ_SECONDS = 2.0
"""Seconds between reads of all leases."""
CONFIRMING_PROTOCOL = 2
"""Version from which a relay repeats the number of a ping, and Foxglove's stop has a fixed number."""
CLUSTER_PROTOCOL = 2
"""Version of what relays say to each other: notices, questions, headers of forwarded requests. A change that relays of
the version before can't work with raises it; :data:`OLDEST_PROTOCOL` follows one release later."""
OLDEST_PROTOCOL = 1
"""Lowest version that this relay can work with, so that relays can be upgraded one after another."""


class RelayInfo(msgspec.Struct, frozen=True):
    """One relay of a cluster.

    :param id: new in each run of the relay
    :param host: the address at which the other relays reach it
    :param port: TCP port of its cluster listener
    :param version: of the software
    :param started: Unix seconds
    :param protocol: version of what relays say to each other
    :param oldest: lowest version of it that this relay can work with
    :param group: see :class:`relay_server.config.ClusterSettings`
    """

    id: str
    host: str
    port: int
    version: str
    started: float
    protocol: int = 1
    oldest: int = 1
    group: str = ""

    @property
    def compatible(self) -> bool:
        """Whether this relay and that one can work together."""
        return self.protocol >= OLDEST_PROTOCOL and self.oldest <= CLUSTER_PROTOCOL

    @property
    def address(self) -> str:
        """``host:port``, with an IPv6 address in brackets."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


class RelayDirectory:
    """All live relays of the cluster. While the bus does not answer, those of before are assumed to live.

    :param own: makes the entry of this relay, when its port is known
    :ivar on_change: called after relays have come or gone
    """

    log = Logger()

    def __init__(self, reactor: Any, bus: ClusterBus, own: Callable[[], RelayInfo]) -> None:
        self.on_change: Callable[[], object] = lambda: None
        self._bus = bus
        self._own = own
        self._lease: BusLease | None = None
        self._relays: dict[str, RelayInfo] = {}
        self._loop = LoopingCall(self._update)
        self._loop.clock = reactor

    async def start(self) -> None:
        """Acquire the lease of this relay, and read those of the others."""
        await self.refresh()
        self._loop.start(READ_SECONDS, now=False)

    async def stop(self) -> None:
        """Release the lease, so that the others know at once."""
        if self._loop.running:
            self._loop.stop()
        lease, self._lease = self._lease, None
        if lease is not None:
            await lease.release()

    def __iter__(self) -> Iterator[RelayInfo]:
        return iter(list(self._relays.values()))

    def find(self, relay: str) -> RelayInfo | None:
        """The live relay of an id."""
        return self._relays.get(relay)

    async def refresh(self, *, acquire: bool = True) -> None:
        """Acquire the lease if this relay has none, and read all leases.

        :param acquire: false only to read
        """
        try:
            if acquire and self._lease is None:
                await self._acquire()
            leases = await self._bus.leases(LEASES)
        except SwitchboardError as error:
            self.log.info("the relays of the cluster can't be read: {error}", error=error, limited="relays")
            return
        relays = {}
        for value in leases.values():
            try:
                relay = msgspec.json.decode(value, type=RelayInfo)
            except msgspec.DecodeError as error:
                self.log.error("the lease of a relay can't be read: {error}", error=error, limited="lease")
                continue
            relays[relay.id] = relay
        if relays != self._relays:
            self._relays = relays
            self.on_change()

    async def _acquire(self) -> None:
        own = self._own()
        try:
            lease = await self._bus.lease(f"{LEASES}.{own.id}", msgspec.json.encode(own))
        except LeaseUnavailable:
            # It was lost while the bus was away, and ends by itself.
            return
        lease.on_lost = self._lost
        self._lease = lease

    def _lost(self) -> None:
        self._lease = None

    def _update(self) -> Deferred[None]:
        return Deferred.fromCoroutine(self.refresh()).addErrback(
            lambda failure: self.log.failure("reading the relays of the cluster failed", failure)
        )


def check_compatible(relay: RelayInfo) -> None:
    """:raises Unavailable: that relay and this one can't work together"""
    if not relay.compatible:
        raise Unavailable(
            f"the relay at {relay.address} ({relay.version}) speaks version {relay.protocol} of the cluster's "
            f"protocol, which this one ({VERSION}) can't work with; it takes {OLDEST_PROTOCOL} to {CLUSTER_PROTOCOL}. "
            "Upgrade relays one version at a time"
        )


def lost(relay: RelayInfo) -> Unavailable:
    """The error for a connection that ended before the answer."""
    return Unavailable(
        f"the connection to the relay that the robot is connected to was lost ({relay.address}); the request "
        "may have been carried out"
    )


def unreachable(relay: RelayInfo) -> Unavailable:
    """The error for a relay that does not answer."""
    return Unavailable(f"the relay that the robot is connected to does not answer ({relay.address})")
