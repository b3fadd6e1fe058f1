"""What the words of the vocabulary mean, as a document for programs and for people (SPEC section 1.13).

Source: RDF Schema 1.1.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping
from functools import cache
from typing import NamedTuple

from rdflib import OWL, RDF, RDFS, SOSA, XSD, Graph, Literal, URIRef

from relay_protocol.ros.definition import BYTES, Definition, FieldType, Shape
from relay_server.http.media_types import JSON_LD, RDF_XML, TURTLE, MediaType
from relay_server.http.rdf.serialize import write
from relay_server.http.rdf.vocabulary import DATATYPES, PATH, Vocabulary

HTML = MediaType("text/html", "-html")
DOCUMENTS = (TURTLE, JSON_LD, RDF_XML, HTML)
"""The forms that meanings are told in."""

OWN, FIELDS = "switchboard", "fields"
"""Documents that are the same on every relay: its own words, and names of fields of which no type is known."""

_ANYWHERE = "https://relay.invalid"
"""Stands for the relay where a document is made once for all hosts."""

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head><meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title></head>
<body><h1>{title}</h1><p>{words}</p><dl>
{terms}
</dl></body>
</html>
"""


class Term(NamedTuple):
    """A word.

    :param kind: what it is
    :param words: what it means
    :param range: what its values are, of a property
    """

    kind: URIRef
    words: str
    range: URIRef | None = None


class VocabularyPage(NamedTuple):
    """A document.

    :param address: of what it is about
    :param words: what that is
    :param kind: of that
    :param terms: further ones it tells of, by their addresses
    :param domain: what its properties are said of, where that is one thing
    """

    address: str
    title: str
    words: str
    kind: URIRef
    terms: Mapping[str, Term]
    domain: URIRef | None = None


_CLASS, _PROPERTY, _DATATYPE = RDFS.Class, RDF.Property, RDFS.Datatype

