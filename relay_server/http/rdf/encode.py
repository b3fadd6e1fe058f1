"""Resources as RDF graphs: topics, parameters, cameras, nodes, robots and their collections.

A message of a sensor becomes a ``sosa:Observation``, a message that moves the robot a ``sosa:Actuation``.
Other resources are listed without such a role.

Source: W3C Semantic Sensor Network Ontology.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime, timedelta, timezone
from itertools import count
from typing import Any

from rdflib import RDF, RDFS, SOSA, SSN, XSD, BNode, Graph, Literal, Namespace, URIRef
from rdflib.term import Node

from relay_protocol import jsontext
from relay_protocol.ros.definition import BYTES, Definition, FieldType, Shape
from relay_server.http.rdf.vocabulary import DATATYPES, TIME, Vocabulary, can_be_field, prefix_of
from relay_server.resources.states import ParamState, ResourceLocation, TopicContext, TopicState

LONGEST_LIST = 100
"""Values. An array that holds more, nested ones counted, is written as one literal."""

MOST_VALUES = 2000
"""Values. In a message that holds more, every array is written as one literal."""

# XML 1.0 section 2.2; a carriage return would be read as a line feed.
_UNSAFE = re.compile("[^\t\n\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_PYTHON: dict[str, tuple[type, ...]] = {
    "bool": (bool,),
    "string": (str,),
    "wstring": (str,),
    "float32": (float, int, type(None)),
    "float64": (float, int, type(None)),
}
"""The JSON types of those basic types that are not integers."""

_Write = Callable[[Any], str]


class ValueGraph:
    """Adds values to a graph.

    :param definitions: of the known types, by their full names
    """

    def __init__(self, graph: Graph, words: Vocabulary, definitions: Mapping[str, Definition]) -> None:
        self._graph = graph
        self._words = words
        self._definitions = definitions
        self._numbers = count(1)
        self._fields: dict[str, Namespace] = {}
        self._longest = LONGEST_LIST

    def message(self, type_name: str, value: Any) -> Node:
        """A message as a blank node.

        :param value: decoded JSON; values that do not fit the type are written as the JSON types they have
        """
        self._choose_list_limit(value)
        return self._message(type_name, value)

    def add_fact(self, subject: Node, word: str, value: Any) -> None:
        """Add a fact about a resource, in the relay's own words.

        :param value: decoded JSON
        """
        self._graph.add((subject, self._words.own[word], self.untyped(value)))

    def untyped(self, value: Any) -> Node:
        """A node for decoded JSON whose type is not known."""
        self._choose_list_limit(value)
        return self._plain(value)

    def _choose_list_limit(self, value: Any) -> None:
        self._longest = 0 if holds_more_than(value, MOST_VALUES) else LONGEST_LIST

    def _message(self, name: str, value: Any) -> Node:
        definition = self._definitions.get(name)
        if not isinstance(value, dict) or (definition is None and self._must_be_json(value)):
            return self._plain(value)
        node = BNode(f"b{next(self._numbers)}")
        self._graph.add((node, RDF.type, self._words.type(name)))
        names = self._names(name)
        if definition is None:
            return self._object(node, names, value)
        for field in definition.fields:
            if field.name in value:
                self._graph.add((node, names[field.name], self._field(field.type, value[field.name])))
        if name == TIME and (moment := _date_time_of(value)) is not None:
            self._graph.add((node, self._words.own.dateTime, moment))
        return node

    def _names(self, name: str) -> Namespace:
        found = self._fields.get(name)
        if found is None:
            found = self._fields[name] = self._words.fields(name)
            self._graph.bind(prefix_of(name), found)
        return found

    def _field(self, kind: FieldType, value: Any) -> Node:
        if kind.shape is Shape.SCALAR:
            return self._one(kind, value)
        if kind.base in BYTES and isinstance(value, str):
            return Literal(value, datatype=XSD.base64Binary)
        if not isinstance(value, list):
            return self._plain(value)
        if holds_more_than(value, self._longest):
            return self._long(kind, value)
        return self._list([self._one(kind, each) for each in value])

    def _one(self, kind: FieldType, value: Any) -> Node:
        if kind.primitive is None:
            return self._message(kind.base, value)
        if type(value) not in _PYTHON.get(kind.base, (int,)):
            return self._plain(value)
        datatype = DATATYPES[kind.base]
        if datatype == XSD.string:
            return self._text(value)
        return Literal(_writer_for(kind)(value), datatype=datatype)

    def _long(self, kind: FieldType, values: list[Any]) -> Node:
        python = set(_PYTHON.get(kind.base, (int,)))
        numbers = kind.primitive is not None and kind.primitive.code
        if not numbers or not set(map(type, values)) <= python:
            return _json(values)
        return Literal(
            " ".join(map(_writer_for(kind), values)), datatype=self._words.list_of(DATATYPES[kind.base])
        )

    def _plain(self, value: Any) -> Node:
        if isinstance(value, str):
            return self._text(value)
        if isinstance(value, list):
            if holds_more_than(value, self._longest):
                return _json(value)
            return self._list([self._plain(each) for each in value])
        if isinstance(value, dict):
            if self._must_be_json(value):
                return _json(value)
            node = BNode(f"b{next(self._numbers)}")
            self._graph.add((node, RDF.type, self._words.own.Object))
            self._graph.bind("field", self._words.untyped)
            return self._object(node, self._words.untyped, value)
        for kind, datatype in ((bool, XSD.boolean), (int, XSD.integer), (float, XSD.double)):
            if type(value) is kind:
                return Literal(_number(value), datatype=datatype)
        return _json(value)

    def _must_be_json(self, value: dict[str, Any]) -> bool:
        return (self._longest == 0 and bool(value)) or not all(map(can_be_field, value))

    def _object(self, node: BNode, names: Namespace, value: dict[str, Any]) -> Node:
        for name, each in value.items():
            self._graph.add((node, names[name], self._plain(each)))
        return node

    def _list(self, values: Sequence[Node]) -> Node:
        if not values:
            return RDF.nil
        nodes: list[Node] = [BNode(f"b{next(self._numbers)}") for _ in values]
        for node, value, rest in zip(nodes, values, [*nodes[1:], RDF.nil], strict=True):
            self._graph.add((node, RDF.first, value))
            self._graph.add((node, RDF.rest, rest))
        return nodes[0]

    def _text(self, text: str) -> Literal:
        if _UNSAFE.search(text) is None:
            return Literal(text, datatype=XSD.string)
        return Literal(base64.b64encode(text.encode()).decode(), datatype=self._words.own.base64Text)


def holds_more_than(value: Any, most: int) -> bool:
    """Whether a value holds more than ``most`` values. Counting stops there.

    :param value: decoded JSON
    """
    waiting, found = [value], 0
    while waiting:
        each = waiting.pop()
        if not isinstance(each, list | dict):
            continue
        found += len(each)
        if found > most:
            return True
        waiting += each.values() if isinstance(each, dict) else each
    return False


def date_time(seconds: int, nanoseconds: int) -> Literal:
    """A time as ``xsd:dateTime``, in UTC and to the nanosecond."""
    seconds, nanoseconds = seconds + nanoseconds // 10**9, nanoseconds % 10**9
    day = (_EPOCH + timedelta(seconds=seconds)).strftime("%Y-%m-%dT%H:%M:%S")
    part = f".{nanoseconds:09d}".rstrip("0") if nanoseconds else ""
    return Literal(f"{day}{part}Z", datatype=XSD.dateTime)


def _date_time_of(value: Mapping[str, Any]) -> Literal | None:
    seconds, nanoseconds = value.get("sec"), value.get("nanosec")
    if type(seconds) is not int or type(nanoseconds) is not int:
        return None
    if not -(2**31) <= seconds < 2**31 or not 0 <= nanoseconds < 2**32:
        return None
    return date_time(seconds, nanoseconds)


def _number(value: Any) -> str:
    """A number or a boolean; ``null`` stands for NaN (SPEC 4)."""
    if value is None:
        return "NaN"
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _real(value: Any) -> str:
    return "NaN" if value is None else repr(float(value))


def _writer_for(kind: FieldType) -> _Write:
    return _real if kind.base in ("float32", "float64") else _number


def _json(value: Any) -> Literal:
    text = jsontext.encode(value).decode()
    # Only within strings: JSON escapes all other unsafe characters itself.
    return Literal(_UNSAFE.sub(lambda each: f"\\u{ord(each[0]):04x}", text), datatype=RDF.JSON)


_SENSES = ("sensor_msgs/",)
"""Prefixes of types that are measured by sensors."""

_MEASURED = frozenset(
    {
        "nav_msgs/msg/Odometry",
        "geometry_msgs/msg/AccelWithCovarianceStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "geometry_msgs/msg/TwistWithCovarianceStamped",
    }
)
"""Further types that are measured by sensors."""

_ORDERS = frozenset(
    {"sensor_msgs/msg/Joy", "sensor_msgs/msg/JoyFeedback", "sensor_msgs/msg/JoyFeedbackArray"}
)
"""Types of :data:`_SENSES` that are commands."""


def state_graph(state: TopicState, context: TopicContext, location: ResourceLocation) -> Graph:
    """A topic with its last message."""
    graph, words = _graph(location)
    topic = URIRef(location.of("topics", state.topic))
    values = ValueGraph(graph, words, context.definitions)
    graph.add((topic, RDF.type, words.own.Topic))
    _add_facts(values, topic, {"name": state.topic, "messageType": state.type})
    milliseconds = round(state.at * 1000)
    graph.add((topic, SOSA.resultTime, date_time(milliseconds // 1000, milliseconds % 1000 * 10**6)))
    _add_origin(graph, topic, state.type, context.moves, location)
    node = values.message(state.type, jsontext.decode_any(state.value))
    graph.add((topic, SOSA.hasResult, node))
    if (simple := _single_field(context.definitions.get(state.type))) is not None:
        for each in graph.objects(node, words.fields(state.type)[simple]):
            graph.add((topic, SOSA.hasSimpleResult, each))
    return graph


def param_graph(param: ParamState, location: ResourceLocation) -> Graph:
    graph, words = _graph(location)
    subject = URIRef(location.of("params", param.name))
    graph.add((subject, RDF.type, words.own.Parameter))
    values = ValueGraph(graph, words, {})
    _add_facts(values, subject, {"name": param.name})
    graph.add((subject, words.own.value, values.untyped(jsontext.decode_any(param.value))))
    return graph


def members_graph(part: str, page: Mapping[str, Any], location: ResourceLocation) -> Graph:
    """A page of a collection.

    :param page: as in JSON: the members under the key ``part``, and facts about the page
    """
    graph, words = _graph(location)
    collection = URIRef(location.of(part))
    values = ValueGraph(graph, words, {})
    graph.add((collection, RDF.type, words.own.Collection))
    _add_facts(values, collection, {name: value for name, value in page.items() if name != part})
    for each in page[part]:
        graph.add((collection, RDFS.member, _member(graph, words, part, each, location)))
    return graph


def member_graph(part: str, member: Mapping[str, Any], location: ResourceLocation) -> Graph:
    """One member of a collection.

    :param member: as in JSON
    """
    graph, words = _graph(location)
    _member(graph, words, part, member, location)
    return graph


def robot_graph(robot: Mapping[str, Any], location: ResourceLocation) -> Graph:
    """A robot and the addresses of its collections.

    :param robot: as in JSON
    """
    graph, words = _graph(location)
    subject = URIRef(location.address)
    for each in (words.own.Robot, SOSA.Platform):
        graph.add((subject, RDF.type, each))
    values = ValueGraph(graph, words, {})
    _add_facts(values, subject, robot)
    for part in _MEMBERS:
        collection = URIRef(location.of(part))
        graph.add((subject, words.own.collections, collection))
        graph.add((collection, RDF.type, words.own.Collection))
        _add_facts(values, collection, {"name": part})
    return graph


def camera_graph(camera: Mapping[str, Any], location: ResourceLocation) -> Graph:
    """A camera.

    :param camera: as in JSON
    """
    graph, words = _graph(location)
    subject, robot = URIRef(location.of("cameras", camera["name"])), URIRef(location.address)
    for each in (words.own.Camera, SOSA.Sensor):
        graph.add((subject, RDF.type, each))
    graph.add((subject, SOSA.isHostedBy, robot))
    graph.add((robot, RDF.type, SOSA.Platform))
    values = ValueGraph(graph, words, {})
    _add_facts(values, subject, {name: value for name, value in camera.items() if name != "addresses"})
    for relation, path in camera["addresses"].items():
        graph.add((subject, words.own[relation], URIRef(location.base + path)))
    return graph


def node_graph(node: Mapping[str, Any], location: ResourceLocation) -> Graph:
    """A node of the robot's graph, as an ``ssn:System``. A node may run on any machine, so no platform is
    named.

    :param node: as in JSON
    """
    graph, words = _graph(location)
    graph.bind("ssn", SSN)
    subject = URIRef(location.of("nodes", node["name"]))
    for each in (words.own.Node, SSN.System):
        graph.add((subject, RDF.type, each))
    _add_facts(ValueGraph(graph, words, {}), subject, {"name": node["name"]})
    for relation, target in _links(node, location):
        graph.add((subject, words.own[relation], target))
    return graph


_LINKS = {"publishes": "topics", "subscribes": "topics", "services": "services"}
"""Facts of a node that are names of other resources, and the collections of these."""

_MEMBERS = {
    "topics": "Topic",
    "services": "Service",
    "actions": "Action",
    "params": "Parameter",
    "cameras": "Camera",
    "nodes": "Node",
}
"""The class of a collection's members."""


