"""The states of topics and parameters, and what their representations need: names, types and locations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple
from urllib.parse import quote

from relay_protocol import jsontext
from relay_protocol.errors import SwitchboardError
from relay_protocol.ros.definition import Definition
from relay_server.common.etags import tag_of
from relay_server.in_process_sessions.one_shot_publisher import may_move
from relay_server.relay_node.rosapi import known
from relay_server.sessions.context import ClientContext


class TopicState(NamedTuple):
    """The newest message of a topic.

    A repeated message is the same state: a map that is published again for each subscriber is not sent again to a
    client that has it. Its time differs, so the entity tag is a weak one (RFC 9110 section 8.8.1).

    :param at: Unix seconds at which the relay received it
    :param value: JSON
    """

    topic: str
    type: str
    at: float
    value: bytes

    @property
    def etag(self) -> str:
        """The same for the same value."""
        return tag_of(self.value)

    def json(self) -> bytes:
        """As JSON."""
        return _with_value({"topic": self.topic, "type": self.type, "at": round(self.at, 3)}, self.value)


class ParamState(NamedTuple):
    """A parameter.

    :param name: ``<node>:<parameter>``
    :param value: JSON
    """

    name: str
    value: bytes

    @property
    def etag(self) -> str:
        """The same for the same value."""
        return tag_of(self.value)

    def json(self) -> bytes:
        """As JSON."""
        return _with_value({"name": self.name}, self.value)


def _with_value(head: dict[str, object], value: bytes) -> bytes:
    return jsontext.encode(head)[:-1] + b',"value":' + value + b"}"


class ResourceLocation(NamedTuple):
    """The addresses of a robot's resources.

    :param base: ``scheme://host[:port]`` of the relay, as the client sees it
    :param robot: name of the robot
    """

    base: str
    robot: str

    @property
    def address(self) -> str:
        """The robot's own address."""
        return f"{self.base}/api/v1/robots/{quote(self.robot)}"

    def of(self, part: str, name: str = "") -> str:
        """The address of a collection, or of one of its members."""
        return f"{self.address}/{part}" + (f"/{quote(name.lstrip('/'))}" if name else "")


class TopicContext(NamedTuple):
    """Facts about one topic.

    :param definitions: of its type and of the types in it, by their full names; empty if the robot has none
    :param moves: whether messages on the topic move the robot
    """

    definitions: Mapping[str, Definition]
    moves: bool


async def topic_context(client: ClientContext, topic: str, type_name: str) -> TopicContext:
    """The facts about a topic that the client is subscribed to.

    :param type_name: the full name
    """
    moves = may_move(client, topic, type_name)
    try:
        return TopicContext((await known(client, type_name)).definitions(type_name), moves)
    except SwitchboardError:
        # Robots without ROS have no definitions. Their values are written by their JSON types.
        return TopicContext({}, moves)
