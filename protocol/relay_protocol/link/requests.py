"""What the relay asks for on a channel link."""

from __future__ import annotations

import msgspec

from relay_protocol.link.common import BothChannel
from relay_protocol.message import Message


class QoS(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """ROS 2 quality of service as a client may ask for it (``qos``); ``None`` leaves it to the robot."""

    history: str | None = None
    depth: int | None = None
    reliability: str | None = None
    durability: str | None = None
    deadline: float | None = None
    lifespan: float | None = None


class Subscribe(Message, frozen=True, kw_only=True):
    """Relay: send me this topic, as samples of this number. With a known number: change ``throttle_ms``.

    :param type: the type, where the asker knows it; else the robot takes the topic's one type from its graph
    :param throttle_ms: least time between two samples, milliseconds; 0 for all
    :param kept: with a known number: repeat the samples that publishers keep, those with these stamps without body
    """

    number: int
    topic: str
    type: str = ""
    throttle_ms: int = 0
    qos: QoS | None = None
    kept: list[int] | None = None


class Unsubscribe(Message, frozen=True, kw_only=True):
    number: int


class Advertise(Message, frozen=True, kw_only=True):
    """Relay: samples of this number are to be published on this topic.

    :param source: who publishes, for the robot's own log
    """

    number: int
    topic: str
    type: str
    latch: bool = False
    queue_size: int = 0
    qos: QoS | None = None
    source: str = ""


class Unadvertise(Message, frozen=True, kw_only=True):
    number: int


class AdvertiseService(Message, frozen=True, kw_only=True):
    """Relay: offer this service to the graph; calls of it come back as ``call_service``.

    :param source: who offers it, for the robot's own log
    """

    service: str
    type: str
    source: str = ""


class UnadvertiseService(Message, frozen=True, kw_only=True):
    """Relay: nobody offers it any more. Calls under way end without an answer."""

    service: str


class AdvertiseAction(Message, frozen=True, kw_only=True):
    """Relay: offer this action to the graph; goals come back as ``send_action_goal``. ``source`` as above."""

    action: str
    type: str
    source: str = ""


class UnadvertiseAction(Message, frozen=True, kw_only=True):
    """Relay: nobody offers it any more. Goals under way are aborted."""

    action: str


class GetType(Message, frozen=True, kw_only=True):
    """Relay: send the definition of a type, say ``sensor_msgs/msg/Joy`` or ``std_srvs/srv/Trigger``."""

    type: str


class GetInterfaces(Message, frozen=True, kw_only=True):
    """Relay: send the names of all types the robot could tell the definition of."""


RelayChannel = (
    Subscribe
    | Unsubscribe
    | Advertise
    | Unadvertise
    | AdvertiseService
    | UnadvertiseService
    | AdvertiseAction
    | UnadvertiseAction
    | GetType
    | GetInterfaces
    | BothChannel
)
