"""rosapi: queries about the graph, answered as services."""

from __future__ import annotations

import json
import time

import pytest
from conformance_suite import Hand, Server, case
from rosbridge_client import Client

NODE = "/conformance/fixture"
COUNTER = "/conformance/counter"
INVERT = "/conformance/invert"
FIBONACCI = "/conformance/fibonacci"
SECTION = "rosbridge v2, 4.1; rosapi_msgs/srv/{}"
TYPEDEF = {"type", "fieldnames", "fieldtypes", "fieldarraylen", "examples", "constnames", "constvalues"}


def typedef(typedefs: list[dict], type_name: str) -> dict:
    """The definition of one type, written pkg/msg/Name or pkg/Name; all others have the same form."""
    assert all(set(each) == TYPEDEF for each in typedefs)
    short = type_name.replace("/msg/", "/").replace("/srv/", "/").replace("/action/", "/")
    found = [each for each in typedefs if each["type"] in (type_name, short)]
    assert found, f"{type_name} is not among {[each['type'] for each in typedefs]}"
    return found[0]


# --- topics ---


@case("rosapi topics", SECTION.format("Topics"))
def test_topics(client: Client) -> None:
    """topics lists names and types, one type for each name."""
    values = client.values("/rosapi/topics")
    assert len(values["topics"]) == len(values["types"])
    assert dict(zip(values["topics"], values["types"], strict=True))[COUNTER] == "std_msgs/msg/Int64"


@case("rosapi topics", SECTION.format("Topics"))
def test_topics_appear_and_end(client: Client, hand: Hand, topic: str) -> None:
    """topics follows the graph: new topics are listed, ended ones are not."""

    def listed(wanted: bool) -> None:
        until = time.monotonic() + client.patience
        while (topic in client.values("/rosapi/topics")["topics"]) is not wanted:
            assert time.monotonic() < until, f"{topic} is {'not ' if wanted else ''}listed"
            time.sleep(0.05)

    hand.topic(topic, "std_msgs/msg/String")
    listed(True)
    hand.vanish(topic)
    listed(False)


@case("rosapi topics", SECTION.format("TopicsForType"))
def test_topics_for_type(client: Client) -> None:
    """topics_for_type lists the topics of a type, and none for an unused type."""
    assert COUNTER in client.values("/rosapi/topics_for_type", {"type": "std_msgs/msg/Int64"})["topics"]
    assert client.values("/rosapi/topics_for_type", {"type": "sensor_msgs/msg/Illuminance"})["topics"] == []


@case("rosapi topics", SECTION.format("TopicsAndRawTypes"))
def test_topics_and_raw_types(client: Client) -> None:
    """topics_and_raw_types adds the full text of every definition."""
    values = client.values("/rosapi/topics_and_raw_types")
    assert len(values["topics"]) == len(values["types"]) == len(values["typedefs_full_text"])
    text = values["typedefs_full_text"][values["topics"].index(COUNTER)]
    assert "int64 data" in text


@case("rosapi topics", SECTION.format("TopicType"))
def test_topic_type(client: Client) -> None:
    """topic_type returns the type of a topic."""
    args = {"topic": COUNTER}
    assert client.values("/rosapi/topic_type", args) == {"type": "std_msgs/msg/Int64"}


@case("rosapi topics", SECTION.format("TopicType"))
def test_topic_type_unknown(client: Client, topic: str) -> None:
    """topic_type of a topic that does not exist is empty."""
    assert client.values("/rosapi/topic_type", {"topic": topic}) == {"type": ""}


@case("rosapi topics", SECTION.format("Publishers"))
def test_publishers(client: Client) -> None:
    """publishers lists the nodes that publish a topic."""
    assert client.values("/rosapi/publishers", {"topic": COUNTER})["publishers"] == [NODE]


@case("rosapi topics", SECTION.format("Subscribers"))
def test_subscribers(client: Client) -> None:
    """subscribers lists the nodes that subscribe to a topic."""
    args = {"topic": "/conformance/echo/in"}
    assert NODE in client.values("/rosapi/subscribers", args)["subscribers"]


# --- services ---


@case("rosapi services", SECTION.format("Services"))
def test_services(client: Client) -> None:
    """services lists the robot's services."""
    assert {INVERT, "/conformance/slow"} <= set(client.values("/rosapi/services")["services"])


