"""What is to be known of a topic beside what is said there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from relay_protocol.errors import SwitchboardError
from relay_protocol.ros.definition import Definition
from relay_server.http_sessions.one_shot_publisher import may_move
from relay_server.relay_node.types import known
from relay_server.sessions.session import Session


class TopicContext(NamedTuple):
    """Of one topic.

    :param definitions: of its type and what that contains, by their full names; none where the robot does not tell them
    :param moves: whether what is said there moves the robot
    """

    definitions: Mapping[str, Definition]
    moves: bool


async def topic_context(session: Session, topic: str, type_name: str) -> TopicContext:
    """Of a topic that the caller hears.

    :param type_name: in full
    """
    moves = may_move(session, topic, type_name)
    try:
        return TopicContext((await known(session, type_name)).definitions(type_name), moves)
    except SwitchboardError:
        # Robots without ROS have no definitions: their values say what they are.
        return TopicContext({}, moves)
