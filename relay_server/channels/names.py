"""Names of topics, services, actions and types, as clients write them."""

from __future__ import annotations

import re

from relay_protocol import limits
from relay_protocol.errors import Invalid
from relay_protocol.ros.definition import normalise

_NAME = re.compile(r"/[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*\Z")
_WORDS = {"msg": "message", "srv": "service", "action": "action"}


def resolve(name: str) -> str:
    """The full name of a topic or service that a client wrote with or without its leading slash.

    :raises Invalid: it is no ROS 2 name (design.ros2.org, topic and service names)
    """
    full = name if name.startswith("/") else "/" + name
    if len(full) > limits.NAME or not _NAME.match(full):
        raise Invalid(
            f"'{name[:80]}' is no ROS name: letters, digits and '_' between slashes, "
            f"no part beginning with a digit, at most {limits.NAME} characters"
        )
    return full


def normal_type(name: str | None, kind: str = "msg") -> str:
    """The full name of a type: ``pkg/Name`` (as in ROS 1) becomes ``pkg/msg/Name``; empty stays empty.

    :param kind: ``msg``, ``srv`` or ``action``. The parts of services and actions, such as
        ``pkg/action/X_FeedbackMessage``, are accepted for each kind
    :raises Invalid: it is no type name, or a type of another kind
    """
    if not name:
        return ""
    package, slash, rest = name.partition("/")
    full = normalise(f"{package}/{kind}/{rest}" if slash and "/" not in rest else name)
    has, short = full.split("/")[1:]
    if has != kind and "_" not in short:
        raise Invalid(f"{full} is no {_WORDS[kind]} type")
    return full
