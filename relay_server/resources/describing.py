"""Resources as graphs of RDF: what a robot says, its parameters, what there is.

Source: W3C Semantic Sensor Network Ontology. What a sensor says is a ``sosa:Observation``, what moves the robot a
``sosa:Actuation``; of what else there is, only that it is there is said.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple
from urllib.parse import quote

from rdflib import RDF, RDFS, SOSA, SSN, XSD, Graph, URIRef

from relay_protocol import jsontext
from relay_protocol.ros.definition import Definition, Shape
from relay_server.resources.background import Background
from relay_server.resources.graphs import ValueGraph, moment_of
from relay_server.resources.states import Param, State
from relay_server.resources.vocabulary import Vocabulary

_SENSES = ("sensor_msgs/",)
"""How the types of what is measured begin."""

_MEASURED = frozenset(
    {
        "nav_msgs/msg/Odometry",
        "geometry_msgs/msg/AccelWithCovarianceStamped",
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "geometry_msgs/msg/TwistWithCovarianceStamped",
    }
)
"""Further ones."""

_ORDERS = frozenset(
    {"sensor_msgs/msg/Joy", "sensor_msgs/msg/JoyFeedback", "sensor_msgs/msg/JoyFeedbackArray"}
)
"""Those that say what is wanted."""


class Place(NamedTuple):
    """Where a robot's resources are.

    :param base: ``scheme://host[:port]`` of the relay, as who asks sees it
    :param robot: its name
    """

    base: str
    robot: str

    @property
    def address(self) -> str:
        """The robot's."""
        return f"{self.base}/api/v1/robots/{quote(self.robot)}"

    def of(self, part: str, name: str = "") -> str:
        """The address of a collection, or of one of its members."""
        return f"{self.address}/{part}" + (f"/{quote(name.lstrip('/'))}" if name else "")


