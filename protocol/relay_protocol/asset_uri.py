"""URIs of assets, such as ``package://turtlebot/meshes/base%20link.stl``. Relay and robot read them alike."""

from __future__ import annotations

import re
from typing import NamedTuple
from urllib.parse import unquote

from relay_protocol import limits
from relay_protocol.errors import Invalid, Refused

_URI = re.compile(r"package://([A-Za-z][A-Za-z0-9_-]*)/(.+)\Z", re.DOTALL)


class AssetName(NamedTuple):
    """What a URI names; the same for each spelling of it.

    :ivar path: below the package's share folder, unquoted
    """

    package: str
    path: str


def parse(uri: str) -> AssetName:
    """The package and the path of a URI. Percent signs are decoded in the path only.

    :raises Invalid: it is no such URI
    :raises Refused: the path does not lead downwards
    """
    found = _URI.match(uri)
    if found is None or len(uri) > limits.ASSET_URI:
        raise Invalid(
            f"'{uri[:80]}' is no asset; write package://<package>/<path>, at most {limits.ASSET_URI} characters"
        )
    try:
        path = unquote(found[2], errors="strict")
    except UnicodeDecodeError:
        raise Invalid("the path is not UTF-8") from None
    if "\0" in path or "\\" in path or any(name in ("", ".", "..") for name in path.split("/")):
        raise Refused("the path must lead from the package's share folder downwards, without '.' and '..'")
    return AssetName(found[1], path)
