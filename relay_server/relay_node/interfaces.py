"""The relay's own services and topics in every robot's graph, with the definitions of their types.

The types of ``/rosapi/…`` have the fields of ``rosapi_msgs`` (rosbridge_suite, for ROS 2), those of ``/relay/…`` are in
SPEC 1.7. Clients can ask for these definitions as for any other.
"""

from __future__ import annotations

from typing import NamedTuple

from relay_protocol.link import Service, Topic
from relay_protocol.ros_types import TypeRegistry

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


class RelayService(NamedTuple):
    """A service of the relay's own.

    :param node: the node that provides it
    :param type: its full name
    :param text: the definition of the type
    """

    node: str
    type: str
    text: str


def _rosapi(type_name: str, text: str) -> RelayService:
    return RelayService(ROSAPI, f"rosapi_msgs/srv/{type_name}", text)


def _relay(type_name: str, text: str) -> RelayService:
    return RelayService(RELAY, f"switchboard_msgs/srv/{type_name}", text)


_RESULT = "---\nbool success\nstring message\n"
_ORDER = _relay("Order", f"string why\n{_RESULT}")
_MODULE_ORDER = _relay("OrderModule", f"string module\n{_RESULT}")
_PIPE_ORDER = _relay("OrderPipe", f"string pipe\n{_RESULT}string state\n")
_PIPE = (
    "string name\nstring owner\nstring source_robot\nstring source_topic\nstring source_service\nstring source_action\n"
    "string source_program\nstring source_port\nstring source_function\n"
    "string target_robot\nstring target_topic\nstring target_service\nstring target_action\n"
    "string target_program\nstring target_port\nstring target_function\n"
    "float64 rate\nstring state\nstring why\nbool moves\nuint64 messages\nuint64 drops\nuint64 encoded\n"
    "float64 latency_ms\n"
)
_ROLE_ORDER = _relay("OrderRole", f"string role\n{_RESULT}string state\n")
_ELEMENT = "string role\nstring element\n"
_ELEMENT_ORDER = _relay("OrderElement", f"{_ELEMENT}{_RESULT}string state\n")
_FUNCTION = "string name\nuint32 version\nstring text\nstring arguments\nstring result\n"
_JOB = f"{_RESULT}string job\nstring state\nstring result\nstring code\n"
_LOG_LINE = "float64 at\nstring stream\nstring level\nstring text\n"
_REPLY = _relay("Reply", f"string why\nuint32 client\n{_RESULT}")
_STOPPED = (
    f"{_LINE}\nMSG: switchboard_msgs/msg/Stopped\nstring by\nstring why\nfloat64 since\nbool confirmed\n"
    f"FurtherStop again\n{_LINE}\nMSG: switchboard_msgs/msg/FurtherStop\nstring by\nstring why\nfloat64 since\n"
)

