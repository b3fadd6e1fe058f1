"""RDF graphs as JSON values: those of :mod:`relay_server.http.rdf.encode`, and equivalent ones that clients
write.

Only the names of types are read here; the JSON is checked against the type later, as any other is. Nothing is
ignored: a field that occurs twice, or belongs to another type, is rejected.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from typing import Any, NamedTuple

from rdflib import RDF, RDFS, SOSA, XSD, BNode, Graph, Literal, URIRef
from rdflib.term import Node

from relay_protocol import jsontext, nonfinite
from relay_protocol.errors import Invalid, MalformedMessage
from relay_protocol.limits import JSON_DEPTH
from relay_server.http.rdf.vocabulary import DATATYPES, field_of, own_word, type_of

_ANNOTATIONS = {RDFS.label, RDFS.comment}
"""Statements that any resource may have, and that have no meaning here."""

_FLOAT = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,6})?\Z")
_INTEGER = re.compile(r"[+-]?[0-9]{1,20}\Z")
_DATE_TIME = re.compile(
    r"([0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2})(?:\.([0-9]{1,9}))?(Z|[+-][0-9]{2}:[0-9]{2})\Z"
)
_BOOLEANS = {"true": True, "1": True, "false": False, "0": False}


class DecodedGraph(NamedTuple):
    """The message in a graph.

    :param type: its full name; empty if the graph does not name it
    :param value: JSON
    """

    type: str
    value: Any


def message_in(graph: Graph, path: str) -> DecodedGraph:
    """The message that a graph gives as the result of a topic.

    :param path: of the topic's address; the host is not compared
    :raises Invalid: there is no such message, or it is not valid
    """
    simple = False
    found = _results(graph, path, SOSA.hasResult)
    if not found:
        found, simple = _results(graph, path, SOSA.hasSimpleResult), True
    _expect_one(found, path, "sosa:hasResult")
    reader = _GraphReader(graph)
    if simple:
        return DecodedGraph("", {"data": reader.value(found[0], "sosa:hasSimpleResult", 0)})
    value = reader.value(found[0], "sosa:hasResult", 0)
    if not isinstance(value, dict):
        raise Invalid("sosa:hasResult must be a message: a node with fields")
    return DecodedGraph(reader.type_of(found[0]), value)


def value_in(graph: Graph, path: str) -> Any:
    """The value that a graph gives a parameter; see :func:`message_in`."""
    found = [
        each
        for subject, predicate, each in graph
        if own_word(str(predicate)) == "value" and _is_resource(subject, path)
    ]
    _expect_one(found, path, "…/api/v1/vocabulary/switchboard#value")
    return _GraphReader(graph).value(found[0], "value", 0)


def _results(graph: Graph, path: str, predicate: URIRef) -> list[Node]:
    return [value for subject, value in graph.subject_objects(predicate) if _is_resource(subject, path)]


def _is_resource(subject: Node, path: str) -> bool:
    """Whether a subject is the resource at a path. Proxies change the scheme and host, so they are not
    compared."""
    return isinstance(subject, URIRef) and subject.partition("://")[2].partition("/")[2] == path.lstrip("/")


def _expect_one(found: list[Node], path: str, field: str) -> None:
    if len(found) != 1:
        raise Invalid(
            f"give {field} of the resource itself, <> or its address (…{path[:200]}), exactly once; it is there "
            f"{len(found)} times"
        )


class _GraphReader:
    """Reads the values of one graph. A node may occur in one place only, so a small graph cannot stand for a
    huge value."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._read: set[Node] = set()

    def value(self, term: Node, place: str, depth: int) -> Any:
        """A term as JSON.

        :param place: name of the property, for errors
        """
        if isinstance(term, Literal):
            return _literal_value(term, place)
        if term == RDF.nil:
            return []
        if depth >= JSON_DEPTH:
            raise Invalid(f"the value is nested deeper than {JSON_DEPTH} levels")
        if isinstance(term, URIRef) and (term, None, None) not in self._graph:
            raise Invalid(f"{place} must be a value or a node, not an address")
        if (term, RDF.first, None) in self._graph:
            return [self.value(each, place, depth + 1) for each in self._members(term, place)]
        return self._node(term, place, depth)

    def type_of(self, node: Node) -> str:
        """The full name of a node's message type; empty if the graph does not name it."""
        types = {type_of(str(each)) for each in self._graph.objects(node, RDF.type)}
        words = (field_of(str(each)) for each in self._graph.predicates(node))
        types |= {each.type or None for each in words if each is not None}
        named = sorted(each for each in types if each is not None)
        if len(named) > 1:
            raise Invalid(f"a node has two types at once: {named[0]} and {named[1]}")
        return named[0] if named else ""

    def _mark_read(self, node: Node, place: str) -> None:
        if node in self._read:
            raise Invalid(f"a node is in several places, or within itself: {place}")
        self._read.add(node)

    def _node(self, node: Node, place: str, depth: int) -> dict[str, Any]:
        self._mark_read(node, place)
        self.type_of(node)
        found: dict[str, Any] = {}
        date_time: Any = None
        for predicate, each in self._graph.predicate_objects(node):
            if predicate == RDF.type or predicate in _ANNOTATIONS:
                continue
            field = field_of(str(predicate))
            if field is None and own_word(str(predicate)) == "dateTime":
                date_time = self.value(each, place, depth + 1)
                continue
            if field is None:
                raise Invalid(f"<{str(predicate)[:200]}> is not a field of a message")
            if field.name in found:
                raise Invalid(f"{place} has '{field.name}' more than once")
            found[field.name] = self.value(each, field.name, depth + 1)
        # Where both are given, the fields count: they are exact.
        return found or date_time or found

    def _members(self, start: Node, place: str) -> list[Node]:
        members: list[Node] = []
        node = start
        while node != RDF.nil:
            self._mark_read(node, place)
            first, rest = (
                list(self._graph.objects(node, RDF.first)),
                list(self._graph.objects(node, RDF.rest)),
            )
            if len(first) != 1 or len(rest) != 1 or not isinstance(rest[0], BNode | URIRef):
                raise Invalid(f"{place} is not a complete list")
            members.append(first[0])
            node = rest[0]
        return members


