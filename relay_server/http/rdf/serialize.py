"""RDF graphs as text and back: RDF/XML, Turtle, JSON-LD.

Bodies come from strangers. They are checked before a parser reads them: nothing may be fetched or opened,
nothing may expand, nesting and size are bounded. Every check takes linear time. The HTTP framework bounds the
size of bodies.

rdflib's own writers are not used where they lose information: those of Turtle and JSON-LD round doubles, and
that of JSON-LD writes no list that begins with 0. pyoxigraph (0.5) keeps doubles, but nests neither blank
nodes nor lists and writes JSON-LD without a context.
"""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Callable
from io import BytesIO
from typing import Any
from xml.parsers import expat

import rdflib
from rdflib import RDF, Graph, Literal, URIRef
from rdflib.plugins.parsers.jsonld import to_rdf
from rdflib.plugins.serializers.rdfxml import XMLSerializer
from rdflib.plugins.serializers.turtle import TurtleSerializer
from rdflib.term import Node

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, SwitchboardError
from relay_protocol.limits import JSON_DEPTH
from relay_server.http.media_types import JSON_LD, RDF_XML, TURTLE, MediaType

# Literals keep the text that was sent: a decimal of ten characters may have 10^9 digits.
rdflib.NORMALIZE_LITERALS = False
# rdflib logs every literal that does not fit its datatype; the client gets an error for it anyway.
logging.getLogger("rdflib").setLevel(logging.CRITICAL)
warnings.filterwarnings("ignore", "Parsing weird boolean", UserWarning)

LONGEST_IRI = 1024
"""Characters. Longer IRIs are rejected, since a short prefix can stand for a long IRI many times."""

CONTEXT_TERMS = 128
CONTEXT_CHARACTERS = 16 * 1024
"""Of a JSON-LD context."""

MAXIMUM_TOKENS = 2048
"""Elements and attributes of RDF/XML, tokens of Turtle, values of JSON-LD: rdflib takes about 30 µs for each.
A long array is one."""

MAXIMUM_NAMESPACES = 64
"""Of RDF/XML and Turtle; JSON-LD counts them as terms."""

XML_DEPTH = 2 * JSON_DEPTH + 2
"""One element for each node and one for each property."""

_ABSOLUTE_IRI = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://\S*\Z|urn:\S*\Z")
_TERM = re.compile(r"[A-Za-z_][A-Za-z0-9_.-]*\Z")
_LONG_IRI = re.compile(rf"<[^\s<>\"{{}}|^`]{{{LONGEST_IRI},}}")
_NAME_CHARACTERS = r"""[^\t\r\n !"\#$&'()*+,/;<=>?@\[\\\]^`{|}~]"""
_TOKEN = re.compile(
    rf"""
    (?P<nothing> (?: [ \t\r\n] | \#[^\n]*+ )++ )
    | "{"{3}"} (?: [^"\\] | \\. | "(?!"") )*+ "{"{3,5}"}
    | '{"{3}"} (?: [^'\\] | \\. | '(?!'') )*+ '{"{3,5}"}
    | "(?!"") (?: [^"\\\r\n] | \\. )*+ "
    | '(?!'') (?: [^'\\\r\n] | \\. )*+ '
    | (?:\^\^)? <[^\x00-\x20<>"{{}}|^`]*+>
    | [+-]? (?: [0-9]++ (?:\.[0-9]*+)? | \.[0-9]++ ) (?: [eE][+-]?[0-9]++ )?
    | (?:\^\^|@)? (?![-.0-9]) {_NAME_CHARACTERS} (?: {_NAME_CHARACTERS} | \\. )*+
    | [^"'<\\]
    """,
    re.VERBOSE,
)
"""One token of Turtle, as rdflib reads it, or white space and comments. Where nothing matches, a string or an
address has no end, and reading stops there: no text is read twice."""

_PREFIX = re.compile(r"(?<![\w:/#])prefix", re.IGNORECASE)
_KEYWORDS = frozenset({"@id", "@type", "@value", "@list", "@graph", "@vocab"})
_ESCAPES = str.maketrans({"\\": "\\\\", '"': '\\"', "\n": "\\n", "\r": "\\r"})


def write(graph: Graph, form: MediaType) -> bytes:
    """A graph in UTF-8.

    :param form: RDF/XML, Turtle or JSON-LD
    """
    if form is JSON_LD:
        return jsontext.encode(_JsonLd(graph).document())
    out = BytesIO()
    serializer: Any = XMLSerializer(graph) if form is RDF_XML else _TurtleWriter(graph)
    serializer.serialize(out)
    return out.getvalue()