@case("rosapi services", SECTION.format("ServicesForType"))
def test_services_for_type(client: Client) -> None:
    """services_for_type lists the services of a type."""
    values = client.values("/rosapi/services_for_type", {"type": "std_srvs/srv/SetBool"})
    assert INVERT in values["services"]
    assert "/conformance/slow" not in values["services"]


@case("rosapi services", SECTION.format("ServiceType"))
def test_service_type(client: Client) -> None:
    """service_type returns the type of a service."""
    args = {"service": INVERT}
    assert client.values("/rosapi/service_type", args) == {"type": "std_srvs/srv/SetBool"}


@case("rosapi services", SECTION.format("ServiceNode"))
def test_service_node(client: Client) -> None:
    """service_node returns the node that offers a service."""
    assert client.values("/rosapi/service_node", {"service": INVERT}) == {"node": NODE}


@case("rosapi services", SECTION.format("ServiceProviders"))
def test_service_providers(client: Client) -> None:
    """service_providers lists the nodes that offer a service of a type."""
    values = client.values("/rosapi/service_providers", {"service": "std_srvs/srv/SetBool"})
    assert NODE in values["providers"]


# --- nodes ---


@case("rosapi nodes", SECTION.format("Nodes"))
def test_nodes(client: Client) -> None:
    """nodes lists the robot's nodes by their full names."""
    assert NODE in client.values("/rosapi/nodes")["nodes"]


@case("rosapi nodes", SECTION.format("NodeDetails"))
def test_node_details(client: Client) -> None:
    """node_details returns what a node publishes, subscribes to and offers."""
    values = client.values("/rosapi/node_details", {"node": NODE})
    assert COUNTER in values["publishing"]
    assert "/conformance/echo/in" in values["subscribing"]
    assert INVERT in values["services"]


# --- actions ---


@case("rosapi actions", SECTION.format("GetActionServers"))
def test_action_servers(client: Client, server: Server) -> None:
    """action_servers lists the robot's actions."""
    server.needs_examples()
    assert FIBONACCI in client.values("/rosapi/action_servers")["action_servers"]


@case("rosapi actions", SECTION.format("ActionType"))
def test_action_type(client: Client, server: Server) -> None:
    """action_type returns the type of an action."""
    server.needs_examples()
    args = {"action": FIBONACCI}
    assert client.values("/rosapi/action_type", args) == {"type": "example_interfaces/action/Fibonacci"}


@case("rosapi actions", SECTION.format("ActionGoalDetails"))
@pytest.mark.parametrize(
    ("part", "fields"), [("goal", ["order"]), ("result", ["sequence"]), ("feedback", ["sequence"])]
)
def test_action_details(client: Client, server: Server, part: str, fields: list[str]) -> None:
    """action_goal_details, action_result_details and action_feedback_details return the parts of an action."""
    server.needs_examples()
    args = {"type": "example_interfaces/action/Fibonacci"}
    typedefs = client.values(f"/rosapi/action_{part}_details", args)["typedefs"]
    assert typedef(typedefs, typedefs[0]["type"])["fieldnames"] == fields
    assert typedefs[0]["fieldtypes"] == ["int32"]


BARE = {
    "topic_type": {"topic": COUNTER},
    "publishers": {"topic": COUNTER},
    "subscribers": {"topic": "/conformance/echo/in"},
    "service_type": {"service": INVERT},
    "service_node": {"service": INVERT},
    "node_details": {"node": NODE},
    "action_type": {"action": FIBONACCI},
    "get_param": {"name": f"{NODE}:conformance.number"},
}


@case("rosapi names", "SPEC 1.2, names and types")
@pytest.mark.parametrize("service", BARE)
def test_bare_name(client: Client, server: Server, service: str) -> None:
    """A name without its leading slash means the same."""
    if service == "action_type":
        server.needs_examples()
    ((field, name),) = BARE[service].items()
    answer = client.values(f"/rosapi/{service}", {field: name.lstrip("/")})
    assert answer == client.values(f"/rosapi/{service}", {field: name})
    assert any(answer.values())


# --- types ---


