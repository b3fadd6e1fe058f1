"""What the robot answers on a channel link."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from relay_protocol import limits
from relay_protocol.link.common import BothChannel
from relay_protocol.link.fields import Few, Label, Name, cut
from relay_protocol.message import Message


class Numbered(Message, frozen=True, kw_only=True):
    """Base of answers about a topic: what its number stands for from now on.

    :param encoding: ``cdr`` (kind-1 frames), or ``json`` (kind-1 frames with a JSON body)
    :param unmatched: nodes that are not heard, or do not hear, because of their quality of service, with the reason
    """

    number: int
    topic: Name
    type: Name
    encoding: Label
    unmatched: Few = msgspec.field(default_factory=list)


class Subscribed(Numbered, frozen=True, kw_only=True):
    """Robot: samples will come.

    :param latched: publishers keep their last messages for late joiners (transient local)
    :param publishers: how many publish now
    :param replays: names the memory of stamps of a robot that can repeat what publishers keep; empty when it can't.
        While it is the same, also on another link, a stamp means the same sample
    """

    latched: bool = False
    publishers: int = 0
    replays: Label = ""


class Advertised(Numbered, frozen=True, kw_only=True):
    """Robot: the publisher stands.

    :param motion: the robot's safety counts this topic as motion
    """

    motion: bool = False


class Failed(Message, frozen=True, kw_only=True):
    """Robot: a request could not be done. ``what`` is its ``op``, ``ref`` its number, id or type."""

    what: Label
    ref: str
    reason: str

    def __post_init__(self) -> None:
        cut(self, "reason", "ref")


class Lost(Message, frozen=True, kw_only=True):
    """Robot: samples of a subscription were not sent, since it last said so.

    :param reason: ``too_large``, or ``slow_link`` when newer ones took their place
    :param count: how many
    :param size: bytes of the largest
    """

    number: int
    reason: Label
    count: Annotated[int, Meta(ge=1)]
    size: Annotated[int, Meta(ge=0)] = 0


class AdvertisedService(Message, frozen=True, kw_only=True):
    """Robot: the service stands; ``type`` is the full name of its type."""

    service: Name
    type: Name


class AdvertisedAction(Message, frozen=True, kw_only=True):
    """Robot: the action stands; ``type`` is the full name of its type."""

    action: Name
    type: Name


class Interfaces(Message, frozen=True, kw_only=True):
    """Robot: the answer to ``get_interfaces``, full names in order."""

    types: Annotated[list[Name], Meta(max_length=limits.INTERFACES)]


class TypeDefinition(Message, frozen=True, kw_only=True):
    """Robot: the .msg or .srv text, then every type in it, each after a line of 80 ``=`` and ``MSG: name``.

    The layout is that of rosbag2's ``ros2msg``. For a service the main part has the request and the response
    divided by ``---``.

    :param hash: RIHS01 type hash where the distribution has one
    """

    type: Name
    text: Annotated[str, Meta(max_length=limits.TYPE_DEFINITION)]
    hash: Label = ""


RobotChannel = (
    Subscribed
    | Advertised
    | AdvertisedService
    | AdvertisedAction
    | Failed
    | Lost
    | TypeDefinition
    | Interfaces
    | BothChannel
)
