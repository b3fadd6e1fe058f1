"""Robots as resources: those that somebody has a right on, and what each is (SPEC section 1.13)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from relay_protocol import jsontext
from relay_protocol.errors import NotFound
from relay_server.access import NO_ROBOT, Principal
from relay_server.resources.etags import tag_of
from relay_server.resources.page import PageQuery

FLEETING = frozenset({"rtt_ms", "last_seen"})
"""What is another with every ping: by that alone a robot is no other."""


class RobotSource(Protocol):
    """Knows all robots; the front desk."""

    async def robots(self, principal: Principal) -> list[dict[str, Any]]:
        """What the principal may see of its robots."""


class RobotService:
    """See the module's text."""

    def __init__(self, overview: RobotSource) -> None:
        self._overview = overview

    async def members(self, principal: Principal, listing: PageQuery) -> dict[str, Any]:
        """A page of the robots on which somebody has a right."""
        there = {each["name"]: each for each in await self._overview.robots(principal)}
        page, after = listing.page(there, lambda each: ())
        return {"robots": [each for _, each in page], "next": after}

    async def robot(self, principal: Principal, name: str) -> dict[str, Any]:
        """One of them.

        :raises NotFound: no such robot, or no right on it
        """
        for each in await self._overview.robots(principal):
            if each["name"] == name:
                return each
        raise NotFound(NO_ROBOT)


def robot_tag(robot: Mapping[str, Any]) -> str:
    """The entity tag of a robot, of its JSON: the same as long as it is but for :data:`FLEETING`, so a weak one."""
    return tag_of(jsontext.encode(_lasting(robot)))


def robots_tag(page: Mapping[str, Any]) -> str:
    """The same of a page."""
    return tag_of(jsontext.encode({**page, "robots": [_lasting(each) for each in page["robots"]]}))


def _lasting(robot: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in robot.items() if name not in FLEETING}
