"""States as RDF graphs and back, in every format."""

from __future__ import annotations

import base64
import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import serialize_message
from rdflib import RDF, SOSA, XSD, Graph, Literal, Namespace, URIRef
from rdflib.compare import isomorphic

from relay_protocol import jsontext
from relay_protocol.ros_types import TypeRegistry
from relay_server.http.media_types import FORMS, JSON, MediaType
from relay_server.http.rdf.decode import message_in, value_in
from relay_server.http.rdf.encode import LONGEST_LIST, MOST_VALUES, members_graph, param_graph, state_graph
from relay_server.http.rdf.serialize import read, write
from relay_server.resources.states import ParamState, ResourceLocation, TopicContext, TopicState
from tests.worlds.ros_messages import EVERY, LETTERS, installed, messages, whole_text

TYPES = installed()
REGISTRY = TypeRegistry()
for owner in {each.owner for each in TYPES.values()}:
    REGISTRY.add(owner, whole_text(owner))

PLACE = ResourceLocation("https://robots.example:8443", "rover")
TOPIC = "/arm/joint 1"
PATH = "/api/v1/robots/rover/topics/arm/joint%201"
WORDS = Namespace("https://robots.example:8443/api/v1/vocabulary/")
ONE = settings(EVERY, max_examples=1)
SEVERAL = settings(EVERY, max_examples=3)
RDF_FORMS = FORMS[1:]


def graph_of(type_name: str, value: Any, *, known: bool = True, moves: bool = False) -> Graph:
    """The graph of a topic with this message."""
    definitions = REGISTRY.definitions(type_name) if known else {}
    state = TopicState(TOPIC, type_name, 1_700_000_000.25, jsontext.encode(value))
    return state_graph(state, TopicContext(definitions, moves), PLACE)


def there_and_back(graph: Graph, form: MediaType) -> Graph:
    """A graph that is serialised and parsed again."""
    return read(write(graph, form), form, PLACE.of("topics", TOPIC))


def same(one: Any, other: Any) -> bool:
    """Whether two values are the same JSON, with the sign of zero and the type of numbers."""
    return json.dumps(one, sort_keys=True) == json.dumps(other, sort_keys=True)


@pytest.mark.parametrize("name", [each for each in TYPES if "/msg/" in each])
def test_messages_survive_every_form(name: str) -> None:
    """Any message of any installed type survives, and so does its type."""

    @(SEVERAL if name.startswith("switchboard_test_interfaces") else ONE)
    @given(messages(TYPES[name].cls))
    def check(message: Any) -> None:
        value = json.loads(REGISTRY.to_json(name, serialize_message(message)))
        graph = graph_of(name, value)
        for form in RDF_FORMS:
            said = message_in(there_and_back(graph, form), PATH)
            assert said.type == name and same(said.value, value), form

    check()


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(LETTERS | st.characters(exclude_categories=["Cs"])),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(LETTERS | st.just("a")), inner, max_size=4),
    max_leaves=12,
)  # fmt: skip


@pytest.mark.parametrize("form", RDF_FORMS)
def test_any_json_survives_as_a_parameter(form: MediaType) -> None:
    """This includes parameters of nodes, and messages of robots without types."""

    @settings(EVERY, max_examples=60)
    @given(VALUES)
    def check(value: Any) -> None:
        graph = param_graph(ParamState("node:x.y", jsontext.encode(value)), PLACE)
        again = read(write(graph, form), form, PLACE.of("params", "node:x.y"))
        assert same(value_in(again, "/api/v1/robots/rover/params/node%3Ax.y"), value)

    check()


@pytest.mark.parametrize("form", RDF_FORMS)
def test_all_media_types_describe_the_same_graph(form: MediaType) -> None:
    """Not only the same message; also lists that begin with zero, and texts that XML cannot contain."""
    value = {
        "name": ["", '"\\\n\t', "\r\x01\uffff"],
        "position": [0.0, -0.0, 0.1],
        "effort": [],
        "velocity": [None],
    }
    graph = graph_of("sensor_msgs/msg/JointState", value)
    assert isomorphic(there_and_back(graph, form), graph)


@pytest.mark.parametrize("form", RDF_FORMS)
def test_without_definitions_values_say_what_they_are(form: MediaType) -> None:
    """A robot without type definitions is readable too."""
    value = {"data": 1, "more": {"a b": [1, None]}, "list": [[1.5], {}], "on": True}
    said = message_in(there_and_back(graph_of("made_up/msg/Thing", value, known=False), form), PATH)
    assert said.type == "made_up/msg/Thing" and same(said.value, value)