def state_graph(state: State, shape: Background, place: Place) -> Graph:
    """What a topic says."""
    graph, words = _graph(place)
    topic = URIRef(place.of("topics", state.topic))
    values = ValueGraph(graph, words, shape.definitions)
    graph.add((topic, RDF.type, words.own.Topic))
    _say(values, topic, {"name": state.topic, "messageType": state.type})
    milliseconds = round(state.at * 1000)
    graph.add((topic, SOSA.resultTime, moment_of(milliseconds // 1000, milliseconds % 1000 * 10**6)))
    _made(graph, topic, state.type, shape.moves, place)
    node = values.message(state.type, jsontext.decode_any(state.value))
    graph.add((topic, SOSA.hasResult, node))
    if (simple := _simple(shape.definitions.get(state.type))) is not None:
        for each in graph.objects(node, words.fields(state.type)[simple]):
            graph.add((topic, SOSA.hasSimpleResult, each))
    return graph


def param_graph(param: Param, place: Place) -> Graph:
    """A parameter."""
    graph, words = _graph(place)
    subject = URIRef(place.of("params", param.name))
    graph.add((subject, RDF.type, words.own.Parameter))
    values = ValueGraph(graph, words, {})
    _say(values, subject, {"name": param.name})
    graph.add((subject, words.own.value, values.anything(jsontext.decode_any(param.value))))
    return graph


def members_graph(part: str, page: Mapping[str, Any], place: Place) -> Graph:
    """A page of a collection.

    :param page: as JSON has it: the members, with whatever is said of each, and the page's own facts
    """
    graph, words = _graph(place)
    collection = URIRef(place.of(part))
    values = ValueGraph(graph, words, {})
    graph.add((collection, RDF.type, words.own.Collection))
    _say(values, collection, {name: value for name, value in page.items() if name != part})
    for each in page[part]:
        graph.add((collection, RDFS.member, _member(graph, words, part, each, place)))
    return graph


def member_graph(part: str, member: Mapping[str, Any], place: Place) -> Graph:
    """One member of a collection, as its page tells of it.

    :param member: as JSON has it
    """
    graph, words = _graph(place)
    _member(graph, words, part, member, place)
    return graph


def robot_graph(robot: Mapping[str, Any], place: Place) -> Graph:
    """A robot, and where what it has is told.

    :param robot: as JSON has it
    """
    graph, words = _graph(place)
    subject = URIRef(place.address)
    for each in (words.own.Robot, SOSA.Platform):
        graph.add((subject, RDF.type, each))
    values = ValueGraph(graph, words, {})
    _say(values, subject, robot)
    for part in _MEMBERS:
        collection = URIRef(place.of(part))
        graph.add((subject, words.own.collections, collection))
        graph.add((collection, RDF.type, words.own.Collection))
        _say(values, collection, {"name": part})
    return graph


def camera_graph(camera: Mapping[str, Any], place: Place) -> Graph:
    """A camera.

    :param camera: as JSON has it
    """
    graph, words = _graph(place)
    subject, robot = URIRef(place.of("cameras", camera["name"])), URIRef(place.address)
    for each in (words.own.Camera, SOSA.Sensor):
        graph.add((subject, RDF.type, each))
    graph.add((subject, SOSA.isHostedBy, robot))
    graph.add((robot, RDF.type, SOSA.Platform))
    values = ValueGraph(graph, words, {})
    _say(values, subject, {name: value for name, value in camera.items() if name != "addresses"})
    for what, path in camera["addresses"].items():
        graph.add((subject, words.own[what], URIRef(place.base + path)))
    return graph


def module_graph(module: Mapping[str, Any], place: Place) -> Graph:
    """A module: a system. That the robot hosts it is not said: a node of its graph may run anywhere.

    :param module: as JSON has it
    """
    graph, words = _graph(place)
    graph.bind("ssn", SSN)
    subject = URIRef(place.of("modules", module["name"]))
    for each in (words.own.Module, SSN.System):
        graph.add((subject, RDF.type, each))
    _say(ValueGraph(graph, words, {}), subject, {"name": module["name"]})
    for what, target in _links(module, place):
        graph.add((subject, words.own[what], target))
    return graph


_LINKS = {"publishes": "topics", "subscribes": "topics", "services": "services"}
"""What a module has of other resources, and the collections these are in."""

_MEMBERS = {
    "topics": "Topic",
    "services": "Service",
    "actions": "Action",
    "params": "Parameter",
    "cameras": "Camera",
    "modules": "Module",
}
"""What a member of a collection is."""


def _graph(place: Place) -> tuple[Graph, Vocabulary]:
    graph, words = Graph(bind_namespaces="none"), Vocabulary(place.base)
    own: dict[str, Any] = {"rdf": RDF, "rdfs": RDFS, "xsd": XSD, "sosa": SOSA, "switchboard": words.own}
    for prefix, namespace in own.items():
        graph.bind(prefix, namespace)
    return graph, words


def _member(graph: Graph, words: Vocabulary, part: str, facts: Mapping[str, Any], place: Place) -> URIRef:
    member = URIRef(place.of(part, facts["name"]))
    graph.add((member, RDF.type, words.own[_MEMBERS[part]]))
    told = {name: value for name, value in facts.items() if name not in _LINKS}
    _say(ValueGraph(graph, words, {}), member, told)
    for what, target in _links(facts, place):
        graph.add((member, words.own[what], target))
    return member


def _made(graph: Graph, topic: URIRef, type_name: str, moves: bool, place: Place) -> None:
    """How what a topic says came about."""
    robot = URIRef(place.address)
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


def _simple(definition: Definition | None) -> str | None:
    """The one value of a message that is nothing but that: ``data`` of ``std_msgs``."""
    if definition is None or [each.name for each in definition.fields] != ["data"]:
        return None
    kind = definition.fields[0].type
    return "data" if kind.shape is Shape.SCALAR and kind.primitive is not None else None


def _links(facts: Mapping[str, Any], place: Place) -> Iterator[tuple[str, URIRef]]:
    """Facts that are other resources."""
    for what, part in _LINKS.items():
        for name in facts.get(what, ()):
            yield what, URIRef(place.of(part, name))


def _say(values: ValueGraph, subject: URIRef, facts: Mapping[str, Any]) -> None:
    """Facts as JSON has them, where lists stand for many in no order; what is empty is left out."""
    for name, value in facts.items():
        for each in value if isinstance(value, list) else [value]:
            if each not in ("", None):
                values.say(subject, name, each)