def _literal_value(literal: Literal, place: str) -> Any:
    datatype, text = literal.datatype, str(literal)
    if datatype is None:
        return text
    own = own_word(str(datatype))
    if own is not None and own.endswith("List"):
        read = _READ.get(XSD[own.removesuffix("List")] if own in _LISTS else None)
        if read is not None:
            return [read(each, place) for each in text.split()]
    read = _read_text if own == "base64Text" else _READ.get(datatype)
    if read is None:
        raise Invalid(f"{place}: the datatype <{str(datatype)[:200]}> is not supported")
    return read(text, place)


def _not_a(text: str, place: str, what: str) -> Invalid:
    return Invalid(f"{place}: '{text[:40]}' is not {what}")


def _read_float(text: str, place: str) -> float | str | None:
    text = text.strip()
    if text == "NaN":
        return None
    if text.lstrip("+-") == "INF":
        return nonfinite.INFINITE[text.startswith("-")]
    if _FLOAT.match(text) is None:
        raise _not_a(text, place, "a number")
    number = float(text)
    if number in (float("inf"), float("-inf")):
        raise Invalid(f"{place} is out of range")
    return number


def _read_integer(text: str, place: str) -> int:
    if _INTEGER.match(text.strip()) is None:
        raise _not_a(text, place, "an integer of up to 64 bits")
    return int(text)


def _read_boolean(text: str, place: str) -> bool:
    found = _BOOLEANS.get(text.strip())
    if found is None:
        raise _not_a(text, place, "a boolean")
    return found


def _read_bytes(text: str, place: str) -> str:
    return "".join(text.split())


def _read_text(text: str, place: str) -> str:
    try:
        return base64.b64decode(text, validate=True).decode()
    except (binascii.Error, ValueError):
        raise _not_a(text, place, "UTF-8 in base64") from None


def _read_json(text: str, place: str) -> Any:
    try:
        return jsontext.decode_any(text.encode())
    except (MalformedMessage, UnicodeEncodeError) as error:
        raise Invalid(f"{place}: {error}") from None


def _read_date_time(text: str, place: str) -> dict[str, int]:
    match = _DATE_TIME.match(text.strip())
    try:
        if match is None:
            raise ValueError
        zone = "+00:00" if match[3] == "Z" else match[3]
        since = datetime.fromisoformat(match[1] + zone) - datetime(1970, 1, 1, tzinfo=timezone.utc)
    except (ValueError, OverflowError):
        raise _not_a(text, place, "an xsd:dateTime with a time zone") from None
    return {"sec": since // timedelta(seconds=1), "nanosec": int((match[2] or "").ljust(9, "0"))}


_Read = Callable[[str, str], Any]
_INTEGERS = (
    "integer int long short byte unsignedInt unsignedLong unsignedShort unsignedByte nonNegativeInteger "
    "positiveInteger nonPositiveInteger negativeInteger"
)
_READ: dict[URIRef | None, _Read] = {
    XSD.boolean: _read_boolean,
    XSD.double: _read_float,
    XSD.float: _read_float,
    XSD.decimal: _read_float,
    XSD.string: lambda text, place: text,
    RDF.langString: lambda text, place: text,
    XSD.base64Binary: _read_bytes,
    XSD.dateTime: _read_date_time,
    RDF.JSON: _read_json,
    **{XSD[each]: _read_integer for each in _INTEGERS.split()},
}
_LISTS = frozenset(f"{each.removeprefix(str(XSD))}List" for each in DATATYPES.values())
