"""Requests of administrators about a relay's cluster."""

from __future__ import annotations

from typing import TYPE_CHECKING

from relay_protocol.errors import NotFound
from relay_protocol.realms import DEFAULT_REALM
from relay_server.access import Principal
from relay_server.cluster.drain import DrainState
from relay_server.cluster.forwarding import ForwardedClient
from relay_server.cluster.relays import RelayInfo
from relay_server.cluster.status import ClusterState

if TYPE_CHECKING:
    from relay_server.cluster.service import Cluster


FORWARDED_PATHS = frozenset({"/modules", "/pipes"})
"""Requests of a local socket that the home of their robot answers."""

LOCAL_PATH = "/local"
"""Above these paths, where a relay takes such requests from the others."""

LOCAL = ForwardedClient.of(Principal(0, "admin (local)", DEFAULT_REALM, True, 0, None), "local")
"""Stands for the command line on a relay's machine; its requests have the user of the operating system in the body."""


class ClusterAdmin:
    """
    :param cluster: ``None``: this is the only relay
    """

    def __init__(self, cluster: Cluster | None) -> None:
        self._cluster = cluster

    async def drain(self) -> DrainState:
        """Begin to drain this relay, and return how far it is.

        :raises NotFound: this is the only relay
        :raises Unavailable: there is no other relay that takes robots
        """
        cluster = self._member()
        await cluster.drain.begin()
        return cluster.drain.state

    async def status(self) -> ClusterState:
        """The state of all relays.

        :raises NotFound: this is the only relay
        """
        return await self._member().status.read()

    def relay_of(self, robot_id: int) -> RelayInfo | None:
        """The other relay that a robot is connected to; ``None``: it is connected here or to no live relay."""
        return None if self._cluster is None else self._cluster.homes.elsewhere(robot_id)

    async def forward(self, path: str, body: bytes, relay: RelayInfo) -> tuple[int, bytes]:
        """Have another relay answer a request of this one's local socket; returns status and body of the answer.

        :raises Unavailable: it can't be reached, or is of another version
        """
        return await self._member().forwarder.ask("POST", LOCAL_PATH + path, body, relay, LOCAL)

    async def forward_to_all(self, path: str, body: bytes) -> list[bytes]:
        """As :meth:`forward`, to all other relays; one that does not answer is left out."""
        if self._cluster is None:
            return []
        others = self._cluster.others()
        return await self._cluster.forwarder.ask_all("POST", LOCAL_PATH + path, body, others, LOCAL)

    def _member(self) -> Cluster:
        if self._cluster is None:
            raise NotFound("this relay is not one of a cluster: it was started without --cluster-bus")
        return self._cluster