WORDS: dict[str, Term] = {
    "Robot": Term(_CLASS, "A robot."),
    "Topic": Term(_CLASS, "A topic of a robot."),
    "Service": Term(_CLASS, "A service of a robot."),
    "Action": Term(_CLASS, "An action of a robot."),
    "Parameter": Term(_CLASS, "A parameter of a node of a robot."),
    "Camera": Term(_CLASS, "A camera of a robot."),
    "Module": Term(_CLASS, "A node in the graph of a robot."),
    "Collection": Term(_CLASS, "A page of what there is of a kind; its members are told by rdfs:member."),
    "Object": Term(_CLASS, "An object of JSON without a type that is known."),
    "name": Term(_PROPERTY, "The name of a robot, or of a resource within its robot.", XSD.string),
    "messageType": Term(_PROPERTY, "The ROS type of what a topic says.", XSD.string),
    "types": Term(_PROPERTY, "A ROS type of a topic, a service or an action.", XSD.string),
    "type": Term(_PROPERTY, "The ROS type of the topic a camera shows.", XSD.string),
    "publishers": Term(_PROPERTY, "A node that publishes a topic.", XSD.string),
    "subscribers": Term(_PROPERTY, "A node that subscribes to a topic.", XSD.string),
    "providers": Term(_PROPERTY, "A node that offers a service or an action.", XSD.string),
    "publishes": Term(_PROPERTY, "The address of a topic that a module publishes."),
    "subscribes": Term(_PROPERTY, "The address of a topic that a module subscribes to."),
    "services": Term(_PROPERTY, "The address of a service that a module offers."),
    "moves": Term(
        _PROPERTY, "Whether it moves the robot: whoever uses it has to control the robot.", XSD.boolean
    ),
    "online": Term(_PROPERTY, "Whether the robot is connected to the relay.", XSD.boolean),
    "next": Term(_PROPERTY, "The name behind which the next page of a collection begins.", XSD.string),
    "value": Term(_PROPERTY, "The value of a parameter."),
    "encoding": Term(_PROPERTY, "The encoding of a camera's last picture.", XSD.string),
    "width": Term(_PROPERTY, "The width of a camera's last picture in pixels.", XSD.integer),
    "height": Term(_PROPERTY, "The height of a camera's last picture in pixels.", XSD.integer),
    "fps": Term(_PROPERTY, "The pictures a camera gives in a second.", XSD.double),
    "seen": Term(
        _PROPERTY, "When a camera was as it is told, Unix time at the robot in seconds.", XSD.double
    ),
    "streams": Term(_PROPERTY, "How a camera is shown now."),
    "snapshot": Term(_PROPERTY, "The address of one picture of a camera."),
    "stream": Term(_PROPERTY, "The address of a camera's pictures as multipart/x-mixed-replace."),
    "viewer": Term(_PROPERTY, "The address of a page that shows a camera."),
    "websocket": Term(_PROPERTY, "The address of the websocket for a camera's pictures."),
    "collections": Term(_PROPERTY, "The address of a collection of what a robot has."),
    "description": Term(_PROPERTY, "A line for people.", XSD.string),
    "state": Term(_PROPERTY, "Whether a robot is offline, online or in_use.", XSD.string),
    "level": Term(_PROPERTY, "What who asks may do with a robot: viewer, operator or owner.", XSD.string),
    "clients": Term(_PROPERTY, "Somebody who works with a robot or watches it, as far as who asks may know."),
    "people": Term(_PROPERTY, "How many users are at a robot.", XSD.integer),
    "holder": Term(_PROPERTY, "The user who moves a robot.", XSD.string),
    "stopped": Term(_PROPERTY, "By whom a robot is stopped, why, and since when."),
    "suppressed": Term(_PROPERTY, "A topic that is commanded by others than who moves the robot."),
    "inhibited": Term(_PROPERTY, "A topic that is kept quiet."),
    "battery": Term(_PROPERTY, "The charge of a robot's battery, 0 to 1.", XSD.double),
    "rtt_ms": Term(_PROPERTY, "The round trip to a robot in milliseconds.", XSD.double),
    "quality": Term(_PROPERTY, "How good the way to a robot is: good, fair, bad or lost.", XSD.string),
    "host": Term(_PROPERTY, "The name of a robot's machine.", XSD.string),
    "platform": Term(_PROPERTY, "What a robot runs.", XSD.string),
    "distro": Term(_PROPERTY, "Which distribution of ROS a robot runs.", XSD.string),
    "last_seen": Term(_PROPERTY, "When a robot was last heard of, Unix time in seconds.", XSD.double),
    "dateTime": Term(_PROPERTY, "The moment that a builtin_interfaces/Time is.", XSD.dateTime),
    "base64Text": Term(_DATATYPE, "Text that XML can't hold: its UTF-8 in base64."),
    **{
        f"{each.removeprefix(str(XSD))}List": Term(
            _DATATYPE, f"Values of xsd:{each.removeprefix(str(XSD))}, separated by spaces."
        )
        for each in sorted(set(DATATYPES.values()) - {XSD.string})
    },
}
"""The relay's own."""


def is_fixed(name: str) -> bool:
    """Whether it is the name of a document that is the same on every relay."""
    return name in (OWN, FIELDS)


def fixed(name: str, form: MediaType, base: str) -> bytes:
    """The relay's own words, or what fields without a type are, in one of :data:`DOCUMENTS`.

    :param name: :data:`OWN` or :data:`FIELDS`
    :param base: ``scheme://host[:port]`` of the relay, as who asks sees it
    """
    # By its syntax a base is the same in all forms: nothing of it has to be escaped.
    return _fixed(name, form).replace(_ANYWHERE.encode(), base.encode())