def _graph(location: ResourceLocation) -> tuple[Graph, Vocabulary]:
    graph, words = Graph(bind_namespaces="none"), Vocabulary(location.base)
    own: dict[str, Any] = {"rdf": RDF, "rdfs": RDFS, "xsd": XSD, "sosa": SOSA, "switchboard": words.own}
    for prefix, namespace in own.items():
        graph.bind(prefix, namespace)
    return graph, words


def _member(
    graph: Graph, words: Vocabulary, part: str, facts: Mapping[str, Any], location: ResourceLocation
) -> URIRef:
    member = URIRef(location.of(part, facts["name"]))
    graph.add((member, RDF.type, words.own[_MEMBERS[part]]))
    own_facts = {name: value for name, value in facts.items() if name not in _LINKS}
    _add_facts(ValueGraph(graph, words, {}), member, own_facts)
    for relation, target in _links(facts, location):
        graph.add((member, words.own[relation], target))
    return member


def _add_origin(graph: Graph, topic: URIRef, type_name: str, moves: bool, location: ResourceLocation) -> None:
    """Add the sensor or the actuator that a message comes from."""
    robot = URIRef(location.address)
    if moves:
        actuator, motion = URIRef(f"{topic}#actuator"), URIRef(f"{robot}#motion")
        graph.add((topic, RDF.type, SOSA.Actuation))
        graph.add((topic, SOSA.madeByActuator, actuator))
        graph.add((topic, SOSA.actsOnProperty, motion))
        graph.add((actuator, RDF.type, SOSA.Actuator))
        graph.add((actuator, SOSA.isHostedBy, robot))
        graph.add((motion, RDF.type, SOSA.ActuatableProperty))
    elif type_name in _MEASURED or (type_name.startswith(_SENSES) and type_name not in _ORDERS):
        sensor = URIRef(f"{topic}#sensor")
        graph.add((topic, RDF.type, SOSA.Observation))
        graph.add((topic, SOSA.madeBySensor, sensor))
        graph.add((sensor, RDF.type, SOSA.Sensor))
        graph.add((sensor, SOSA.isHostedBy, robot))
    else:
        return
    graph.add((robot, RDF.type, SOSA.Platform))


def _single_field(definition: Definition | None) -> str | None:
    """The field of a message that has one scalar field only: ``data`` of ``std_msgs``."""
    if definition is None or [each.name for each in definition.fields] != ["data"]:
        return None
    kind = definition.fields[0].type
    return "data" if kind.shape is Shape.SCALAR and kind.primitive is not None else None


def _links(facts: Mapping[str, Any], location: ResourceLocation) -> Iterator[tuple[str, URIRef]]:
    for relation, part in _LINKS.items():
        for name in facts.get(relation, ()):
            yield relation, URIRef(location.of(part, name))


def _add_facts(values: ValueGraph, subject: URIRef, facts: Mapping[str, Any]) -> None:
    """Add facts as JSON has them. A list stands for several values without an order; empty values are left
    out."""
    for name, value in facts.items():
        for each in value if isinstance(value, list) else [value]:
            if each not in ("", None):
                values.add_fact(subject, name, each)