def read(body: bytes, form: MediaType, base: str) -> Graph:
    """The graph in a text.

    :param base: the address that relative ones are relative to
    :raises Invalid: it cannot be parsed, or parsing could be dangerous
    """
    try:
        text = body.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise Invalid(f"the body is not UTF-8 (byte {error.start})") from None
    graph = Graph(bind_namespaces="none")
    try:
        _READERS[form](graph, text, base)
    except SwitchboardError:
        raise
    except RecursionError:
        raise Invalid("the body is nested too deeply") from None
    except (
        Exception
    ) as error:  # Whatever the parsers stumble over is the sender's fault; they have no error in common.
        raise Invalid(f"the body is not valid {form.media}: {_first_line(error)}") from None
    return graph


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0][:200]


def _too_many(what: str) -> Invalid:
    return Invalid(f"the body has more than {MAXIMUM_TOKENS} {what}; send it as application/json")


# --- RDF/XML ----------------------------------------------------------------------------------------------


def _read_xml(graph: Graph, text: str, base: str) -> None:
    _check_xml(text)
    graph.parse(data=text.encode(), format="xml", publicID=base)


def _check_xml(text: str) -> None:
    """Check that a document is harmless to parse.

    :raises Invalid: it has a document type, which could define entities; another encoding; deep nesting; long
        IRIs; many namespaces, for each of which the parser keeps a table; XML literals, which the parser
        reads again with each element
    """
    depth = namespaces = elements = 0

    def declared(version: str, encoding: str | None, standalone: int) -> None:
        if (encoding or "utf-8").lower() not in ("utf-8", "utf8"):
            raise Invalid("the body and its XML declaration must be UTF-8")

    def document_type(*named: Any) -> None:
        raise Invalid("the body must not have a DOCTYPE: entities are not expanded")

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth, namespaces, elements
        depth += 1
        elements += 1 + len(attributes)
        if elements > MAXIMUM_TOKENS:
            raise _too_many("elements and attributes")
        namespaces += sum(each.startswith("xmlns") for each in attributes)
        if namespaces > MAXIMUM_NAMESPACES:
            raise Invalid(f"the body declares more than {MAXIMUM_NAMESPACES} namespaces")
        for each, value in attributes.items():
            if each.rpartition(":")[2] == "parseType" and value not in ("Resource", "Collection"):
                raise Invalid("rdf:parseType must be Resource or Collection: no field is XML")
        if depth > XML_DEPTH:
            raise Invalid(f"the body nests elements deeper than {XML_DEPTH}")
        if any(len(each) > LONGEST_IRI for each in (name, *attributes, *attributes.values())):
            raise Invalid(f"the body has an attribute of over {LONGEST_IRI} characters")

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate("utf-8")
    parser.XmlDeclHandler = declared
    parser.StartDoctypeDeclHandler = document_type
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.Parse(text.encode(), True)


# --- Turtle -----------------------------------------------------------------------------------------------


class _TurtleWriter(TurtleSerializer):
    """Writes every literal with its datatype and all its digits."""

    def label(self, node: Node, position: int) -> str:
        if not isinstance(node, Literal):
            found: str = super().label(node, position)
            return found
        quoted = f'"{str(node).translate(_ESCAPES)}"'
        if node.datatype is None:
            return quoted
        return f"{quoted}^^{self.get_pname(node.datatype, gen_prefix=False) or node.datatype.n3()}"


def _read_turtle(graph: Graph, text: str, base: str) -> None:
    if _LONG_IRI.search(text) is not None:
        raise Invalid(f"the body has an address of over {LONGEST_IRI} characters")
    _check_turtle(text)
    # rdflib compares each with all before it. Occurrences within strings count too; no useful body has so
    # many.
    if sum(1 for _ in _PREFIX.finditer(text)) > MAXIMUM_NAMESPACES:
        raise Invalid(f"the body declares more than {MAXIMUM_NAMESPACES} namespaces")
    graph.parse(data=text, format="turtle", publicID=base)


def _check_turtle(text: str) -> None:
    """Check that a text has few tokens.

    :raises Invalid: it has too many, or a string or an address that does not end
    """
    tokens = at = 0
    while at < len(text):
        found = _TOKEN.match(text, at)
        if found is None:
            line = text.count("\n", 0, at) + 1
            raise Invalid(
                f"the body is not valid {TURTLE.media}: the string or address that begins in line {line} has no end"
            )
        tokens += found["nothing"] is None
        if tokens > MAXIMUM_TOKENS:
            raise _too_many("words")
        at = found.end()