@case("rosapi types", SECTION.format("Interfaces"))
def test_interfaces(client: Client) -> None:
    """interfaces lists the full names of all types that are installed on the robot."""
    interfaces = set(client.values("/rosapi/interfaces")["interfaces"])
    assert {"std_msgs/msg/String", "sensor_msgs/msg/Image", "std_srvs/srv/SetBool"} <= interfaces


@case("rosapi types", SECTION.format("MessageDetails"))
@pytest.mark.parametrize("name", ["geometry_msgs/msg/PoseStamped", "geometry_msgs/PoseStamped"])
def test_message_details(client: Client, name: str) -> None:
    """message_details returns the fields of a message and of every message in it."""
    typedefs = client.values("/rosapi/message_details", {"type": name})["typedefs"]
    pose = typedef(typedefs, "geometry_msgs/msg/PoseStamped")
    assert pose["fieldnames"] == ["header", "pose"]
    assert typedef(typedefs, "geometry_msgs/msg/Point")["fieldtypes"] == [
        "float64",
        "float64",
        "float64",
    ] or (typedef(typedefs, "geometry_msgs/msg/Point")["fieldtypes"] == ["double", "double", "double"])
    assert typedef(typedefs, "std_msgs/msg/Header")["fieldnames"] == ["stamp", "frame_id"]


@case("rosapi types", SECTION.format("MessageDetails"))
def test_message_details_lists(client: Client) -> None:
    """message_details describes lists by fieldarraylen: -1 none, 0 any length, else the length."""
    typedefs = client.values("/rosapi/message_details", {"type": "sensor_msgs/msg/CameraInfo"})["typedefs"]
    info = typedef(typedefs, "sensor_msgs/msg/CameraInfo")
    lengths = dict(zip(info["fieldnames"], info["fieldarraylen"], strict=True))
    assert (lengths["height"], lengths["d"], lengths["k"]) == (-1, 0, 9)


@case("rosapi types", SECTION.format("MessageDetails"))
def test_message_details_constants(client: Client) -> None:
    """message_details returns constants."""
    typedefs = client.values("/rosapi/message_details", {"type": "sensor_msgs/msg/NavSatStatus"})["typedefs"]
    status = typedef(typedefs, "sensor_msgs/msg/NavSatStatus")
    constants = dict(zip(status["constnames"], status["constvalues"], strict=True))
    assert str(constants["STATUS_GBAS_FIX"]) == "2"


@case("rosapi types", SECTION.format("MessageDetails"))
def test_message_details_unknown(client: Client) -> None:
    """message_details of a type that does not exist is answered, with an error or with an empty list."""
    answer = client.call("/rosapi/message_details", {"type": "std_msgs/msg/NoSuchThing"})
    assert answer["result"] is False or answer["values"]["typedefs"] == []


@case("rosapi types", SECTION.format("ServiceRequestDetails"))
def test_service_request_details(client: Client) -> None:
    """service_request_details returns the fields of a request."""
    args = {"type": "std_srvs/srv/SetBool"}
    (request,) = client.values("/rosapi/service_request_details", args)["typedefs"]
    assert set(request) == TYPEDEF
    assert (request["fieldnames"], request["fieldarraylen"]) == (["data"], [-1])


@case("rosapi types", SECTION.format("ServiceResponseDetails"))
def test_service_response_details(client: Client) -> None:
    """service_response_details returns the fields of a response."""
    args = {"type": "std_srvs/srv/SetBool"}
    (response,) = client.values("/rosapi/service_response_details", args)["typedefs"]
    assert (response["fieldnames"], response["fieldtypes"][1]) == (["success", "message"], "string")


# --- parameters ---


@case("rosapi params", SECTION.format("GetParam"))
def test_get_param(client: Client) -> None:
    """get_param gives the value of node:parameter as JSON text."""
    for name, value in (("number", 7), ("text", "hello"), ("ratio", 0.5), ("truths", [True, False])):
        answer = client.values("/rosapi/get_param", {"name": f"{NODE}:conformance.{name}"})
        assert json.loads(answer["value"]) == value


@case("rosapi params", SECTION.format("GetParam"))
def test_get_param_default(client: Client) -> None:
    """get_param of a parameter that does not exist gives the default it was asked with, or fails."""
    args = {"name": f"{NODE}:no.such", "default_value": json.dumps(41)}
    answer = client.call("/rosapi/get_param", args)
    if answer["result"] and answer["values"].get("successful", True):
        assert json.loads(answer["values"]["value"]) == 41


