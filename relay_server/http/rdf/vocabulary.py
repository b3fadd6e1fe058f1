"""Words for what a robot says, as IRIs: those of SOSA and XML Schema where they fit, else ones of the relay's own.

A field of a message is ``…/api/v1/vocabulary/<package>/<Type>#<field>``, whichever host the relay is asked by. What has
no type that is known is ``…/api/v1/vocabulary/fields#<name>``, what the relay itself says of resources
``…/api/v1/vocabulary/switchboard#<word>``.

Source: W3C Semantic Sensor Network Ontology (SOSA), XML Schema part 2.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from rdflib import XSD, Namespace, URIRef

from relay_protocol.ros.definition import normalise

PATH = "/api/v1/vocabulary/"
LONGEST_IRI = 1024
"""Characters; longer ones are refused, since a short prefix can stand for a long one many times."""

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
"""Of the basic types of ROS."""

TIME = "builtin_interfaces/msg/Time"

_LOCAL = r"[A-Za-z][A-Za-z0-9_]*"
_TYPE = re.compile(rf"({_LOCAL})/(?:(srv|action)/)?({_LOCAL})\Z")
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*\Z")
_NOTHING_KNOWN = "fields"
_OWN = "switchboard"


class VocabularyTerm(NamedTuple):
    """What a property's IRI says.

    :param type: full name of the message it is a field of; empty where that is not known
    :param name: of the field
    """

    type: str
    name: str


class Vocabulary:
    """The words, as they are written in answers.

    :param base: ``scheme://host[:port]`` of the relay, as who asks sees it
    """

    def __init__(self, base: str) -> None:
        self._root = base + PATH
        self.own = Namespace(f"{self._root}{_OWN}#")
        self.untyped = Namespace(f"{self._root}{_NOTHING_KNOWN}#")

    def type(self, name: str) -> URIRef:
        """A message.

        :param name: in full, ``nav_msgs/msg/Odometry``
        """
        return URIRef(self._root + _short(name))

    def fields(self, name: str) -> Namespace:
        """The namespace of a message's fields."""
        return Namespace(f"{self._root}{_short(name)}#")

    def many(self, datatype: URIRef) -> URIRef:
        """The datatype of many values of a datatype of XML Schema, separated by spaces."""
        return self.own[f"{datatype.removeprefix(str(XSD))}List"]


def prefix_of(name: str) -> str:
    """What stands for a type's namespace: ``nav_msgs_Odometry``."""
    return _short(name).replace("/", "_")


def can_be_field(name: str) -> bool:
    """Whether a key of JSON can be the end of a property's IRI in every form."""
    return len(name) < LONGEST_IRI // 2 and _NAME.match(name) is not None


def type_of(iri: str) -> str | None:
    """The full name of the message that an IRI stands for, ``None`` for what is none of ours."""
    _, _, rest = iri.partition(PATH)
    match = _TYPE.match(rest)
    return None if match is None else f"{match[1]}/{match[2] or 'msg'}/{match[3]}"


def field_of(iri: str) -> VocabularyTerm | None:
    """The field that an IRI stands for, ``None`` for what is none of ours."""
    _, _, rest = iri.partition(PATH)
    owner, _, name = rest.partition("#")
    if owner == _OWN or _NAME.match(name) is None:
        return None
    if owner == _NOTHING_KNOWN:
        return VocabularyTerm("", name)
    owner = type_of(PATH + owner) or ""
    return VocabularyTerm(owner, name) if owner else None


def own_word(iri: str) -> str | None:
    """What the relay itself says of resources: ``value`` for ``…/vocabulary/switchboard#value``."""
    _, _, rest = iri.partition(PATH)
    owner, _, name = rest.partition("#")
    return name if owner == _OWN else None


def _short(name: str) -> str:
    package, kind, short = normalise(name).split("/")
    return f"{package}/{short}" if kind == "msg" else f"{package}/{kind}/{short}"
