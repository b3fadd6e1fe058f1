"""What the relay itself offers in every robot's graph: names and types, as every node's are known there.

The types of ``/rosapi/…`` have the fields of ``rosapi_msgs`` (rosbridge_suite, for ROS 2), those of ``/relay/…`` are in
SPEC section 1.7. So a client can ask for their definitions like for any other.
"""

from __future__ import annotations

from typing import NamedTuple

from relay_protocol.link import Service, Topic
from relay_protocol.ros_types import TypeRegistry
from relay_server.relay_node import control_types

PACKAGES = ("rosapi_msgs/", "switchboard_msgs/")
"""How the names of these types begin."""

RELAY = "/relay"
ROSAPI = "/rosapi"

_LINE = "=" * 80
_TYPEDEF = "rosapi_msgs/msg/TypeDef"
_TYPEDEF_TEXT = (
    "string type\nstring[] fieldnames\nstring[] fieldtypes\nint32[] fieldarraylen\nstring[] examples\n"
    "string[] constnames\nstring[] constvalues\n"
)
_TIME = "builtin_interfaces/msg/Time"
_DETAILS = f"string type\n---\nTypeDef[] typedefs\n{_LINE}\nMSG: {_TYPEDEF}\n{_TYPEDEF_TEXT}"


class RelayInterfaces(NamedTuple):
    """One service of the relay's own.

    :param node: who provides it
    :param text: its type's definition
    """

    node: str
    type: str
    text: str


def _rosapi(type_name: str, text: str) -> RelayInterfaces:
    return RelayInterfaces(ROSAPI, f"rosapi_msgs/srv/{type_name}", text)


SERVICES = {
    **{name: RelayInterfaces(RELAY, *type) for name, type in control_types.SERVICES.items()},
    "/relay/ping": RelayInterfaces(
        RELAY, "switchboard_msgs/srv/Ping", "bool robot\n---\nint64 relay_time_ns\nfloat64 robot_rtt_ms\n"
    ),
    "/rosapi/action_feedback_details": _rosapi("ActionFeedbackDetails", _DETAILS),
    "/rosapi/action_goal_details": _rosapi("ActionGoalDetails", _DETAILS),
    "/rosapi/action_result_details": _rosapi("ActionResultDetails", _DETAILS),
    "/rosapi/action_servers": _rosapi("GetActionServers", "---\nstring[] action_servers\n"),
    "/rosapi/action_type": _rosapi("ActionType", "string action\n---\nstring type\n"),
    "/rosapi/delete_param": _rosapi("DeleteParam", "string name\n---\nbool successful\nstring reason\n"),
    "/rosapi/get_param": _rosapi(
        "GetParam", "string name\nstring default_value\n---\nstring value\nbool successful\nstring reason\n"
    ),
    "/rosapi/get_param_names": _rosapi("GetParamNames", "---\nstring[] names\n"),
    "/rosapi/get_ros_version": _rosapi("GetROSVersion", "---\nuint8 version\nstring distro\n"),
    "/rosapi/get_time": _rosapi("GetTime", f"---\n{_TIME} time\n"),
    "/rosapi/has_param": _rosapi("HasParam", "string name\n---\nbool exists\n"),
    "/rosapi/interfaces": _rosapi("Interfaces", "---\nstring[] interfaces\n"),
    "/rosapi/message_details": _rosapi("MessageDetails", _DETAILS),
    "/rosapi/node_details": _rosapi(
        "NodeDetails", "string node\n---\nstring[] subscribing\nstring[] publishing\nstring[] services\n"
    ),
    "/rosapi/nodes": _rosapi("Nodes", "---\nstring[] nodes\n"),
    "/rosapi/publishers": _rosapi("Publishers", "string topic\n---\nstring[] publishers\n"),
    "/rosapi/service_node": _rosapi("ServiceNode", "string service\n---\nstring node\n"),
    "/rosapi/service_providers": _rosapi("ServiceProviders", "string service\n---\nstring[] providers\n"),
    "/rosapi/service_request_details": _rosapi("ServiceRequestDetails", _DETAILS),
    "/rosapi/service_response_details": _rosapi("ServiceResponseDetails", _DETAILS),
    "/rosapi/service_type": _rosapi("ServiceType", "string service\n---\nstring type\n"),
    "/rosapi/services": _rosapi("Services", "---\nstring[] services\n"),
    "/rosapi/services_for_type": _rosapi("ServicesForType", "string type\n---\nstring[] services\n"),
    "/rosapi/set_param": _rosapi(
        "SetParam", "string name\nstring value\n---\nbool successful\nstring reason\n"
    ),
    "/rosapi/subscribers": _rosapi("Subscribers", "string topic\n---\nstring[] subscribers\n"),
    "/rosapi/topic_type": _rosapi("TopicType", "string topic\n---\nstring type\n"),
    "/rosapi/topics": _rosapi("Topics", "---\nstring[] topics\nstring[] types\n"),
    "/rosapi/topics_and_raw_types": _rosapi(
        "TopicsAndRawTypes", "---\nstring[] topics\nstring[] types\nstring[] typedefs_full_text\n"
    ),
    "/rosapi/topics_for_type": _rosapi("TopicsForType", "string type\n---\nstring[] topics\n"),
}