def test_a_sensor_observes() -> None:
    """As a SOSA observation, with the time at which the relay received it."""
    value = {"header": {"stamp": {"sec": 1, "nanosec": 20}, "frame_id": "gps"}, "latitude": 47.5}
    graph = graph_of("sensor_msgs/msg/NavSatFix", value)
    topic = URIRef(PLACE.base + PATH)
    assert (topic, RDF.type, SOSA.Observation) in graph
    sensor = graph.value(topic, SOSA.madeBySensor)
    assert graph.value(sensor, SOSA.isHostedBy) == URIRef(f"{PLACE.base}/api/v1/robots/rover")
    when = Literal("2023-11-14T22:13:20.25Z", datatype=XSD.dateTime)
    assert graph.value(topic, SOSA.resultTime) == when
    result = graph.value(topic, SOSA.hasResult)
    latitude = graph.value(result, WORDS["sensor_msgs/NavSatFix#latitude"])
    assert latitude == Literal("47.5", datatype=XSD.double)
    stamp = next(graph.subjects(RDF.type, WORDS["builtin_interfaces/Time"]))
    assert graph.value(stamp, WORDS["builtin_interfaces/Time#nanosec"]) == Literal(
        "20", datatype=XSD.unsignedInt
    )
    assert str(graph.value(stamp, WORDS["switchboard#dateTime"])) == "1970-01-01T00:00:01.00000002Z"


def test_commands_that_move_the_robot_actuate() -> None:
    """A message of a single value also has a simple result."""
    graph = graph_of("std_msgs/msg/Float32", {"data": 0.1}, moves=True)
    topic = URIRef(PLACE.base + PATH)
    assert (topic, RDF.type, SOSA.Actuation) in graph and graph.value(topic, SOSA.actsOnProperty)
    assert graph.value(topic, SOSA.hasSimpleResult) == Literal("0.1", datatype=XSD.float)
    graph.remove((topic, SOSA.hasResult, None))
    assert message_in(graph, PATH).value == {"data": 0.1}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sensor_msgs/msg/LaserScan", {"ranges": [None, *(each / 7 for each in range(LONGEST_LIST))]}),
        ("std_msgs/msg/Int64MultiArray", {"data": list(range(-9, 2 * LONGEST_LIST))}),
        ("sensor_msgs/msg/PointCloud2", {"data": base64.b64encode(bytes(range(256)) * 4000).decode()}),
        ("geometry_msgs/msg/Polygon", {"points": [{"x": 0.5, "y": 0.0, "z": 0.0}] * LONGEST_LIST}),
        ("sensor_msgs/msg/JointState", {"name": ["\uffff"] * (LONGEST_LIST + 1)}),
    ],
)
def test_long_arrays_are_one_literal(name: str, value: dict[str, Any]) -> None:
    """A point cloud does not become a million statements; it survives unchanged."""
    graph = graph_of(name, value)
    assert len(graph) < 100
    for form in RDF_FORMS:
        assert same(message_in(there_and_back(graph, form), PATH).value, value)


def test_large_messages_have_no_lists() -> None:
    """Many short arrays become literals too."""
    polygon = {"points": [{"x": 1.0, "y": 2.0, "z": 3.0}] * 200}
    value = {"layout": {"dim": [{"label": "a", "size": 1, "stride": 1}]}, "data": [1.0] * MOST_VALUES}
    assert len(graph_of("std_msgs/msg/Float64MultiArray", value)) < 40
    many = [{"polygon": polygon} for _ in range(MOST_VALUES // 500)]
    untyped = graph_of("made_up/msg/Many", {"a": many, "b": many}, known=False)
    assert len(untyped) < 40
    for form in RDF_FORMS:
        assert same(message_in(there_and_back(untyped, form), PATH).value, {"a": many, "b": many})


def test_a_page_of_members_is_a_collection() -> None:
    """Each member has its address and the content of its JSON."""
    page = {
        "topics": [
            {"name": "/odom", "types": ["nav_msgs/msg/Odometry"], "publishers": ["/base"], "moves": False}
        ],
        "next": "/odom",
        "online": True,
    }
    graph = members_graph("topics", page, PLACE)
    odom = URIRef(f"{PLACE.base}/api/v1/robots/rover/topics/odom")
    assert (None, None, odom) in graph and (odom, RDF.type, WORDS["switchboard#Topic"]) in graph
    assert str(graph.value(odom, WORDS["switchboard#types"])) == "nav_msgs/msg/Odometry"
    for form in RDF_FORMS:
        assert isomorphic(there_and_back(graph, form), graph)


def test_the_same_state_has_the_same_text() -> None:
    """The entity tag depends on it."""
    value = {"name": ["a", "b"], "position": [0.0, 1.0]}
    for form in RDF_FORMS:
        assert write(graph_of("sensor_msgs/msg/JointState", value), form) == write(
            graph_of("sensor_msgs/msg/JointState", value), form
        )
    assert JSON not in RDF_FORMS
