"""Names and types of topics, services and actions: from a client's spelling to the full ones of ROS 2."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from relay_protocol.errors import Invalid, NotFound
from relay_protocol.link.motion import SEND_GOAL
from robot_client.platforms.definitions import normalise
from robot_client.platforms.ros2.errors import error_text
from robot_client.platforms.ros2.graph import GOAL_TYPE


def check_name(resolve: Callable[[str], str], name: str, kind: str) -> str:
    """The full name after remapping.

    :param kind: ``topic``, ``service`` or ``action``, for the error
    :raises Invalid: it is not a valid name
    """
    try:
        return resolve(name)
    except Exception as error:
        reason = error_text(error).splitlines()[0].rstrip(".:")
        raise Invalid(f"'{name}' is not a valid {kind} name: {reason}") from None


def topic_type(topic: str, requested: str, types: list[str]) -> str:
    """The type to use for a topic, which need not exist yet if its type is given.

    :param requested: by the client, may be empty
    :param types: types the topic has in the graph
    :raises NotFound: no type was given, and the graph has none
    :raises Invalid: the graph has another type, or several
    """
    if requested and not types:
        return normalise(requested)
    if not types:
        raise NotFound(f"there is no topic {topic} on this robot; give its type to wait for it")
    return _one_of(types, requested, f"topic {topic}", "msg")


def service_type(service: str, requested: str, known: Iterable[tuple[str, list[str]]]) -> str:
    """The type to use for a service, which must exist; see :func:`topic_type`."""
    types = next((types for each, types in known if each == service), [])
    if not types:
        raise NotFound(f"there is no service {service} on this robot")
    return _one_of(types, requested, f"service {service}", "srv")


def action_type(action: str, requested: str, known: Iterable[tuple[str, list[str]]]) -> str:
    """The type to use for an action, which need not exist yet if its type is given; see
    :func:`topic_type`."""
    types = sorted(
        type[: -len(GOAL_TYPE)]
        for name, types in known
        if name == action + SEND_GOAL
        for type in types
        if type.endswith(GOAL_TYPE)
    )
    if requested and not types:
        return normalise(requested, "action")
    if not types:
        raise NotFound(f"there is no action {action} on this robot")
    return _one_of(types, requested, f"action {action}", "action")


def _one_of(types: list[str], requested: str, what: str, kind: str) -> str:
    if not requested:
        if len(types) > 1:
            raise Invalid(f"the {what} has several types ({', '.join(types)}); give one")
        return types[0]
    full = normalise(requested, kind)
    if full not in types:
        raise Invalid(f"the {what} is of type {', '.join(types)} on this robot, not {requested}")
    return full