@cache
def _fixed(name: str, form: MediaType) -> bytes:
    words = Vocabulary(_ANYWHERE)
    address = f"{_ANYWHERE}{PATH}{name}"
    if name == OWN:
        terms = {str(words.own[word]): term for word, term in WORDS.items()}
        said = "What a Switchboard relay says of the resources of robots, beside the words of SOSA and SSN."
        return _written(VocabularyPage(address, "Words of a relay", said, OWL.Ontology, terms), form)
    said = (
        "Names of fields in values of which no type is known: what stands behind '#' is the field's name, and means "
        "what the robot means by it."
    )
    return _written(VocabularyPage(address, "Fields without a type", said, OWL.Ontology, {}), form)


def of_type(definition: Definition, form: MediaType, base: str) -> bytes:
    """What a type of messages is, in one of :data:`DOCUMENTS`.

    :param definition: as a robot tells it
    :param base: as for :func:`fixed`
    """
    words = Vocabulary(base)
    address, fields = words.type(definition.name), words.fields(definition.name)
    terms = {
        str(fields[each.name]): Term(
            _PROPERTY, f"The field {each.name}: {_in_ros(each.type)}", _range(words, each.type)
        )
        for each in definition.fields
    }
    said = f"A message of the ROS type {definition.name}."
    return _written(VocabularyPage(str(address), definition.name, said, _CLASS, terms, address), form)


def _range(words: Vocabulary, kind: FieldType) -> URIRef | None:
    """What the values of a field are; ``None`` where it is told in several ways (SPEC section 1.13)."""
    if kind.shape is not Shape.SCALAR:
        return XSD.base64Binary if kind.base in BYTES else None
    return words.type(kind.base) if kind.primitive is None else DATATYPES[kind.base]


def _in_ros(kind: FieldType) -> str:
    """A type as ROS writes it."""
    one = f"{kind.base}<={kind.bound}" if kind.bound else kind.base
    if kind.shape is Shape.SCALAR:
        return one
    if kind.shape is Shape.ARRAY:
        return f"{one}[{kind.length}]"
    return f"{one}[<={kind.length}]" if kind.length else f"{one}[]"


def _written(page: VocabularyPage, form: MediaType) -> bytes:
    return _html(page) if form is HTML else write(_graph(page), form)


def _graph(page: VocabularyPage) -> Graph:
    graph = Graph(bind_namespaces="none")
    for prefix, namespace in {"rdf": RDF, "rdfs": RDFS, "xsd": XSD, "sosa": SOSA, "owl": OWL}.items():
        graph.bind(prefix, namespace)
    graph.bind("own", f"{page.address}#")
    about = URIRef(page.address)
    graph.add((about, RDF.type, page.kind))
    _say(graph, about, page.title, page.words)
    for address, term in page.terms.items():
        node = URIRef(address)
        graph.add((node, RDF.type, term.kind))
        _say(graph, node, _local(address), term.words)
        graph.add((node, RDFS.isDefinedBy, about))
        if term.range is not None:
            graph.add((node, RDFS.range, term.range))
        if page.domain is not None:
            graph.add((node, RDFS.domain, page.domain))
    return graph


def _say(graph: Graph, node: URIRef, label: str, words: str) -> None:
    graph.add((node, RDFS.label, Literal(label, datatype=XSD.string)))
    graph.add((node, RDFS.comment, Literal(words, datatype=XSD.string)))


def _html(page: VocabularyPage) -> bytes:
    terms = "\n".join(_row(address, term) for address, term in page.terms.items())
    text = _PAGE.format(title=html.escape(page.title), words=html.escape(page.words), terms=terms)
    return text.encode()


def _row(address: str, term: Term) -> str:
    name, kind = html.escape(_local(address)), _local(str(term.kind)).lower()
    values = ""
    if term.range is not None:
        values = (
            f' Its values: <a href="{html.escape(term.range)}">{html.escape(_local(str(term.range)))}</a>.'
        )
    return f'<dt id="{name}"><b>{name}</b> ({kind})</dt><dd>{html.escape(term.words)}{values}</dd>'


def _local(address: str) -> str:
    cut: Iterable[int] = (address.rfind("#"), address.rfind("/"))
    return address[max(cut) + 1 :]
