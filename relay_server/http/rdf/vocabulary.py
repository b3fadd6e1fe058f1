"""The RDF vocabulary and its documents over HTTP."""

from __future__ import annotations

import html
import re
from contextlib import suppress
from functools import cache
from importlib import resources
from typing import NamedTuple

from rdflib import OWL, RDF, RDFS, SOSA, XSD, Graph, Literal, Namespace, URIRef
from rdflib.term import Node

from relay_protocol.errors import Invalid, NotFound
from relay_protocol.ros.definition import BYTES, Definition, FieldType, Shape, normalise
from relay_server.access import Access, Principal
from relay_server.common.concurrency import FairLock
from relay_server.common.database import BoundedThreadPool
from relay_server.common.etags import tag_of
from relay_server.http.endpoint import ApiRequest, Document, endpoint
from relay_server.http.media_types import JSON_LD, RDF_XML, TURTLE, MediaType
from relay_server.http.openapi.operation import Credential
from relay_server.http.rdf.serialize import LONGEST_IRI, write
from relay_server.relay_node.interfaces import TYPES
from relay_server.robots.registry import RobotRegistry

PATH = "/api/v1/vocabulary/"

DATATYPES = {
    "bool": XSD.boolean,
    "byte": XSD.unsignedByte,
    "char": XSD.unsignedByte,
    "int8": XSD.byte,
    "uint8": XSD.unsignedByte,
    "int16": XSD.short,
    "uint16": XSD.unsignedShort,
    "int32": XSD.int,
    "uint32": XSD.unsignedInt,
    "int64": XSD.long,
    "uint64": XSD.unsignedLong,
    "float32": XSD.float,
    "float64": XSD.double,
    "string": XSD.string,
    "wstring": XSD.string,
}
"""XML Schema datatypes of the basic types of ROS."""

TIME = "builtin_interfaces/msg/Time"

_LOCAL = r"[A-Za-z][A-Za-z0-9_]*"
_TYPE = re.compile(rf"({_LOCAL})/(?:(srv|action)/)?({_LOCAL})\Z")
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_NOTHING_KNOWN = "fields"
_OWN = "switchboard"


class FieldName(NamedTuple):
    """The field that a property's IRI names.

    :param type: full name of the message type; empty where it is not known
    """

    type: str
    name: str


class Vocabulary:
    """The words as they are written in responses.

    :param base: ``scheme://host[:port]`` of the relay, as the client sees it
    """

    def __init__(self, base: str) -> None:
        self._root = base + PATH
        self.own = Namespace(f"{self._root}{_OWN}#")
        self.untyped = Namespace(f"{self._root}{_NOTHING_KNOWN}#")

    def type(self, name: str) -> URIRef:
        """A message type.

        :param name: the full name, ``nav_msgs/msg/Odometry``
        """
        return URIRef(self._root + _short(name))

    def fields(self, name: str) -> Namespace:
        """The namespace of a message type's fields."""
        return Namespace(f"{self._root}{_short(name)}#")

    def list_of(self, datatype: URIRef) -> URIRef:
        """The datatype of a list of values of an XML Schema datatype, separated by spaces."""
        return self.own[f"{datatype.removeprefix(str(XSD))}List"]


def prefix_of(name: str) -> str:
    """The prefix for a type's namespace: ``nav_msgs_Odometry``."""
    return _short(name).replace("/", "_")


def can_be_field(name: str) -> bool:
    """Whether a key of JSON can be the end of a property's IRI in all forms."""
    return len(name) < LONGEST_IRI // 2 and _NAME.match(name) is not None


def type_of(iri: str) -> str | None:
    """The full name of the message type that an IRI stands for; ``None`` for foreign IRIs."""
    _, _, rest = iri.partition(PATH)
    match = _TYPE.match(rest)
    return None if match is None else f"{match[1]}/{match[2] or 'msg'}/{match[3]}"


def field_of(iri: str) -> FieldName | None:
    """The field that an IRI stands for; ``None`` for foreign IRIs."""
    _, _, rest = iri.partition(PATH)
    owner, _, name = rest.partition("#")
    if owner == _OWN or _NAME.match(name) is None:
        return None
    if owner == _NOTHING_KNOWN:
        return FieldName("", name)
    owner = type_of(PATH + owner) or ""
    return FieldName(owner, name) if owner else None


def own_word(iri: str) -> str | None:
    """The relay's own word in an IRI: ``value`` for ``…/vocabulary/switchboard#value``; ``None`` for other
    IRIs."""
    _, _, rest = iri.partition(PATH)
    owner, _, name = rest.partition("#")
    return name if owner == _OWN else None


def _short(name: str) -> str:
    package, kind, short = normalise(name).split("/")
    return f"{package}/{short}" if kind == "msg" else f"{package}/{kind}/{short}"


# --- documents that define the vocabulary -----------------------------------------------------------------

HTML = MediaType("text/html", "-html")
DOCUMENTS = (TURTLE, JSON_LD, RDF_XML, HTML)
"""The forms in which a document is served."""

