"""Where a robot's resources are (SPEC section 1.13)."""

from __future__ import annotations

from typing import NamedTuple
from urllib.parse import quote


class ResourceLocation(NamedTuple):
    """Where a robot's resources are.

    :param base: ``scheme://host[:port]`` of the relay, as who asks sees it
    :param robot: its name
    """

    base: str
    robot: str

    @property
    def address(self) -> str:
        """The robot's."""
        return f"{self.base}/api/v1/robots/{quote(self.robot)}"

    def of(self, part: str, name: str = "") -> str:
        """The address of a collection, or of one of its members."""
        return f"{self.address}/{part}" + (f"/{quote(name.lstrip('/'))}" if name else "")