# --- JSON-LD ----------------------------------------------------------------------------------------------


class _JsonLd:
    """A graph as JSON-LD with a context. Blank nodes are nested where they are used."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph
        self._context = {prefix: str(namespace) for prefix, namespace in graph.namespaces()}
        self._prefixes = {namespace: prefix for prefix, namespace in self._context.items()}

    def document(self) -> dict[str, Any]:
        named = dict.fromkeys(each for each in self._graph.subjects() if isinstance(each, URIRef))
        return {"@context": self._context, "@graph": [self._node(each) for each in named]}

    def _node(self, node: Node) -> dict[str, Any]:
        found: dict[str, Any] = {"@id": str(node)} if isinstance(node, URIRef) else {}
        for predicate, each in self._graph.predicate_objects(node):
            if predicate == RDF.type:
                found.setdefault("@type", []).append(self._compact(each))
            else:
                found.setdefault(self._compact(predicate), []).append(self._value(each))
        return {name: each[0] if len(each) == 1 and name[0] != "@" else each for name, each in found.items()}

    def _value(self, term: Node) -> Any:
        if isinstance(term, Literal):
            if term.datatype is None:
                return str(term)
            return {"@type": self._compact(term.datatype), "@value": str(term)}
        if term == RDF.nil:
            return {"@list": []}
        if (term, RDF.first, None) in self._graph:
            return {"@list": [self._value(each) for each in self._graph.items(term)]}
        return {"@id": str(term)} if isinstance(term, URIRef) else self._node(term)

    def _compact(self, term: Node) -> str:
        text = str(term)
        cut = max(text.rfind("#"), text.rfind("/")) + 1
        prefix = self._prefixes.get(text[:cut])
        return text if prefix is None else f"{prefix}:{text[cut:]}"


def _read_json(graph: Graph, text: str, base: str) -> None:
    value = jsontext.decode_any(text.encode())
    if not isinstance(value, dict):
        raise Invalid("the body must be one JSON-LD object")
    if "@context" in value:
        _check_context(value["@context"])
    _check_values({name: each for name, each in value.items() if name != "@context"})
    to_rdf(value, graph, base=base)


def _check_context(context: Any) -> None:
    """Check that a context is self-contained: nothing is fetched, and no term expands through another.

    :raises Invalid: it is not
    """
    if not isinstance(context, dict):
        raise Invalid("'@context' must be an object in the body itself: contexts are not fetched")
    if len(context) > CONTEXT_TERMS or len(jsontext.encode(context)) > CONTEXT_CHARACTERS:
        raise Invalid(
            f"'@context' may have at most {CONTEXT_TERMS} terms and {CONTEXT_CHARACTERS} characters"
        )
    for name, term in context.items():
        if name == "@version":
            continue
        if name not in ("@base", "@vocab") and _TERM.match(name) is None:
            raise Invalid(f"'@context' must not have the entry '{name[:40]}'")
        parts = term if isinstance(term, dict) else {"@id": term}
        for word, each in parts.items():
            _check_term(context, name, word, each)


def _check_term(context: dict[str, Any], name: str, word: str, value: Any) -> None:
    if word == "@container" and value in ("@list", "@set"):
        return
    if word in ("@id", "@type") and isinstance(value, str):
        prefix = context.get(value.partition(":")[0])
        own = isinstance(prefix, str) and _ABSOLUTE_IRI.match(prefix) is not None
        if len(value) <= LONGEST_IRI and (
            value in _KEYWORDS or own or _ABSOLUTE_IRI.match(value) is not None
        ):
            return
    raise Invalid(f"'@context' defines '{name[:40]}' in a way that is not supported: give it one address")


def _check_values(value: Any) -> None:
    """:raises Invalid: there is a context below the top of the body, or too many values"""
    waiting = [value]
    values = 0
    while waiting:
        each = waiting.pop()
        values += 1
        if values > MAXIMUM_TOKENS:
            raise _too_many("values")
        if isinstance(each, dict):
            if "@context" in each or "@import" in each:
                raise Invalid("'@context' is allowed only at the top of the body, and '@import' nowhere")
            waiting += each.values()
        elif isinstance(each, list):
            waiting += each


_READERS: dict[MediaType, Callable[[Graph, str, str], None]] = {
    RDF_XML: _read_xml,
    TURTLE: _read_turtle,
    JSON_LD: _read_json,
}
