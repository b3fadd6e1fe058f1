"""JSON messages of the robot link (SPEC section 2): who says what, before and after a robot has proved
itself.

Every message is an object with ``op``. Unknown fields are passed over, an unknown ``op`` is an error.
A sender leaves out fields at their default.
"""

from __future__ import annotations

import base64
import binascii
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from relay_protocol import frames, jsontext, limits
from relay_protocol.errors import Invalid
from relay_protocol.limits import COMMAND_DEADLINE_MS, STOP_WITHIN_MS

Name = Annotated[str, Meta(max_length=limits.NAME)]
Label = Annotated[str, Meta(max_length=limits.LABEL)]
Ends = Annotated[list[Name], Meta(max_length=limits.GRAPH_ENDS)]
Few = Annotated[list[Name], Meta(max_length=limits.FACTS)]


def lower_tag(name: str) -> str:
    """``OpenChannel`` is written ``open_channel``."""
    return "".join("_" + letter.lower() if letter.isupper() else letter for letter in name).lstrip("_")


class Message(msgspec.Struct, tag_field="op", tag=lower_tag, omit_defaults=True, frozen=True):
    """Base of everything with an ``op``."""


def _cut(message: Message, field: str) -> None:
    """Words for people are cut, on either end: they are no reason to lose a link."""
    text = getattr(message, field)
    if len(text) > limits.WORDS:
        msgspec.structs.force_setattr(message, field, text[: limits.WORDS - 1] + "…")


# --- before the robot is known ---


class Hello(Message, frozen=True, kw_only=True):
    """Robot: this is who I am going to prove to be.

    :param key: fingerprint of the public key that will sign, see :func:`relay_protocol.identity.fingerprint`
    :param encodings: encodings of samples the robot speaks, best first: ``cdr``, ``json``
    :param agent: software and version, for people
    """

    version: int
    robot: Label
    key: Label
    encodings: Few
    agent: Label = ""


class Challenge(Message, frozen=True, kw_only=True):
    """Relay: sign this. ``nonce`` is 32 random bytes in base64, good for this connection only."""

    nonce: str
    relay: str


class Prove(Message, frozen=True, kw_only=True):
    """Robot: the Ed25519 signature (base64) of :func:`relay_protocol.identity.proof_text`."""

    signature: Label


class Enroll(Message, frozen=True, kw_only=True):
    """Robot: register my public key (32 bytes, base64) by this code of one use."""

    version: int
    robot: Label
    code: Label
    public_key: Label
    agent: Label = ""


class Enrolled(Message, frozen=True, kw_only=True):
    """Relay: done; dial again with ``hello``. The robot keeps ``relay`` and refuses another name later."""

    robot: str
    relay: str


class Join(Message, frozen=True, kw_only=True):
    """Robot, on a new connection: this is the channel you asked me to open."""

    version: int
    ticket: Label


class Joined(Message, frozen=True, kw_only=True):
    """Relay: go on. ``at`` is the relay's monotonic clock (ns), the first estimate of the offset."""

    channel: str
    at: int


class Refused(Message, frozen=True, kw_only=True):
    """Relay: no, and the connection ends.

    :param retry_after: seconds after which trying again makes sense; ``None`` when only a person can help
    """

    reason: str
    code: str = "refused"
    retry_after: float | None = None


class Welcome(Message, frozen=True, kw_only=True):
    """Relay: you are registered.

    :param session: name of this registration, for logs on both ends
    :param heartbeat: seconds between pings, each way
    :param frame_limit: largest frame the robot may send on its channel links, bytes
    """

    session: str
    heartbeat: float
    frame_limit: int


# --- both ways, on every link ---


class Ping(Message, frozen=True, kw_only=True):
    """Either end: answer at once. ``t`` is the asker's monotonic clock in nanoseconds."""

    t: int


class Pong(Message, frozen=True, kw_only=True):
    """The answer: ``t`` as it came, ``at`` the answerer's monotonic clock in nanoseconds."""

    t: int
    at: int


class Bye(Message, frozen=True, kw_only=True):
    """Either end: I am closing this link on purpose."""

    reason: str

    def __post_init__(self) -> None:
        _cut(self, "reason")


# --- control link, robot to relay ---