STATUS = "switchboard_msgs/msg/Status"
_STATUS_TEXT = f"""string robot
string state
string level
Client[] clients
RoundTrips rtt_ms
Links links
Person[] people
uint32 more
uint64 drops
TopicDrops[] topic_drops
Lost[] lost
Downlink downlink
uint64 plain_instead
uint64 refusals
uint64 stale_commands
Unmatched[] unmatched
Uplink uplink
Video[] video
Motion motion
Health health
Steering control
bool stopped
{_LINE}
MSG: switchboard_msgs/msg/Steering
string state
string holder
bool you
Hand[] suppressed
Hand[] inhibited
{_LINE}
MSG: switchboard_msgs/msg/Hand
string resource
string by
bool hold
{_LINE}
MSG: switchboard_msgs/msg/Client
string user
float64 since
string camera
{_LINE}
MSG: switchboard_msgs/msg/Downlink
bool thin
float64 bytes_per_second
uint64 waiting_bytes
string advice
{_LINE}
MSG: switchboard_msgs/msg/RoundTrips
float64 client_relay
float64 relay_robot
{_LINE}
MSG: switchboard_msgs/msg/Links
Link client_relay
Link relay_robot
Link client_robot
{_LINE}
MSG: switchboard_msgs/msg/Link
float64 rtt_ms
float64 p95_ms
float64 jitter_ms
uint32 lost
string quality
{_LINE}
MSG: switchboard_msgs/msg/Person
string user
bool you
bool control
Connection[] connections
Watching[] watching
{_LINE}
MSG: switchboard_msgs/msg/Connection
uint64 client
float64 since
bool you
bool control
float64 rtt_ms
float64 robot_rtt_ms
string quality
uint64 drops
string address
{_LINE}
MSG: switchboard_msgs/msg/Watching
string camera
float64 since
string address
{_LINE}
MSG: switchboard_msgs/msg/TopicDrops
string topic
uint64 drops
{_LINE}
MSG: switchboard_msgs/msg/Unmatched
string topic
string[] nodes
{_LINE}
MSG: switchboard_msgs/msg/Lost
string topic
string reason
uint64 count
{_LINE}
MSG: switchboard_msgs/msg/Uplink
string state
uint32 subscribed
uint32 published
bool sim_time
{_LINE}
MSG: switchboard_msgs/msg/Video
string camera
string codec
string state
uint32 viewers
uint32 width
uint32 height
uint8 quality
float64 fps
float64 reduced
float64 delay_ms
{_LINE}
MSG: switchboard_msgs/msg/Motion
string[] types
string[] topics
string[] services
string[] actions
uint32 deadline_ms
uint32 stop_within_ms
{_LINE}
MSG: switchboard_msgs/msg/Health
float64 battery
float64 cpu
float64 memory
float64 rtt_ms
uint64 stale_commands
uint64 invalid_commands
uint64 unguarded_commands
uint64 refused_commands
uint64 limited_commands
uint64 watchdog_stops
uint64 dropped_samples
"""

TOPICS = {"/relay/control": control_types.CONTROL, "/relay/status": STATUS}

OWN_SERVICES = {
    name: Service(types=[offered.type], providers=[offered.node]) for name, offered in SERVICES.items()
}
OWN_TOPICS = {name: Topic(types=[type_name], publishers=[RELAY]) for name, type_name in TOPICS.items()}


def _registry() -> TypeRegistry:
    types = TypeRegistry()
    types.add(STATUS, _STATUS_TEXT)
    types.add(control_types.CONTROL, control_types.CONTROL_TEXT)
    types.add(_TYPEDEF, _TYPEDEF_TEXT)
    for offered in SERVICES.values():
        types.add(offered.type, offered.text)
    return types


TYPES = _registry()
"""The definitions of all of these."""

TYPE_NAMES = sorted(
    {STATUS, _TYPEDEF, control_types.CONTROL, *(offered.type for offered in SERVICES.values())}
)
