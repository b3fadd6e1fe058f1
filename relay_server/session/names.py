"""Names of types as clients write them."""

from __future__ import annotations

from relay_protocol.ros.definition import normalise


def normal_type(name: str | None, kind: str = "msg") -> str:
    """ROS 1 habit ``pkg/Name`` becomes ``pkg/msg/Name`` (or ``srv``, ``action``); empty stays empty.

    :raises Invalid: no type name
    """
    if not name:
        return ""
    package, slash, rest = name.partition("/")
    return normalise(f"{package}/{kind}/{rest}" if slash and "/" not in rest else name)
