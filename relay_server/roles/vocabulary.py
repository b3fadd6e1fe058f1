"""The words of Roles: types of resources, their properties, and limits. Imports nothing."""

from __future__ import annotations

FIERRO = "fierro:"
"""The namespace of types and properties. A type and the property that leads to it have the same name."""

PAPER = "http://www-robot.mes.titech.ac.jp/fierro"
"""The namespace as the FIERRo paper's files declare it: without a hash, so ``fierro:port`` is ``…/fierroport``, while
types are ``…/fierro#port``. Documents keep what was read; checks and queries see :data:`FIERRO`."""

SWITCHBOARD = "switchboard:"
"""The namespace of properties that bind an element to a resource of a robot."""

RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
RDF_TYPE = f"{RDF}type"

PREFIXES = {"fierro": FIERRO, "switchboard": SWITCHBOARD}

PARTS_OF_ROLE = ("subject", "action", "directObject")
"""Each Role has exactly one of each: subject, verb and object of its sentence."""

_OBJECT = frozenset({"action", "data", "service", "mapping"})
_SOFTWARE = frozenset({"softwareElement", "file", "process", "function", "port", "mapping"})
_DATA = frozenset({"structuredData", "field", "mapping"})
_LEAF = frozenset({"function", "port", "mapping"})

PROPERTIES: dict[str, frozenset[str]] = {
    "role": frozenset({*PARTS_OF_ROLE, "mapping"}),
    "object": _OBJECT,
    "subject": _OBJECT,
    "directObject": _OBJECT,
    "action": frozenset({"subject", "directObject", "software", "data", "service", "mapping"}) | _SOFTWARE,
    "data": _DATA,
    "structuredData": _DATA,
    "field": _DATA,
    "service": frozenset({"operation", "mapping"}),
    "operation": frozenset({"mapping"}),
    "software": _SOFTWARE,
    "softwareElement": _SOFTWARE,
    "file": _LEAF,
    "process": _LEAF,
    "function": _LEAF,
    "port": _LEAF,
    "mapping": frozenset({"mapping"}),
}
"""The properties of each type."""

TYPES = frozenset(PROPERTIES)

ID = "ID"
"""A property of any resource: a text that people call it by."""

_PAPER_WORDS = {f"{PAPER}{each}": f"{FIERRO}{each}" for each in (*PROPERTIES, ID)}


def canonical(iri: str) -> str:
    """An IRI in the paper's namespace in ``fierro:``; another one unchanged."""
    return FIERRO + iri.removeprefix(f"{PAPER}#") if iri.startswith(f"{PAPER}#") else iri


def canonical_word(iri: str) -> str:
    """As :func:`canonical`, for a type or property: the paper's form without a hash too."""
    return _PAPER_WORDS.get(iri) or canonical(iri)


MAX_BODY = 1024 * 1024
"""Bytes of a document that is loaded."""

MAX_STATEMENTS = 10_000
"""Of a document that is loaded."""

MAX_LITERAL = 16 * 1024
"""Characters of a literal."""

MAX_IRI = 1024

MAX_DEPTH = 64
"""Elements of RDF/XML, or brackets of JSON-LD, within each other."""

MAX_NAME = 128
"""Characters of a Role's name."""

MAX_PROBLEMS = 20
"""Most problems of one document that are listed."""
