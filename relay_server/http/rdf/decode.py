"""Graphs of RDF as values of JSON: what :mod:`relay_server.http.rdf.encode` made, and what programs make alike.

Types are not looked at, but for their names: the JSON is checked as any other is. Nothing is passed over: a field that
is there twice, or is a field of something else, is refused.
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

_REMARKS = {RDFS.label, RDFS.comment}
"""What may be said of anything, and means nothing here."""

_FLOAT = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,6})?\Z")
_INTEGER = re.compile(r"[+-]?[0-9]{1,20}\Z")
_MOMENT = re.compile(
    r"([0-9]{4}-[0-9]{2}-[0-9]{2}T[0-9]{2}:[0-9]{2}:[0-9]{2})(?:\.([0-9]{1,9}))?(Z|[+-][0-9]{2}:[0-9]{2})\Z"
)
_BOOLEANS = {"true": True, "1": True, "false": False, "0": False}


class DecodedGraph(NamedTuple):
    """What a graph says of a resource.

    :param type: of the message, in full; empty where that is not said
    :param value: JSON
    """

    type: str
    value: Any


def message_in(graph: Graph, path: str) -> DecodedGraph:
    """The message that a graph gives as the result of a topic.

    :param path: the topic's, whichever host it is asked by
    :raises Invalid: there is not one, or what there is makes no sense; in words
    """
    simple = False
    found = _of(graph, path, SOSA.hasResult)
    if not found:
        found, simple = _of(graph, path, SOSA.hasSimpleResult), True
    _see_one(found, path, "sosa:hasResult")
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
        if own_word(str(predicate)) == "value" and _is(subject, path)
    ]
    _see_one(found, path, "…/api/v1/vocabulary/switchboard#value")
    return _GraphReader(graph).value(found[0], "value", 0)


def _of(graph: Graph, path: str, predicate: URIRef) -> list[Node]:
    return [value for subject, value in graph.subject_objects(predicate) if _is(subject, path)]


def _is(subject: Node, path: str) -> bool:
    """Whether a subject is the resource at a path; proxies change the host, and how it is reached."""
    return isinstance(subject, URIRef) and subject.partition("://")[2].partition("/")[2] == path.lstrip("/")


def _see_one(found: list[Node], path: str, word: str) -> None:
    if len(found) != 1:
        raise Invalid(
            f"say {word} of the resource itself, <> or its address (…{path[:200]}), once; it is there "
            f"{len(found)} times"
        )


class _GraphReader:
    """Reads the values of one graph. A node has one place: else a small graph could stand for a huge value."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._read: set[Node] = set()

    def value(self, term: Node, place: str, depth: int) -> Any:
        """JSON of what stands at a place."""
        if isinstance(term, Literal):
            return _of_literal(term, place)
        if term == RDF.nil:
            return []
        if depth >= JSON_DEPTH:
            raise Invalid(f"it is nested deeper than {JSON_DEPTH}")
        if isinstance(term, URIRef) and (term, None, None) not in self._graph:
            raise Invalid(f"{place} must be a value or a node, not an address")
        if (term, RDF.first, None) in self._graph:
            return [self.value(each, place, depth + 1) for each in self._members(term, place)]
        return self._node(term, place, depth)

    def type_of(self, node: Node) -> str:
        """The full name of the message that a node is; empty where it says none."""
        types = {type_of(str(each)) for each in self._graph.objects(node, RDF.type)}
        words = (field_of(str(each)) for each in self._graph.predicates(node))
        types |= {each.type or None for each in words if each is not None}
        named = sorted(each for each in types if each is not None)
        if len(named) > 1:
            raise Invalid(f"a node is {named[0]} and {named[1]} at once")
        return named[0] if named else ""

    def _take(self, node: Node, place: str) -> None:
        if node in self._read:
            raise Invalid(f"a node is in several places, or within itself: {place}")
        self._read.add(node)

    def _node(self, node: Node, place: str, depth: int) -> dict[str, Any]:
        self._take(node, place)
        self.type_of(node)
        found: dict[str, Any] = {}
        moment: Any = None
        for predicate, each in self._graph.predicate_objects(node):
            if predicate == RDF.type or predicate in _REMARKS:
                continue
            word = field_of(str(predicate))
            if word is None and own_word(str(predicate)) == "dateTime":
                moment = self.value(each, place, depth + 1)
                continue
            if word is None:
                raise Invalid(f"<{str(predicate)[:200]}> is no field of a message")
            if word.name in found:
                raise Invalid(f"{place} has '{word.name}' more than once")
            found[word.name] = self.value(each, word.name, depth + 1)
        # The exact numbers count where they are there too.
        return found or moment or found

    def _members(self, start: Node, place: str) -> list[Node]:
        members: list[Node] = []
        node = start
        while node != RDF.nil:
            self._take(node, place)
            first, rest = (
                list(self._graph.objects(node, RDF.first)),
                list(self._graph.objects(node, RDF.rest)),
            )
            if len(first) != 1 or len(rest) != 1 or not isinstance(rest[0], BNode | URIRef):
                raise Invalid(f"{place} is no whole list")
            members.append(first[0])
            node = rest[0]
        return members


