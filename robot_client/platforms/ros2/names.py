"""Names and types of topics, services and actions, as clients say them and as ROS 2 has them."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from relay_protocol.errors import Invalid, NotFound
from robot_client.platforms.definitions import normalise
from robot_client.platforms.ros2.errors import in_words
from robot_client.platforms.ros2.graph import GOAL, GOAL_TYPE


def check_name(resolve: Callable[[str], str], name: str, what: str) -> str:
    """See that rclpy takes a name; the full name it stands for.

    :param what: ``topic``, ``service`` or ``action``, for the error
    :raises Invalid: it does not
    """
    try:
        return resolve(name)
    except Exception as error:
        reason = in_words(error).splitlines()[0].rstrip(".:")
        raise Invalid(f"'{name}' is no {what} name: {reason}") from None


def topic_type(topic: str, asked: str, types: list[str]) -> str:
    """The type to use for a topic, which need not exist yet if its type is said.

    :param asked: what the client says, may be empty
    :param types: types the topic has in the graph
    :raises NotFound: no type was said, and the graph has none
    :raises Invalid: the graph has another, or several
    """
    if asked and not types:
        return normalise(asked)
    if not types:
        raise NotFound(f"there is no topic {topic} on this robot; name its type to wait for it")
    return _one_of(types, asked, f"topic {topic}", "msg")


def service_type(service: str, asked: str, known: Iterable[tuple[str, list[str]]]) -> str:
    """The type to use for a service, which must exist; see :func:`topic_type`."""
    types = next((types for each, types in known if each == service), [])
    if not types:
        raise NotFound(f"there is no service {service} on this robot")
    return _one_of(types, asked, f"service {service}", "srv")


def action_type(action: str, asked: str, known: Iterable[tuple[str, list[str]]]) -> str:
    """The type to use for an action, which may not be seen yet if its type is said; see :func:`topic_type`."""
    types = sorted(
        type[: -len(GOAL_TYPE)]
        for name, types in known
        if name == action + GOAL
        for type in types
        if type.endswith(GOAL_TYPE)
    )
    if asked and not types:
        return normalise(asked, "action")
    if not types:
        raise NotFound(f"there is no action {action} on this robot")
    return _one_of(types, asked, f"action {action}", "action")


def _one_of(types: list[str], asked: str, what: str, kind: str) -> str:
    if not asked:
        if len(types) > 1:
            raise Invalid(f"the {what} has several types ({', '.join(types)}); name one")
        return types[0]
    full = normalise(asked, kind)
    if full not in types:
        raise Invalid(f"the {what} is of type {', '.join(types)} on this robot, not {asked}")
    return full