SERVICES = {
    "/relay/take_control": _ORDER,
    "/relay/release_control": _ORDER,
    "/relay/grant_control": _REPLY,
    "/relay/refuse_control": _REPLY,
    "/relay/stop": _relay(
        "Stop", f"string why\nstring stop_id\n{_RESULT}bool done\nStopped stopped\n{_STOPPED}"
    ),
    "/relay/resume": _ORDER,
    "/relay/suppress": _relay("Suppress", f"string resource\nuint32 ms 100\n{_RESULT}"),
    "/relay/inhibit": _relay("Inhibit", f"string resource\nuint32 ms 1000\nbool hold\n{_RESULT}"),
    "/relay/start_module": _MODULE_ORDER,
    "/relay/stop_module": _MODULE_ORDER,
    "/relay/restart_module": _MODULE_ORDER,
    "/relay/module_log": _relay(
        "ModuleLog",
        "string module\nuint64 after\nuint32 limit 100\nuint64 before\nstring level\n---\n"
        "LogLine[] lines\nuint64 previous\nuint64 next\nbool missed\n"
        f"{_LINE}\nMSG: switchboard_msgs/msg/LogLine\n{_LOG_LINE}",
    ),
    "/relay/pipes": _relay("Pipes", f"---\nPipe[] pipes\n{_LINE}\nMSG: switchboard_msgs/msg/Pipe\n{_PIPE}"),
    "/relay/add_pipe": _PIPE_ORDER,
    "/relay/start_pipe": _PIPE_ORDER,
    "/relay/stop_pipe": _PIPE_ORDER,
    "/relay/remove_pipe": _PIPE_ORDER,
    "/relay/functions": _relay(
        "Functions", f"---\nFunction[] functions\n{_LINE}\nMSG: switchboard_msgs/msg/Function\n{_FUNCTION}"
    ),
    "/relay/call_function": _relay(
        "CallFunction", f"string function\nstring arguments\nuint32 version\nfloat64 timeout\n{_JOB}"
    ),
    "/relay/function_job": _relay(
        "FunctionJob", f"string job\nfloat64 wait\nbool cancel\n{_JOB}float64 progress\n"
    ),
    "/relay/get_element": _relay("GetElement", f"{_ELEMENT}{_RESULT}string value\n"),
    "/relay/set_element": _relay("SetElement", f"{_ELEMENT}string value\nstring type\n{_RESULT}"),
    "/relay/call_element": _relay(
        "CallElement", f"{_ELEMENT}string args\nfloat64 timeout 10\n{_RESULT}string values\n"
    ),
    "/relay/start_element": _ELEMENT_ORDER,
    "/relay/stop_element": _ELEMENT_ORDER,
    "/relay/start_role": _ROLE_ORDER,
    "/relay/stop_role": _ROLE_ORDER,
    "/relay/ping": _relay("Ping", "bool robot\n---\nint64 relay_time_ns\nfloat64 robot_rtt_ms\n"),
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
TopicDrops[] publish_drops
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
uint64 damaged
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

CONTROL = "switchboard_msgs/msg/Control"

_CONTROL_TEXT = f"""string robot
string state
Holder holder
Request request
Stopped stopped
bool moving
Suppressed[] suppressed
Inhibited[] inhibited
LevelLimits limits
You you
{_LINE}
MSG: switchboard_msgs/msg/Holder
string user
uint32 client
float64 since
bool you
bool implicit
{_LINE}
MSG: switchboard_msgs/msg/Request
string user
uint32 client
float64 since
string why
bool you
float64 until
{_STOPPED}{_LINE}
MSG: switchboard_msgs/msg/Suppressed
string resource
uint32[] sources
string by
uint32 ms
{_LINE}
MSG: switchboard_msgs/msg/Inhibited
string resource
bool hold
string by
uint32 ms
{_LINE}
MSG: switchboard_msgs/msg/LevelLimits
Limits operator
Limits owner
{_LINE}
MSG: switchboard_msgs/msg/Limits
float64 linear
float64 angular
float64 linear_acceleration
float64 angular_acceleration
{_LINE}
MSG: switchboard_msgs/msg/You
uint32 client
bool may_control
bool may_resume
"""

MODULES = "switchboard_msgs/msg/Modules"
_MODULES_TEXT = f"""string robot
bool online
bool current
float64 reported_at
Module[] modules
{_LINE}
MSG: switchboard_msgs/msg/Module
string name
string kind
string state
bool wanted
float64 since
uint32 pid
uint32 restarts
string last_exit
string[] after
string why
PendingOrder pending
RefusedOrder refused
{_LINE}
MSG: switchboard_msgs/msg/PendingOrder
string action
string by
float64 at
{_LINE}
MSG: switchboard_msgs/msg/RefusedOrder
string action
string by
float64 at
string why
"""

PROCESSES = "switchboard_msgs/msg/Processes"
_PROCESSES_TEXT = f"""float64 at
Process[] processes
uint32 more
string error
{_LINE}
MSG: switchboard_msgs/msg/Process
uint32 pid
uint32 parent
string name
string part
string state
float64 busy
float64 read_at
float64 cpu
uint32 cpu_number
int8 nice
uint32 threads
uint64 voluntary
uint64 involuntary
float64 created
uint64 memory
"""

RUN_FUNCTION = "switchboard_msgs/action/RunFunction"
_RUN_FUNCTION_TEXT = (
    f"string function\nstring arguments\nuint32 version\nfloat64 deadline\n{_JOB}---\n"
    "float64 progress\nstring text\nstring state\n"
)

TOPICS = {
    "/relay/control": CONTROL,
    "/relay/modules": MODULES,
    "/relay/processes": PROCESSES,
    "/relay/status": STATUS,
}

OWN_SERVICES = {
    name: Service(types=[offered.type], providers=[offered.node]) for name, offered in SERVICES.items()
}
OWN_ACTIONS = {"/relay/run_function": Service(types=[RUN_FUNCTION], providers=[RELAY])}
OWN_TOPICS = {name: Topic(types=[type_name], publishers=[RELAY]) for name, type_name in TOPICS.items()}


def _registry() -> TypeRegistry:
    types = TypeRegistry()
    types.add(STATUS, _STATUS_TEXT)
    types.add(CONTROL, _CONTROL_TEXT)
    types.add(MODULES, _MODULES_TEXT)
    types.add(PROCESSES, _PROCESSES_TEXT)
    types.add(_TYPEDEF, _TYPEDEF_TEXT)
    types.add(RUN_FUNCTION, _RUN_FUNCTION_TEXT)
    for offered in SERVICES.values():
        types.add(offered.type, offered.text)
    return types


TYPES = _registry()
"""The definitions of all of these."""

TYPE_NAMES = sorted(
    {_TYPEDEF, RUN_FUNCTION, *TOPICS.values(), *(offered.type for offered in SERVICES.values())}
)