def _of_literal(literal: Literal, place: str) -> Any:
    datatype, text = literal.datatype, str(literal)
    if datatype is None:
        return text
    own = own_word(str(datatype))
    if own is not None and own.endswith("List"):
        read = _READ.get(XSD[own.removesuffix("List")] if own in _LISTS else None)
        if read is not None:
            return [read(each, place) for each in text.split()]
    read = _text_read if own == "base64Text" else _READ.get(datatype)
    if read is None:
        raise Invalid(f"{place}: values of the datatype <{str(datatype)[:200]}> are not known")
    return read(text, place)


def _none(text: str, place: str, what: str) -> Invalid:
    return Invalid(f"{place}: '{text[:40]}' is no {what}")


def _float_read(text: str, place: str) -> float | str | None:
    text = text.strip()
    if text == "NaN":
        return None
    if text.lstrip("+-") == "INF":
        return nonfinite.INFINITE[text.startswith("-")]
    if _FLOAT.match(text) is None:
        raise _none(text, place, "number")
    number = float(text)
    if number in (float("inf"), float("-inf")):
        raise Invalid(f"{place} is out of range")
    return number


def _integer_read(text: str, place: str) -> int:
    if _INTEGER.match(text.strip()) is None:
        raise _none(text, place, "integer of up to 64 bits")
    return int(text)


def _boolean_read(text: str, place: str) -> bool:
    found = _BOOLEANS.get(text.strip())
    if found is None:
        raise _none(text, place, "boolean")
    return found


def _bytes_read(text: str, place: str) -> str:
    return "".join(text.split())


def _text_read(text: str, place: str) -> str:
    try:
        return base64.b64decode(text, validate=True).decode()
    except (binascii.Error, ValueError):
        raise _none(text, place, "UTF-8 in base64") from None


def _json_read(text: str, place: str) -> Any:
    try:
        return jsontext.decode_any(text.encode())
    except (MalformedMessage, UnicodeEncodeError) as error:
        raise Invalid(f"{place}: {error}") from None


def _moment_read(text: str, place: str) -> dict[str, int]:
    match = _MOMENT.match(text.strip())
    try:
        if match is None:
            raise ValueError
        zone = "+00:00" if match[3] == "Z" else match[3]
        since = datetime.fromisoformat(match[1] + zone) - datetime(1970, 1, 1, tzinfo=timezone.utc)
    except (ValueError, OverflowError):
        raise _none(text, place, "xsd:dateTime with its zone") from None
    return {"sec": since // timedelta(seconds=1), "nanosec": int((match[2] or "").ljust(9, "0"))}


_Read = Callable[[str, str], Any]
_INTEGERS = (
    "integer int long short byte unsignedInt unsignedLong unsignedShort unsignedByte nonNegativeInteger "
    "positiveInteger nonPositiveInteger negativeInteger"
)
_READ: dict[URIRef | None, _Read] = {
    XSD.boolean: _boolean_read,
    XSD.double: _float_read,
    XSD.float: _float_read,
    XSD.decimal: _float_read,
    XSD.string: lambda text, place: text,
    RDF.langString: lambda text, place: text,
    XSD.base64Binary: _bytes_read,
    XSD.dateTime: _moment_read,
    RDF.JSON: _json_read,
    **{XSD[each]: _integer_read for each in _INTEGERS.split()},
}
_LISTS = frozenset(f"{each.removeprefix(str(XSD))}List" for each in DATATYPES.values())
