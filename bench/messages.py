"""Texts of message types, and messages as robots send them."""

from __future__ import annotations

from robot_client.platforms.definitions import full_text, installed, prefixes

STRING = "std_msgs/msg/String"
TWIST = "geometry_msgs/msg/Twist"


def text_of(*types: str) -> dict[str, str]:
    """The definitions of types, as a robot sends them."""
    where = prefixes()
    return {name: full_text(name, lambda each: installed(each, where)) for name in types}
