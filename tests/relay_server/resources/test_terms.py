"""What the words of the vocabulary mean: none that is used is without a meaning, and every form tells it."""

from __future__ import annotations

from typing import Any

import pytest
from rdflib import OWL, RDF, RDFS, XSD, Graph, Literal, URIRef

from relay_protocol import jsontext
from relay_protocol.ros_types import TypeRegistry
from relay_server.http.media_types import MediaType
from relay_server.http.openapi.schemas import RobotInfo
from relay_server.http.rdf.encode import (
    camera_graph,
    members_graph,
    module_graph,
    param_graph,
    robot_graph,
    state_graph,
)
from relay_server.http.rdf.vocabulary_page import (
    DOCUMENTS,
    FIELDS,
    HTML,
    OWN,
    WORDS,
    fixed,
    is_fixed,
    of_type,
)
from relay_server.resources.etags import ParamState, TopicState
from relay_server.resources.location import ResourceLocation
from relay_server.resources.topic_context import TopicContext

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
    """What a robot has told of its types."""
    types = TypeRegistry()
    types.add(ODD, TEXT + TIME)
    for each in NUMBERS:
        types.add(f"made_up/msg/{each.title()}", f"{each}[] data\nstring text\n")
    return types


def said(type_name: str, value: Any) -> Graph:
    """The graph of a topic that says this."""
    state = TopicState("/said", type_name, 1.0, jsontext.encode(value))
    return state_graph(state, TopicContext(registry().definitions(type_name), False), PLACE)


def parsed(body: bytes, form: MediaType) -> Graph:
    """The graph in a document."""
    return Graph().parse(data=body, format=form.media)


def used() -> set[str]:
    """The relay's own words in all that it says of resources."""
    member = {"name": "/a", "types": ["x"], "publishers": ["/n"], "subscribers": ["/n"], "providers": ["/n"]}
    shown = {"viewers": 1, "settings": {}}
    camera = {"name": "/c", "type": "x", "encoding": "rgb8", "width": 1, "height": 1, "fps": 1.0, "seen": 1.0}
    addresses = dict.fromkeys(("snapshot", "stream", "viewer", "websocket"), "/")
    module = {"name": "/n", "publishes": ["/a"], "subscribes": ["/a"], "services": ["/a"]}
    graphs = [
        *(
            members_graph(part, {part: [{**member, "moves": True}], "next": "x", "online": True}, PLACE)
            for part in ("topics", "services", "actions", "params", "cameras")
        ),
        members_graph("modules", {"modules": [module], "next": "x", "online": True}, PLACE),
        module_graph(module, PLACE),
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
    """Whoever follows its address finds it there."""
    found = used()
    assert {"Topic", "Camera", "value", "dateTime", "doubleList", "base64Text", "snapshot"} <= found
    assert {"Robot", "collections", *RobotInfo.__annotations__} <= found
    assert {"Module", "publishes", "subscribes", "services"} <= found
    assert found <= set(WORDS)


@pytest.mark.parametrize("form", RDF_DOCUMENTS)
def test_the_relays_own_words_are_told_in_every_form(form: MediaType) -> None:
    """With what they are, a label, a sentence and what their values are, at the address asked for."""
    graph = parsed(fixed(OWN, form, BASE), form)
    assert (URIRef(f"{HERE}{OWN}"), RDF.type, OWL.Ontology) in graph
    for word, term in WORDS.items():
        node = URIRef(f"{HERE}{OWN}#{word}")
        assert (node, RDF.type, term.kind) in graph
        assert graph.value(node, RDFS.label) == Literal(word, datatype=XSD.string)
        assert graph.value(node, RDFS.comment) == Literal(term.words, datatype=XSD.string)
        assert graph.value(node, RDFS.range) == term.range
    assert "relay.invalid" not in fixed(OWN, form, BASE).decode()


@pytest.mark.parametrize("name", [OWN, FIELDS])
def test_people_find_each_word_on_a_page(name: str) -> None:
    """By the part of its address behind '#'."""
    page = fixed(name, HTML, BASE).decode()
    assert page.startswith("<!DOCTYPE html>")
    assert all(f'id="{word}"' in page for word in WORDS) is (name == OWN)


def test_no_other_document_is_the_same_everywhere() -> None:
    """What is not fixed is a type, or nothing."""
    assert is_fixed(OWN) and is_fixed(FIELDS)
    assert not is_fixed("std_msgs")


@pytest.mark.parametrize("form", RDF_DOCUMENTS)
def test_a_type_is_told_with_its_fields(form: MediaType) -> None:
    """Each with its type as ROS writes it, and with that of its values where there is but one."""
    graph = parsed(of_type(registry().definitions(ODD)[ODD], form, BASE), form)
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
    """The page of the other type."""
    page = of_type(registry().definitions(ODD)[ODD], HTML, BASE).decode()
    assert f'<a href="{HERE}builtin_interfaces/Time">Time</a>' in page