@case("rosapi params", SECTION.format("GetParam"))
def test_get_param_no_node(client: Client) -> None:
    """get_param of a node that does not exist is answered soon, and not with a value."""
    answer = client.call("/rosapi/get_param", {"name": "/conformance/nobody:x"}, max(8.0, client.patience))
    assert answer["result"] is False or answer["values"]["value"] in ("", "null", '""')


@case("rosapi params", SECTION.format("SetParam"))
def test_set_param(client: Client) -> None:
    """set_param sets a parameter on the robot."""
    name = f"{NODE}:conformance.text"
    try:
        client.values("/rosapi/set_param", {"name": name, "value": json.dumps("changed")})
        answer = client.values("/conformance/fixture/get_parameters", {"names": ["conformance.text"]})
        assert answer["values"][0]["string_value"] == "changed"
    finally:
        client.values("/rosapi/set_param", {"name": name, "value": json.dumps("hello")})


@case("rosapi params", SECTION.format("SetParam"))
def test_set_param_types(client: Client) -> None:
    """get_param returns what set_param has set, with its type."""
    name = f"{NODE}:conformance.number"
    try:
        for value in (-3, 2.5, True, "text", [1, 2], [0.5], ["a", "b"]):
            client.values("/rosapi/set_param", {"name": name, "value": json.dumps(value)})
            got = json.loads(client.values("/rosapi/get_param", {"name": name})["value"])
            assert (got, type(got)) == (value, type(value))
    finally:
        client.values("/rosapi/set_param", {"name": name, "value": "7"})


@case("rosapi params", SECTION.format("HasParam"))
def test_has_param(client: Client) -> None:
    """has_param returns whether a parameter exists."""
    for name, there in ((f"{NODE}:conformance.number", True), (f"{NODE}:no.such", False)):
        assert client.values("/rosapi/has_param", {"name": name})["exists"] is there


@case("rosapi params", SECTION.format("DeleteParam"))
def test_delete_param(client: Client, hand: Hand) -> None:
    """delete_param removes a parameter, if the node allows it."""
    hand.do("declare", "conformance.fleeting", "0.5")
    name = f"{NODE}:conformance.fleeting"
    assert client.values("/rosapi/has_param", {"name": name})["exists"] is True
    client.values("/rosapi/delete_param", {"name": name})
    assert client.values("/rosapi/has_param", {"name": name})["exists"] is False


@case("rosapi params", SECTION.format("GetParamNames"))
def test_get_param_names(client: Client) -> None:
    """get_param_names lists all parameters of all nodes as node:parameter."""
    names = client.values("/rosapi/get_param_names", seconds=12)["names"]
    assert {f"{NODE}:conformance.number", f"{NODE}:use_sim_time"} <= set(names)


# --- time, version and errors ---


@case("rosapi rest", SECTION.format("GetTime"))
def test_get_time(client: Client) -> None:
    """get_time returns the present time."""
    now = client.values("/rosapi/get_time")["time"]
    assert abs(now["sec"] - time.time()) < 86_400
    assert 0 <= now["nanosec"] < 10**9


@case("rosapi rest", SECTION.format("GetROSVersion"))
def test_get_ros_version(client: Client) -> None:
    """get_ros_version returns 2 and the distribution."""
    values = client.values("/rosapi/get_ros_version")
    assert values["version"] == 2
    assert values["distro"]


@case("rosapi rest", "SPEC 1.2; a call is always answered")
def test_wrong_questions(client: Client) -> None:
    """Invalid requests are answered, and have no other effect."""
    for service in (
        "topic_type",
        "service_type",
        "node_details",
        "message_details",
        "get_param",
        "publishers",
    ):
        for args in ({}, [], {"wrong": 1}, {"topic": 5, "type": [], "name": None}):
            client.call(f"/rosapi/{service}", args)
    client.lives()


@case("rosapi rest", "SPEC 1.2; a call is always answered")
def test_no_such_question(client: Client) -> None:
    """A request for a service that rosapi does not have is answered with result false."""
    assert client.call("/rosapi/meaning_of_life", {})["result"] is False
