"""The vocabulary: each used term is defined, in every format."""

from __future__ import annotations

from typing import Any

import pytest
from rdflib import OWL, RDF, RDFS, XSD, Graph, Literal, URIRef

from relay_protocol import jsontext
from relay_protocol.ros_types import TypeRegistry
from relay_server.http.media_types import TURTLE, MediaType
from relay_server.http.rdf.encode import (
    camera_graph,
    members_graph,
    node_graph,
    param_graph,
    robot_graph,
    state_graph,
)
from relay_server.http.rdf.vocabulary import (
    DOCUMENTS,
    FIELDS,
    HTML,
    OWN,
    fixed_document,
    is_fixed,
    own_terms,
    type_document,
)
from relay_server.resources.states import ParamState, ResourceLocation, TopicContext, TopicState
from relay_server.sessions.presence import RobotInfo

BASE = "https://robots.example:8443"
PLACE = ResourceLocation(BASE, "rover")
HERE = f"{BASE}/api/v1/vocabulary/"
RDF_DOCUMENTS = [each for each in DOCUMENTS if each is not HTML]
ODD = "made_up/msg/Odd"
TEXT = """builtin_interfaces/Time stamp
string<=5 text
float64[3] three
uint8[] bytes
int32[<=4] some
"""
TIME = f"{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
NUMBERS = (
    "bool",
    "byte",
    "int8",
    "int16",
    "int32",
    "int64",
    "uint16",
    "uint32",
    "uint64",
    "float32",
    "float64",
)


def registry() -> TypeRegistry:
    """A robot's type registry."""
    types = TypeRegistry()
    types.add(ODD, TEXT + TIME)
    for each in NUMBERS:
        types.add(f"made_up/msg/{each.title()}", f"{each}[] data\nstring text\n")
    return types


def said(type_name: str, value: Any) -> Graph:
    """The graph of a topic with this message."""
    state = TopicState("/said", type_name, 1.0, jsontext.encode(value))
    return state_graph(state, TopicContext(registry().definitions(type_name), False), PLACE)


def parsed(body: bytes, form: MediaType) -> Graph:
    """The graph in a document."""
    return Graph().parse(data=body, format=form.media)


def used() -> set[str]:
    """The relay's own terms in all its graphs of resources."""
    member = {"name": "/a", "types": ["x"], "publishers": ["/n"], "subscribers": ["/n"], "providers": ["/n"]}
    shown = {"viewers": 1, "settings": {}}
    camera = {"name": "/c", "type": "x", "encoding": "rgb8", "width": 1, "height": 1, "fps": 1.0, "seen": 1.0}
    addresses = dict.fromkeys(("snapshot", "stream", "viewer", "websocket"), "/")
    node = {"name": "/n", "publishes": ["/a"], "subscribes": ["/a"], "services": ["/a"]}
    graphs = [
        *(
            members_graph(part, {part: [{**member, "moves": True}], "next": "x", "online": True}, PLACE)
            for part in ("topics", "services", "actions", "params", "cameras")
        ),
        members_graph("nodes", {"nodes": [node], "next": "x", "online": True}, PLACE),
        node_graph(node, PLACE),
        robot_graph(
            {"name": "rover", **dict.fromkeys(RobotInfo.__annotations__, "x"), "clients": [shown]}, PLACE
        ),
        camera_graph({**camera, "streams": [shown], "addresses": addresses}, PLACE),
        param_graph(ParamState("n:p", b'{"a":"\\u0001"}'), PLACE),
        said(ODD, {"stamp": {"sec": 1, "nanosec": 2}}),
        *(said(f"made_up/msg/{each.title()}", {"data": [1] * 101}) for each in NUMBERS if each != "byte"),
    ]
    words = set()
    for graph in graphs:
        for triple in graph:
            words |= {str(each) for each in triple}
            words |= {str(each.datatype) for each in triple if isinstance(each, Literal)}
    own = f"{HERE}{OWN}#"
    return {each.removeprefix(own) for each in words if each.startswith(own)}


def test_every_word_that_is_used_has_a_meaning() -> None:
    """Its address leads to its definition."""
    found = used()
    assert {"Topic", "Camera", "value", "dateTime", "doubleList", "base64Text", "snapshot"} <= found
    assert {"Robot", "collections", *RobotInfo.__annotations__} <= found
    assert {"Node", "publishes", "subscribes", "services"} <= found
    assert found <= set(own_terms(parsed(fixed_document(OWN, TURTLE, BASE), TURTLE)))


@pytest.mark.parametrize("form", RDF_DOCUMENTS)
def test_the_relays_vocabulary_is_served_in_every_media_type(form: MediaType) -> None:
    """Each term has a type, a label, a comment and its range, at the requested address."""
    graph = parsed(fixed_document(OWN, form, BASE), form)
    assert (URIRef(f"{HERE}{OWN}"), RDF.type, OWL.Ontology) in graph
    terms = own_terms(graph)
    assert len(terms) > 60
    for word, node in terms.items():
        assert node == URIRef(f"{HERE}{OWN}#{word}")
        assert graph.value(node, RDFS.isDefinedBy) == URIRef(f"{HERE}{OWN}")
        assert graph.value(node, RDFS.label) == Literal(word, datatype=XSD.string)
        assert graph.value(node, RDFS.comment).datatype == XSD.string
    battery = terms["battery"]
    assert (battery, RDF.type, RDF.Property) in graph and (battery, RDFS.range, XSD.double) in graph
    assert "relay.invalid" not in fixed_document(OWN, form, BASE).decode()


@pytest.mark.parametrize("name", [OWN, FIELDS])
def test_each_term_is_on_a_page(name: str) -> None:
    """The fragment of the address is the element's id."""
    page = fixed_document(name, HTML, BASE).decode()
    assert page.startswith("<!DOCTYPE html>")
    assert all(f'id="{word}"' in page for word in ("Robot", "battery", "base64Text")) is (name == OWN)


def test_no_other_document_is_the_same_everywhere() -> None:
    """Any other name is a type, or does not exist."""
    assert is_fixed(OWN) and is_fixed(FIELDS)
    assert not is_fixed("std_msgs")


@pytest.mark.parametrize("form", RDF_DOCUMENTS)
def test_a_type_is_described_with_its_fields(form: MediaType) -> None:
    """Each field has its ROS type, and its range if it is unique."""
    graph = parsed(type_document(registry().definitions(ODD)[ODD], form, BASE), form)
    odd = URIRef(f"{HERE}made_up/Odd")
    assert (odd, RDF.type, RDFS.Class) in graph

    def field(name: str) -> tuple[str, Any]:
        node = URIRef(f"{odd}#{name}")
        assert graph.value(node, RDFS.domain) == odd
        return str(graph.value(node, RDFS.comment)).partition(": ")[2], graph.value(node, RDFS.range)

    assert field("stamp") == ("builtin_interfaces/msg/Time", URIRef(f"{HERE}builtin_interfaces/Time"))
    assert field("text") == ("string<=5", XSD.string)
    assert field("three") == ("float64[3]", None)
    assert field("bytes") == ("uint8[]", XSD.base64Binary)
    assert field("some") == ("int32[<=4]", None)


def test_a_page_of_a_type_links_to_what_it_contains() -> None:
    """The link goes to the page of the other type."""
    page = type_document(registry().definitions(ODD)[ODD], HTML, BASE).decode()
    assert f'<a href="{HERE}builtin_interfaces/Time">Time</a>' in page