OWN, FIELDS = "switchboard", "fields"
"""Documents that are the same on every relay: its own words, and fields whose type is not known."""

_ANYWHERE = "https://relay.invalid"
"""Stands for the relay in ``switchboard.ttl`` and in documents that are made once for all hosts."""

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head><meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title></head>
<body><h1>{title}</h1><p>{comment}</p><dl>
{terms}
</dl></body>
</html>
"""


def is_fixed(name: str) -> bool:
    """Whether a document with this name is the same on every relay."""
    return name in (OWN, FIELDS)


def fixed_document(name: str, form: MediaType, base: str) -> bytes:
    """The relay's own words, or an explanation of fields without a type.

    :param name: :data:`OWN` or :data:`FIELDS`
    :param form: one of :data:`DOCUMENTS`
    :param base: ``scheme://host[:port]`` of the relay, as the client sees it
    """
    # The syntax of a base is the same in all forms, so nothing of it has to be escaped.
    return _fixed_document(name, form).replace(_ANYWHERE.encode(), base.encode())


def type_document(definition: Definition, form: MediaType, base: str) -> bytes:
    """A message type and its fields.

    :param form: one of :data:`DOCUMENTS`
    :param base: as for :func:`fixed_document`
    """
    words = Vocabulary(base)
    about, fields = words.type(definition.name), words.fields(definition.name)
    graph = _document_graph(about)
    graph.add((about, RDF.type, RDFS.Class))
    _add_text(graph, about, RDFS.label, definition.name)
    _add_text(graph, about, RDFS.comment, f"A message of the ROS type {definition.name}.")
    for each in definition.fields:
        node = fields[each.name]
        graph.add((node, RDF.type, RDF.Property))
        _add_text(graph, node, RDFS.comment, f"The field {each.name}: {_ros_text(each.type)}")
        values = _range(words, each.type)
        if values is not None:
            graph.add((node, RDFS.range, values))
        graph.add((node, RDFS.domain, about))
        _add_label(graph, node, about)
    return _render(graph, about, form)


@cache
def _own_words() -> Graph:
    """``switchboard.ttl``, with the labels and ``rdfs:isDefinedBy`` that follow from the addresses."""
    about = URIRef(f"{_ANYWHERE}{PATH}{OWN}")
    graph = _document_graph(about)
    text = resources.files(__package__).joinpath("switchboard.ttl").read_text("utf-8")
    for subject, predicate, value in Graph().parse(data=text, format="turtle"):
        # Every literal of our documents says its datatype.
        text_value = Literal(str(value), datatype=XSD.string)
        graph.add((subject, predicate, text_value if isinstance(value, Literal) else value))
    for node in own_terms(graph).values():
        _add_label(graph, node, about)
    return graph


def own_terms(graph: Graph) -> dict[str, URIRef]:
    """The relay's own words that a graph describes, by their names, sorted."""
    found = ((own_word(str(node)), node) for node in graph.subjects(RDF.type, unique=True))
    return {name: node for name, node in sorted(found, key=str) if name and isinstance(node, URIRef)}


@cache
def _fixed_document(name: str, form: MediaType) -> bytes:
    about = URIRef(f"{_ANYWHERE}{PATH}{name}")
    graph = _document_graph(about)
    for subject in (about, *_own_words().subjects(RDFS.isDefinedBy, about)):
        for predicate, value in _own_words().predicate_objects(subject):
            graph.add((subject, predicate, value))
    return _render(graph, about, form)


def _document_graph(about: URIRef) -> Graph:
    graph = Graph(bind_namespaces="none")
    for prefix, namespace in {"rdf": RDF, "rdfs": RDFS, "xsd": XSD, "sosa": SOSA, "owl": OWL}.items():
        graph.bind(prefix, namespace)
    graph.bind("own", f"{about}#")
    return graph


def _add_text(graph: Graph, node: URIRef, predicate: URIRef, text: str) -> None:
    graph.add((node, predicate, Literal(text, datatype=XSD.string)))


def _add_label(graph: Graph, node: URIRef, about: URIRef) -> None:
    _add_text(graph, node, RDFS.label, _local_name(node))
    graph.add((node, RDFS.isDefinedBy, about))


def _range(words: Vocabulary, kind: FieldType) -> URIRef | None:
    """The type of a field's values; ``None`` for a field that is written in several ways (SPEC 1.13)."""
    if kind.shape is not Shape.SCALAR:
        return XSD.base64Binary if kind.base in BYTES else None
    return words.type(kind.base) if kind.primitive is None else DATATYPES[kind.base]


def _ros_text(kind: FieldType) -> str:
    """A type as ROS writes it: ``float64[3]``."""
    one = f"{kind.base}<={kind.bound}" if kind.bound else kind.base
    if kind.shape is Shape.SCALAR:
        return one
    if kind.shape is Shape.ARRAY:
        return f"{one}[{kind.length}]"
    return f"{one}[<={kind.length}]" if kind.length else f"{one}[]"


