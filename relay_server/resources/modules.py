"""A robot's modules as resources: the nodes in its graph, and what each does there (SPEC section 1.13).

They are what rosapi's ``nodes`` and ``node_details`` show to the same asker, made of the same view.
"""

from __future__ import annotations

from typing import Any

from relay_protocol.errors import NotFound
from relay_server.inside import Guests
from relay_server.local.arguments import absolute
from relay_server.local.view import View, view, work_of
from relay_server.resources.desk import Asker, see_online
from relay_server.resources.listing import Listing

NO_MODULE = "the robot has no node of this name"


class ModuleDesk:
    """See the module's text.

    :param guests: connections of those who ask
    """

    def __init__(self, guests: Guests) -> None:
        self._guests = guests

    async def members(self, asker: Asker, listing: Listing) -> dict[str, Any]:
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

    async def module(self, asker: Asker, name: str) -> dict[str, Any]:
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


def _told(nodes: list[str], seen: View) -> list[dict[str, Any]]:
    return [{"name": node, **work._asdict()} for node, work in work_of(nodes, seen).items()]
