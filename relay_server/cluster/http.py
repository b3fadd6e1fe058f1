"""``/api/v1/cluster``: the relays that serve the same robots."""

from __future__ import annotations

from relay_protocol.errors import Refused
from relay_protocol.realms import DEFAULT_REALM
from relay_server.cluster.admin import ClusterAdmin
from relay_server.cluster.status import ClusterState
from relay_server.http.endpoint import ApiRequest, endpoint


class ClusterEndpoints:
    """The relays of the cluster."""

    def __init__(self, admin: ClusterAdmin) -> None:
        self._admin = admin

    @endpoint(
        "GET",
        "/api/v1/cluster",
        tag="relay",
        summary="The relays of the cluster, and how loaded each is",
        more="For administrators of the default realm. A relay that is the only one answers 404.",
        returns="relays",
        errors=(404,),
    )
    async def cluster(self, request: ApiRequest) -> ClusterState:
        principal = request.principal
        if not principal.admin or principal.realm != DEFAULT_REALM:
            raise Refused(f"the cluster is for administrators of the realm '{DEFAULT_REALM}'")
        return await self._admin.status()
