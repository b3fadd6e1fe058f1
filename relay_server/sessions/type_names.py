"""Names of types as clients write them."""

from __future__ import annotations

from relay_protocol.errors import Invalid
from relay_protocol.ros.definition import normalise

_WORDS = {"msg": "message", "srv": "service", "action": "action"}


def normal_type(name: str | None, kind: str = "msg") -> str:
    """ROS 1 habit ``pkg/Name`` becomes ``pkg/msg/Name`` (or ``srv``, ``action``); empty stays empty.

    :param kind: what is wanted; the messages and services that a service or an action is made of
        (``pkg/action/X_FeedbackMessage``) pass for their own kind
    :raises Invalid: no type name, or of another kind
    """
    if not name:
        return ""
    package, slash, rest = name.partition("/")
    full = normalise(f"{package}/{kind}/{rest}" if slash and "/" not in rest else name)
    has, short = full.split("/")[1:]
    if has != kind and "_" not in short:
        raise Invalid(f"{full} is no {_WORDS[kind]} type")
    return full
