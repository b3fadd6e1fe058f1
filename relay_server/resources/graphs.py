"""Values of JSON as graphs of RDF: messages by the definitions of their types, anything else by what it is.

Blank nodes are numbered, so that the same value gives the same graph.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timedelta, timezone
from itertools import count
from typing import Any

from rdflib import RDF, XSD, BNode, Graph, Literal, Namespace
from rdflib.term import Node

from relay_protocol import jsontext
from relay_protocol.ros.definition import BYTES, Definition, FieldType, Shape
from relay_server.resources.vocabulary import DATATYPES, TIME, Vocabulary, can_be_field, prefix_of

LONGEST_LIST = 100
"""An array that holds more values, all in all, is one literal."""

MOST_VALUES = 2000
"""In a message that holds more, every array is one literal."""

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
"""What a basic type is in JSON, where that is not an integer."""

_Write = Callable[[Any], str]


class ValueGraph:
    """Puts values into a graph.

    :param graph: which
    :param words: the vocabulary
    :param definitions: of the types that are known, by their full names
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

        :param value: decoded JSON; what does not fit the type is written as what it is
        """
        self._see(value)
        return self._message(type_name, value)

    def say(self, subject: Node, word: str, value: Any) -> None:
        """Say something of a resource in the relay's own words.

        :param value: decoded JSON
        """
        self._graph.add((subject, self._words.own[word], self.anything(value)))

    def anything(self, value: Any) -> Node:
        """Any decoded JSON."""
        self._see(value)
        return self._plain(value)

    def _see(self, value: Any) -> None:
        self._longest = 0 if larger(value, MOST_VALUES) else LONGEST_LIST

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
        if name == TIME and (moment := _moment(value)) is not None:
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
        if larger(value, self._longest):
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
        return Literal(_written(kind)(value), datatype=datatype)

    def _long(self, kind: FieldType, values: list[Any]) -> Node:
        python = set(_PYTHON.get(kind.base, (int,)))
        numbers = kind.primitive is not None and kind.primitive.code
        if not numbers or not set(map(type, values)) <= python:
            return _json(values)
        return Literal(" ".join(map(_written(kind), values)), datatype=self._words.many(DATATYPES[kind.base]))

    def _plain(self, value: Any) -> Node:
        """What has no definition."""
        if isinstance(value, str):
            return self._text(value)
        if isinstance(value, list):
            if larger(value, self._longest):
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


def larger(value: Any, most: int) -> bool:
    """Whether a value holds more than so many; no longer looked at than it takes to know.

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


def moment_of(seconds: int, nanoseconds: int) -> Literal:
    """A time as ``xsd:dateTime``, in UTC and to the nanosecond."""
    seconds, nanoseconds = seconds + nanoseconds // 10**9, nanoseconds % 10**9
    day = (_EPOCH + timedelta(seconds=seconds)).strftime("%Y-%m-%dT%H:%M:%S")
    part = f".{nanoseconds:09d}".rstrip("0") if nanoseconds else ""
    return Literal(f"{day}{part}Z", datatype=XSD.dateTime)


def _moment(value: Mapping[str, Any]) -> Literal | None:
    seconds, nanoseconds = value.get("sec"), value.get("nanosec")
    if type(seconds) is not int or type(nanoseconds) is not int:
        return None
    if not -(2**31) <= seconds < 2**31 or not 0 <= nanoseconds < 2**32:
        return None
    return moment_of(seconds, nanoseconds)


def _number(value: Any) -> str:
    """A number, or a boolean; ``null`` is what is not a number (SPEC section 4)."""
    if value is None:
        return "NaN"
    return str(value).lower() if isinstance(value, bool) else repr(value)


def _real(value: Any) -> str:
    return "NaN" if value is None else repr(float(value))


def _written(kind: FieldType) -> _Write:
    return _real if kind.base in ("float32", "float64") else _number


def _json(value: Any) -> Literal:
    text = jsontext.encode(value).decode()
    # Within strings alone, since what else is unsafe JSON escapes itself.
    return Literal(_UNSAFE.sub(lambda each: f"\\u{ord(each[0]):04x}", text), datatype=RDF.JSON)
