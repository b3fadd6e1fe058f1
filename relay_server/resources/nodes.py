"""A robot's modules as resources: the nodes in its graph, and what each does there (SPEC section 1.13).

They are what rosapi's ``nodes`` and ``node_details`` show to the same asker, made of the same view.
"""

from __future__ import annotations

from typing import Any

from relay_protocol.errors import NotFound
from relay_server.http_sessions.pool import SessionPool
from relay_server.relay_node.arguments import absolute
from relay_server.relay_node.view import VisibleGraph, node_details_of, view
from relay_server.resources.page import PageQuery
from relay_server.resources.service import RequestOrigin, see_online

NO_MODULE = "the robot has no node of this name"


class NodeService:
    """See the module's text.

    :param guests: connections of those who ask
    """

    def __init__(self, guests: SessionPool) -> None:
        self._guests = guests

    async def members(self, asker: RequestOrigin, listing: PageQuery) -> dict[str, Any]:
        """A page of the nodes; they have no types.

        :raises NotFound: no such robot, or no right on it
        """
        async with self._guests.at(*asker) as guest:
            seen = view(guest.session)
            page, after = listing.page(dict.fromkeys(seen.nodes), lambda each: ())
            return {
                "modules": _told([name for name, _ in page], seen),
                "next": after,
                "online": guest.session.robot.control is not None,
            }

    async def module(self, asker: RequestOrigin, name: str) -> dict[str, Any]:
        """One of them.

        :param name: with or without its first slash
        :raises NotFound: no such robot or node, or no right on the robot
        :raises Unavailable: the robot is offline, so that nobody knows
        """
        async with self._guests.at(*asker) as guest:
            seen, node = view(guest.session), absolute(name)
            if node not in seen.nodes:
                see_online(guest.session)
                raise NotFound(NO_MODULE)
            return _told([node], seen)[0]


def _told(nodes: list[str], seen: VisibleGraph) -> list[dict[str, Any]]:
    return [{"name": node, **work._asdict()} for node, work in node_details_of(nodes, seen).items()]