class MotionPolicy(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What the robot's own safety counts as motion, and its times. The robot is the authority on it.

    :param types: message types whose topics are motion topics
    :param topics: further topics by name
    :param deadline_ms: a command older than this is dropped
    :param stop_within_ms: the robot stands still this long after the last valid command
    """

    types: Few = msgspec.field(default_factory=list)
    topics: Few = msgspec.field(default_factory=list)
    deadline_ms: int = COMMAND_DEADLINE_MS
    stop_within_ms: int = STOP_WITHIN_MS


class Describe(Message, frozen=True, kw_only=True):
    """Robot: facts about myself, whole; sent after ``welcome`` and whenever they change.

    :param platform: ``ros2``, ``mqtt``, …
    :param distro: ROS distribution, e.g. ``jazzy``
    :param started: Unix time the daemon started, seconds
    :param sim_time: the robot's time is what ``/clock`` says (``use_sim_time``)
    :param extra: anything else worth showing, text by text
    """

    host: Label = ""
    platform: Label = ""
    distro: Label = ""
    os: Label = ""
    agent: Label = ""
    started: float = 0.0
    sim_time: bool = False
    motion: MotionPolicy = msgspec.field(default_factory=MotionPolicy)
    extra: Annotated[dict[Label, Label], Meta(max_length=limits.FACTS)] = msgspec.field(default_factory=dict)


class Topic(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One topic of the graph: its types (usually one) and the full names of the nodes at its ends."""

    types: Ends
    publishers: Ends = msgspec.field(default_factory=list)
    subscribers: Ends = msgspec.field(default_factory=list)


class Service(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One service (or action) of the graph and the nodes that provide it."""

    types: Ends
    providers: Ends = msgspec.field(default_factory=list)


class Graph(Message, frozen=True, kw_only=True):
    """Robot: the ROS graph, or what has changed in it.

    With ``full`` the maps are all there is. Otherwise each map holds the names that changed, with ``null``
    for a name that is gone. Nodes are keys with an empty object. The daemon's own node is left out.
    """

    full: bool = False
    topics: dict[Name, Topic | None] = msgspec.field(default_factory=dict)
    services: dict[Name, Service | None] = msgspec.field(default_factory=dict)
    actions: dict[Name, Service | None] = msgspec.field(default_factory=dict)
    nodes: dict[Name, dict[str, Any] | None] = msgspec.field(default_factory=dict)


class Health(Message, frozen=True, kw_only=True):
    """Robot: how I am, every few seconds.

    :param battery: charge, 0 to 1; ``None`` when unknown
    :param cpu: load of the whole machine, 0 to 1
    :param memory: memory in use, 0 to 1
    :param rtt_ms: round trip to the relay as the robot measures it, milliseconds
    :param stale_commands: motion commands dropped because they were too old, since start
    :param unguarded_commands: motion commands dropped because the guard could not have stopped them, since start
    :param watchdog_stops: times the watchdog sent zero because commands ceased, since start
    :param dropped_samples: samples dropped because the uplink was full, since start
    """

    battery: float | None = None
    cpu: float | None = None
    memory: float | None = None
    rtt_ms: float | None = None
    stale_commands: int = 0
    unguarded_commands: int = 0
    watchdog_stops: int = 0
    dropped_samples: int = 0


class Alert(Message, frozen=True, kw_only=True):
    """Robot: something a person should know. ``level`` is ``info``, ``warning`` or ``error``."""

    level: Label
    text: str

    def __post_init__(self) -> None:
        _cut(self, "text")


# --- control link, relay to robot ---


class OpenChannel(Message, frozen=True, kw_only=True):
    """Relay: dial and ``join`` with this ticket.

    :param address: ``host:port`` to dial; empty for the address of the control link
    """

    channel: str
    ticket: str
    address: str = ""


class CloseChannel(Message, frozen=True, kw_only=True):
    """Relay: nobody is left on this channel."""

    channel: str


# --- channel link, relay to robot ---


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
    """

    number: int
    topic: str
    type: str = ""
    throttle_ms: int = 0
    qos: QoS | None = None


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


# --- channel link, both ways: whoever offers a service or an action is called ---


class CallService(Message, frozen=True, kw_only=True):
    """Call a service. Arguments are ``cdr`` (base64) or, for a robot without CDR, ``args``.

    :param id: chosen by the caller; the answer carries it
    :param timeout: seconds the caller waits for the answer; 0 when it did not say
    """

    id: Label
    service: Name
    type: Name
    timeout: float = 0.0
    cdr: str | None = None
    args: msgspec.Raw | msgspec.UnsetType = msgspec.UNSET


class ServiceResponse(Message, frozen=True, kw_only=True):
    """The answer to ``call_service``; ``reason`` when ``result`` is false.

    ROS 2 has no way to tell a caller that a service failed: a robot that gets ``result`` false lets its caller
    wait in vain.
    """

    id: Label
    result: bool
    cdr: str | None = None
    values: msgspec.Raw | msgspec.UnsetType = msgspec.UNSET
    reason: str = ""

    def __post_init__(self) -> None:
        _cut(self, "reason")


class SendActionGoal(Message, frozen=True, kw_only=True):
    """Pursue a goal. It is answered by exactly one ``action_result``, after any number of ``action_feedback``.

    :param id: chosen by the asker; everything about this goal carries it
    :param feedback: whether the asker wants ``action_feedback``
    """

    id: Label
    action: Name
    type: Name
    feedback: bool = False
    cdr: str | None = None
    args: msgspec.Raw | msgspec.UnsetType = msgspec.UNSET


class CancelActionGoal(Message, frozen=True, kw_only=True):
    """The asker wants the goal no more. Its ``action_result`` still comes, also when it ended otherwise."""

    id: Label


class ActionFeedback(Message, frozen=True, kw_only=True):
    """How far the goal has come, by the one who pursues it."""

    id: Label
    cdr: str | None = None
    values: msgspec.Raw | msgspec.UnsetType = msgspec.UNSET


class ActionResult(Message, frozen=True, kw_only=True):
    """The goal is over.

    :param status: of ``action_msgs/msg/GoalStatus``: 4 succeeded, 5 canceled, 6 aborted; 0 when it never began
    :param result: whether there is a result, in ``cdr`` or ``values``; else ``reason`` says why not
    """

    id: Label
    status: int
    result: bool
    cdr: str | None = None
    values: msgspec.Raw | msgspec.UnsetType = msgspec.UNSET
    reason: str = ""

    def __post_init__(self) -> None:
        _cut(self, "reason")


# --- channel link, robot to relay ---


class Subscribed(Message, frozen=True, kw_only=True):
    """Robot: samples will come.

    :param encoding: ``cdr`` (kind-1 frames), or ``json`` (kind-1 frames with a JSON body)
    :param latched: publishers keep their last messages for late joiners (transient local)
    :param publishers: how many publish now
    """

    number: int
    topic: Name
    type: Name
    encoding: Label
    latched: bool = False
    publishers: int = 0


class Advertised(Message, frozen=True, kw_only=True):
    """Robot: the publisher stands.

    :param motion: the robot's safety counts this topic as motion
    """

    number: int
    topic: Name
    type: Name
    encoding: Label
    motion: bool = False


class Failed(Message, frozen=True, kw_only=True):
    """Robot: a request could not be done. ``what`` is its ``op``, ``ref`` its number, id or type."""

    what: Label
    ref: str
    reason: str

    def __post_init__(self) -> None:
        _cut(self, "reason")
        _cut(self, "ref")


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


Opening = Hello | Prove | Enroll | Join
"""What a robot may say before it is known."""

OpeningReply = Challenge | Welcome | Enrolled | Joined | Refused
"""What the relay answers to that."""

RobotControl = Describe | Graph | Health | Alert | Ping | Pong | Bye
RelayControl = OpenChannel | CloseChannel | Ping | Pong | Bye
BothChannel = (
    CallService
    | ServiceResponse
    | SendActionGoal
    | CancelActionGoal
    | ActionFeedback
    | ActionResult
    | Ping
    | Pong
    | Bye
)
RobotChannel = (
    Subscribed
    | Advertised
    | AdvertisedService
    | AdvertisedAction
    | Failed
    | TypeDefinition
    | Interfaces
    | BothChannel
)
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

opening_decoder: msgspec.json.Decoder[Opening] = msgspec.json.Decoder(Opening)
opening_reply_decoder: msgspec.json.Decoder[OpeningReply] = msgspec.json.Decoder(OpeningReply)
robot_control_decoder: msgspec.json.Decoder[RobotControl] = msgspec.json.Decoder(RobotControl)
relay_control_decoder: msgspec.json.Decoder[RelayControl] = msgspec.json.Decoder(RelayControl)
robot_channel_decoder: msgspec.json.Decoder[RobotChannel] = msgspec.json.Decoder(RobotChannel)
relay_channel_decoder: msgspec.json.Decoder[RelayChannel] = msgspec.json.Decoder(RelayChannel)


def frame(message: Message) -> bytes:
    """A message as a kind-0 frame, ready for the wire."""
    return frames.encode_json(jsontext.encode(message))


def to_base64(data: bytes) -> str:
    """Bytes for a JSON field (RFC 4648 section 4)."""
    return base64.b64encode(data).decode("ascii")


def from_base64(text: str, what: str) -> bytes:
    """The bytes of a JSON field; ``what`` names it in the error.

    :raises Invalid: not base64
    """
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise Invalid(f"{what} is not base64") from None
