"""The channel link: requests of the relay and answers of the robot (SPEC 2.5)."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from relay_protocol import limits
from relay_protocol.link.common import CommonChannel
from relay_protocol.link.fields import Label, Name, NameList, cut
from relay_protocol.message import Message

# --- requests of the relay --------------------------------------------------------------------------------


class QoS(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """ROS 2 quality of service that a client asks for. ``None`` lets the robot choose.

    :param depth: messages
    :param deadline: seconds
    :param lifespan: seconds
    """

    history: str | None = None
    depth: int | None = None
    reliability: str | None = None
    durability: str | None = None
    deadline: float | None = None
    lifespan: float | None = None


class Thinning(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """Point clouds with fewer points. One of the two; neither: all points.

    :param stride: every n-th point
    :param voxel: one point of each cube with this side, in the unit of the cloud (metres)
    """

    stride: Annotated[int, Meta(ge=0, le=limits.STRIDE)] = 0
    voxel: Annotated[float, Meta(ge=0, le=limits.VOXEL)] = 0.0

    @property
    def thins(self) -> bool:
        """Whether it leaves any points out."""
        return self.stride > 1 or self.voxel > 0


class Subscribe(Message, frozen=True, kw_only=True):
    """Send this topic as samples with this number. A number that is in use changes ``throttle_ms`` and ``thin``.

    :param type: full name; when empty, the robot takes the topic's only type from its graph
    :param throttle_ms: least time between two samples, milliseconds; 0 for every sample
    :param known_stamps: with a number in use: send the latched samples again, those with these stamps without a body
    :param thin: of a topic with point clouds
    """

    number: int
    topic: str
    type: str = ""
    throttle_ms: int = 0
    qos: QoS | None = None
    known_stamps: list[int] | None = None
    thin: Thinning | None = None


class Unsubscribe(Message, frozen=True, kw_only=True):
    number: int


class Advertise(Message, frozen=True, kw_only=True):
    """Create a publisher. Samples with this number go to it.

    :param latch: the publisher is transient local
    :param queue_size: messages; 0 for the robot's default
    """

    number: int
    topic: str
    type: str
    latch: bool = False
    queue_size: int = 0
    qos: QoS | None = None


class Unadvertise(Message, frozen=True, kw_only=True):
    number: int


class AdvertiseService(Message, frozen=True, kw_only=True):
    """Create a service server in the graph. Its calls come to the relay as ``call_service``.

    :param user: the user that offers it, for the robot's log
    """

    service: str
    type: str
    user: str = ""


class UnadvertiseService(Message, frozen=True, kw_only=True):
    """Remove the service server. Pending calls end without an answer."""

    service: str


class AdvertiseAction(Message, frozen=True, kw_only=True):
    """Create an action server in the graph. Its goals come to the relay as ``send_action_goal``.

    :param user: the user that offers it, for the robot's log
    """

    action: str
    type: str
    user: str = ""


class UnadvertiseAction(Message, frozen=True, kw_only=True):
    """Remove the action server. Active goals are aborted."""

    action: str


class GetType(Message, frozen=True, kw_only=True):
    """Send the definition of a type, for example ``sensor_msgs/msg/Joy`` or ``std_srvs/srv/Trigger``."""

    type: str


class GetInterfaces(Message, frozen=True, kw_only=True):
    """Send the names of all types whose definition the robot has."""


class GetAsset(Message, frozen=True, kw_only=True):
    """Send a part of a file of a package, for example ``package://turtlebot/meshes/base.stl``.

    :param number: chosen by the relay; the answer has it
    :param offset: bytes of the file before the part
    """

    number: int
    uri: str
    offset: int = 0


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
    | GetAsset
    | CommonChannel
)

# --- answers of the robot ---------------------------------------------------------------------------------


class TopicAnswer(Message, frozen=True, kw_only=True):
    """Base of answers that say what a number stands for from now on.

    :param encoding: of the kind-1 frames: ``cdr`` or ``json``
    :param unmatched: nodes with incompatible quality of service, each as ``<node>: <reason>``
    """

    number: int
    topic: Name
    type: Name
    encoding: Label
    unmatched: NameList = msgspec.field(default_factory=list)


class Subscribed(TopicAnswer, frozen=True, kw_only=True):
    """The subscription exists; samples follow.

    :param latched: the publishers are transient local
    :param publishers: number of publishers now
    :param replays: id of the stamps a robot has given, when it can repeat latched samples; else empty.
        While the id is the same, also on another link, equal stamps mean equal samples
    """

    latched: bool = False
    publishers: int = 0
    replays: Label = ""


class Advertised(TopicAnswer, frozen=True, kw_only=True):
    """The publisher exists.

    :param motion: the robot treats this topic as a motion topic
    """

    motion: bool = False


class Failed(Message, frozen=True, kw_only=True):
    """A request failed.

    :param request: its ``op``
    :param reference: its number, id, type, service or action, as text
    """

    request: Label
    reference: str
    reason: str

    def __post_init__(self) -> None:
        cut(self, "reason", "reference")


class SamplesDropped(Message, frozen=True, kw_only=True):
    """Samples of a subscription were dropped since the last such message.

    :param reason: ``too_large``, ``slow_link`` when newer samples replaced them, ``slow_robot`` when the robot was too
        busy to handle them, or ``not_thinned``
    :param count: samples
    :param size: of the largest, bytes
    :param why: for people: why a cloud was not thinned
    """

    number: int
    reason: Label
    count: Annotated[int, Meta(ge=1)]
    size: Annotated[int, Meta(ge=0)] = 0
    why: str = ""

    def __post_init__(self) -> None:
        cut(self, "why")


class AdvertisedService(Message, frozen=True, kw_only=True):
    """The service server exists; ``type`` is its full type name."""

    service: Name
    type: Name


class AdvertisedAction(Message, frozen=True, kw_only=True):
    """The action server exists; ``type`` is its full type name."""

    action: Name
    type: Name


class Interfaces(Message, frozen=True, kw_only=True):
    """The answer to ``get_interfaces``: full type names, sorted."""

    types: Annotated[list[Name], Meta(max_length=limits.INTERFACES)]


class TypeDefinition(Message, frozen=True, kw_only=True):
    """The answer to ``get_type``, laid out as rosbag2's ``ros2msg``.

    The .msg, .srv or .action text comes first, then every type it contains, each after a line of 80 ``=`` and a line
    ``MSG: name``. Request and response of a service are divided by ``---``.

    :param hash: RIHS01 type hash (REP 2016) where the distribution has one
    """

    type: Name
    text: Annotated[str, Meta(max_length=limits.TYPE_DEFINITION)]
    hash: Label = ""


class AssetPart(Message, frozen=True, kw_only=True):
    """The answer to ``get_asset``.

    :param size: bytes of the whole file
    :param version: differs when the file has changed
    :param data: the bytes from ``offset`` on, at most 128 KiB; in JSON as base64
    """

    number: int
    offset: Annotated[int, Meta(ge=0)]
    size: Annotated[int, Meta(ge=0, le=limits.ASSET)]
    version: Label = ""
    data: Annotated[bytes, Meta(max_length=limits.ASSET_PART)]


RobotChannel = (
    Subscribed
    | Advertised
    | AdvertisedService
    | AdvertisedAction
    | Failed
    | SamplesDropped
    | TypeDefinition
    | Interfaces
    | AssetPart
    | CommonChannel
)