def _render(graph: Graph, about: URIRef, form: MediaType) -> bytes:
    return _html(graph, about) if form is HTML else write(graph, form)


def _html(graph: Graph, about: URIRef) -> bytes:
    terms = "\n".join(_html_term(graph, node) for node in graph.subjects(RDFS.isDefinedBy, about))
    title, comment = (html.escape(str(graph.value(about, each))) for each in (RDFS.label, RDFS.comment))
    return _PAGE.format(title=title, comment=comment, terms=terms).encode()


def _html_term(graph: Graph, node: Node) -> str:
    name, kind = html.escape(_local_name(node)), _local_name(graph.value(node, RDF.type)).lower()
    comment, values = str(graph.value(node, RDFS.comment)), graph.value(node, RDFS.range)
    link = ""
    if values is not None:
        link = f' Its values: <a href="{html.escape(str(values))}">{html.escape(_local_name(values))}</a>.'
    return f'<dt id="{name}"><b>{name}</b> ({kind})</dt><dd>{html.escape(comment)}{link}</dd>'


def _local_name(node: object) -> str:
    address = str(node)
    return address[max(address.rfind("#"), address.rfind("/")) + 1 :]


PLACE = "/api/v1/vocabulary"

_MESSAGE_TYPE = "A message type and its fields"
_PART_NAME = "name of one part: `…_Request`, `…_Response`, `…_Goal`, `…_Result`, `…_Feedback`"

NOT_KNOWN = (
    "this message type is not known from any robot that you have a right on: "
    "request a topic of that type as RDF, then repeat this request"
)


class TypeDocs:
    """Message types that the robots of a principal have reported.

    :param threads: convert documents
    """

    def __init__(self, access: Access, registry: RobotRegistry, threads: BoundedThreadPool) -> None:
        self._access = access
        self._registry = registry
        self._threads = threads
        self._fair_lock = FairLock()

    async def of_type(self, principal: Principal, name: str, form: MediaType, base: str) -> bytes:
        """The document of a message type.

        :param name: the full name
        :param base: ``scheme://host[:port]`` of the relay, as the client sees it
        :raises NotFound: no robot of the principal has reported the type
        :raises Unavailable: too many conversions are in progress
        """
        definition = await self._definition(principal, name)
        async with self._fair_lock.hold(principal.user_id):
            return await self._threads.run(type_document, definition, form, base)

    async def _definition(self, principal: Principal, name: str) -> Definition:
        robots = [self._registry.find(record.id) for record, _ in await self._access.robots(principal)]
        for types in (TYPES, *(robot.types for robot in robots if robot is not None)):
            with suppress(NotFound):
                return types.definitions(name)[name]
        raise NotFound(NOT_KNOWN)


class VocabularyEndpoints:
    """The RDF vocabulary and message types."""

    def __init__(self, types: TypeDocs) -> None:
        self._types = types

    @endpoint(
        "GET",
        f"{PLACE}/{{name}}",
        tag="relay",
        summary="Definitions of the RDF vocabulary",
        returns="the document",
        names={"name": "`switchboard`: the relay's own words, or `fields`: names of fields without a type"},
        forms=DOCUMENTS,
        credential=Credential.NONE,
    )
    async def words(self, request: ApiRequest, name: str) -> Document:
        if not is_fixed(name):
            raise NotFound("there is nothing at this address")
        return _document(fixed_document(name, request.form, request.base), request)

    @endpoint(
        "GET",
        f"{PLACE}/{{package}}/{{name}}",
        tag="relay",
        summary=_MESSAGE_TYPE,
        returns="the document",
        names={"name": "name of the type"},
        forms=DOCUMENTS,
    )
    async def message(self, request: ApiRequest, package: str, name: str) -> Document:
        return await self._type(request, f"{package}/msg/{name}")

    @endpoint(
        "GET",
        f"{PLACE}/{{package}}/srv/{{name}}",
        tag="relay",
        summary="A service type and its fields",
        returns="the document",
        names={"name": _PART_NAME},
        forms=DOCUMENTS,
    )
    async def service(self, request: ApiRequest, package: str, name: str) -> Document:
        return await self._type(request, f"{package}/srv/{name}")

    @endpoint(
        "GET",
        f"{PLACE}/{{package}}/action/{{name}}",
        tag="relay",
        summary="An action type and its fields",
        returns="the document",
        names={"name": _PART_NAME},
        forms=DOCUMENTS,
    )
    async def action(self, request: ApiRequest, package: str, name: str) -> Document:
        return await self._type(request, f"{package}/action/{name}")

    async def _type(self, request: ApiRequest, name: str) -> Document:
        try:
            known = normalise(name)
        except Invalid:
            raise NotFound(NOT_KNOWN) from None
        body = await self._types.of_type(request.principal, known, request.form, request.base)
        return _document(body, request)


def _document(body: bytes, request: ApiRequest) -> Document:
    form = request.form
    return Document(body, f"{form.media}; charset=utf-8", form.tag(tag_of(body)))
