"""A robot's cameras as resources: what is known of each, and where its pictures are (SPEC sections 1.8 and 1.13)."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any
from urllib.parse import quote

from relay_protocol.errors import NotFound
from relay_server.access import Principal
from relay_server.channels.robot_link import resolve
from relay_server.resources.page import PageQuery
from relay_server.resources.service import RequestOrigin
from relay_server.video.ports import NO_CAMERA

Look = Callable[[Principal, str], Awaitable[list[dict[str, Any]]]]
"""Tells what a principal may know of the cameras of a robot; the front desk's."""

_ADDRESSES = {"snapshot": "snapshot", "stream": "stream", "viewer": "stream_viewer", "websocket": "ws"}
"""What a camera's pictures are had as, and the end of the address of that."""


class CameraService:
    """See the module's text.

    :param look: tells which there are
    """

    def __init__(self, look: Look) -> None:
        self._look = look

    async def members(self, asker: RequestOrigin, listing: PageQuery) -> dict[str, Any]:
        """A page of the cameras that the asker may view.

        :raises NotFound: no such robot, or no right on it
        """
        there = {each["name"]: each for each in await self._look(asker.principal, asker.robot)}
        page, after = listing.page(there, lambda each: [each["type"]])
        return {"cameras": [each for _, each in page], "next": after}

    async def camera(self, asker: RequestOrigin, name: str) -> dict[str, Any]:
        """One of them, with the addresses of its pictures.

        :raises NotFound: no such robot or camera, or no right to view it: said alike
        """
        camera = resolve(name)
        for each in await self._look(asker.principal, asker.robot):
            if each["name"] == camera:
                return {**each, "addresses": addresses(asker.robot, camera)}
        raise NotFound(NO_CAMERA)


def addresses(robot: str, camera: str) -> dict[str, str]:
    """Where the pictures of a camera are, as paths on the relay."""
    place, topic = f"/robots/{quote(robot, safe='')}/video", quote(camera, safe="")
    return {what: f"{place}/{end}?topic={topic}" for what, end in _ADDRESSES.items()}
