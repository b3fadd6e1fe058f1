"""SPARQL over the Roles of one realm: the graph in memory, resolution of elements, and queries of clients.

Each Role is a named graph, ``fierro:`` and its name. Runs in the process of :mod:`relay_server.roles.worker`.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence
from itertools import chain, islice
from typing import Any
from xml.sax.saxutils import escape, quoteattr

from pyoxigraph import (
    BlankNode,
    Literal,
    NamedNode,
    Quad,
    QueryBoolean,
    QuerySolutions,
    RdfFormat,
    Store,
    Triple,
    parse,
    serialize,
)

from relay_protocol import jsontext
from relay_protocol.errors import Invalid
from relay_server.roles.documents import canonical_statement, local_name, missing_parts
from relay_server.roles.vocabulary import FIERRO, PAPER, PREFIXES, RDF_TYPE, SWITCHBOARD, TYPES

RESULTS_JSON = "application/sparql-results+json"
RESULTS_XML = "application/sparql-results+xml"
RESULTS_CSV = "text/csv"
TURTLE = "text/turtle"

GRAPH_FORMATS = {
    TURTLE: RdfFormat.TURTLE,
    "application/rdf+xml": RdfFormat.RDF_XML,
    "application/ld+json": RdfFormat.JSON_LD,
    "application/n-triples": RdfFormat.N_TRIPLES,
}

MAX_ROWS = 10_000
MAX_BINDINGS = 100
"""Resources of one element."""

MAX_RESULT = 4 * 1024 * 1024
"""Bytes."""

_XSD_STRING = "http://www.w3.org/2001/XMLSchema#string"

MAX_LOOKED_AT = 2000
"""Statements that are looked at to resolve an element in the shared process; more take a process of their own."""

_OWNING = TYPES - {"mapping", "role"}
_OWNERS = "|".join(f"^fierro:{each}" for each in sorted(_OWNING))
_STEP = f"fierro:mapping|^fierro:mapping|{_OWNERS}"
_STEPS_BACK = frozenset(f"{FIERRO}{each}" for each in ("mapping", *_OWNING))
_MAPPING, _ROLE, _TYPE = NamedNode(f"{FIERRO}mapping"), NamedNode(f"{FIERRO}role"), NamedNode(RDF_TYPE)
_RESOLVE = f"""PREFIX fierro: <fierro:>
SELECT DISTINCT ?role WHERE {{
  <%s> ({_STEP})+ ?role
  FILTER EXISTS {{ ?role a fierro:role }}
}} LIMIT {MAX_ROWS}"""
"""From an element over mappings, and up to what has it, to its Roles. As a join of the type with the path, the
same query takes a thousand times longer: Oxigraph would begin at all Roles."""


_BINDINGS = f"""PREFIX fierro: <fierro:> PREFIX switchboard: <switchboard:>
SELECT DISTINCT ?item ?resource WHERE {{
  <%s> (fierro:mapping|^fierro:mapping)* ?item . ?item switchboard:resource ?resource
}} LIMIT {MAX_BINDINGS}"""


class RoleGraphs:
    """The Roles of one realm."""

    def __init__(self) -> None:
        self._store = Store()

    def put(self, name: str, document: str) -> None:
        """Add a Role, or replace it.

        :param document: in N-Triples
        """
        graph = graph_of(name)
        self._store.remove_graph(graph)
        quads = parse(document, format=RdfFormat.N_TRIPLES, rename_blank_nodes=True)
        change = canonical_statement if PAPER in document else _unchanged
        statements = (change(each.triple) for each in quads)
        self._store.extend(Quad(each.subject, each.predicate, each.object, graph) for each in statements)

    def drop(self, name: str) -> None:
        """Remove a Role."""
        self._store.remove_graph(graph_of(name))

    def roles_of(
        self, element: str, names: Sequence[str] | None, most: int | None = None
    ) -> list[str] | None:
        """Names of the Roles that an element belongs to, itself or by what is mapped to it.

        :param element: its IRI
        :param names: of the Roles that may be used; ``None`` for all
        :param most: statements that may be looked at
        :returns: ``None`` if there are more
        """
        element = _checked_iri(element)
        quads = self._connected(NamedNode(element), most)
        if quads is None:
            return None
        # A path over statements in one graph is quick; over many graphs, Oxigraph looks into each at each step.
        near, graphs = Store(), None if names is None else {graph_of(each) for each in names}
        near.extend(
            Quad(each.subject, each.predicate, each.object)
            for each in quads
            if graphs is None or each.graph_name in graphs
        )
        found: Any = near.query(_RESOLVE % element)
        return [local_name(each["role"]) for each in found]

    def _connected(self, element: NamedNode, most: int | None) -> list[Quad] | None:
        """The statements that the path of :data:`_RESOLVE` can take in any Role."""
        found: list[Quad] = []
        seen, waiting = {element}, [element]
        looked_at = 0
        while waiting:
            item = waiting.pop()
            for each in chain(
                self._store.quads_for_pattern(None, None, item),
                self._store.quads_for_pattern(item, _MAPPING, None),
                self._store.quads_for_pattern(item, _TYPE, _ROLE),
            ):
                looked_at += 1
                if most is not None and looked_at > most:
                    return None
                ahead = each.subject == item
                if not ahead and each.predicate.value not in _STEPS_BACK:
                    continue
                found.append(each)
                reached: Any = each.object if ahead else each.subject
                if each.predicate != _TYPE and reached not in seen and not isinstance(reached, Literal):
                    seen.add(reached)
                    waiting.append(reached)
        return found

    def bindings(self, element: str, name: str) -> list[tuple[str, str]] | None:
        """Resources of an element, and of those that are mapped to it within a Role: pairs of element and resource.

        :param element: its IRI
        :param name: of the Role
        :returns: ``None`` if the Role has no such element
        """
        element, graph = _checked_iri(element), graph_of(name)
        node = NamedNode(element)
        known = chain(
            self._store.quads_for_pattern(node, None, None, graph),
            self._store.quads_for_pattern(None, None, node, graph),
        )
        if next(known, None) is None:
            return None
        found: Any = self._store.query(_BINDINGS % element, **_dataset([name]))
        return [(each["item"].value, each["resource"].value) for each in found]

    def elements(self, name: str) -> list[dict[str, Any]]:
        """Named elements of a Role: IRI, types without their namespace, resources, and what they are mapped to."""
        found: dict[str, dict[str, Any]] = {}

        def element(term: Any) -> dict[str, Any]:
            new = {"iri": term.value, "types": [], "resources": [], "mappings": []}
            return found.setdefault(term.value, new)

        quads: list[Any] = list(self._store.quads_for_pattern(None, None, None, graph_of(name)))
        roles = {each.subject.value for each in quads if each.object == _ROLE}
        for subject, predicate, value, _ in sorted(quads, key=str):
            if not isinstance(subject, NamedNode):
                continue
            if predicate.value == f"{SWITCHBOARD}resource":
                element(subject)["resources"].append(value.value)
            elif predicate.value == RDF_TYPE:
                element(subject)["types"].append(value.value.removeprefix(FIERRO))
            elif isinstance(value, NamedNode) and predicate.value.startswith(FIERRO):
                # A text, such as an ID, is no element.
                kind = predicate.value.removeprefix(FIERRO)
                if kind == "mapping":
                    element(subject)["mappings"].append(value.value)
                elif kind not in element(value)["types"]:
                    # The property that leads to a resource has the name of its type.
                    element(value)["types"].append(kind)
        return [each for iri, each in found.items() if iri not in roles]

    def resources_of(
        self, elements: Iterable[str], names: Sequence[str] | None
    ) -> list[tuple[str, str, str]]:
        """Resources of elements in all Roles: element, Role and resource.

        :param elements: their IRIs
        :param names: of the Roles that may be used; ``None`` for all
        :raises Invalid: one has too many
        """
        graphs = None if names is None else {graph_of(each) for each in names}
        resource = NamedNode(f"{SWITCHBOARD}resource")
        found: list[tuple[str, str, str]] = []
        for element in elements:
            quads: Any = self._store.quads_for_pattern(NamedNode(_checked_iri(element)), resource, None)
            visible = (each for each in quads if graphs is None or each.graph_name in graphs)
            own = [
                (element, local_name(each.graph_name), each.object.value)
                for each in islice(visible, MAX_BINDINGS + 1)
            ]
            if len(own) > MAX_BINDINGS:
                raise Invalid(
                    f"{element} has more than {MAX_BINDINGS} resources in all Roles; map another element"
                )
            found += own
        return found

    def missing(self, name: str) -> list[str]:
        """Sentences about what a Role lacks to be started."""
        quads = self._store.quads_for_pattern(None, None, None, graph_of(name))
        return list(missing_parts(each.triple for each in quads))

    def query(
        self, text: str, names: Sequence[str] | None, rows_media: str, graph_media: str
    ) -> tuple[str, bytes]:
        """Carry out a query of a client: media type and body of its result.

        :param names: of the Roles that the client may see; ``None`` for all
        :param rows_media: for SELECT and ASK
        :param graph_media: for CONSTRUCT and DESCRIBE
        :raises Invalid: it is not valid, or has too many results
        """
        text = text.replace(f"<{PAPER}#", f"<{FIERRO}").replace(f"<{PAPER}>", f"<{FIERRO}>")
        try:
            result = self._store.query(text, prefixes=PREFIXES, **_dataset(names))
            if isinstance(result, QueryBoolean):
                body = _boolean(bool(result), rows_media)
                # CSV has no form for it (SPARQL 1.1 Query Results CSV, section 1).
                return (RESULTS_JSON if rows_media == RESULTS_CSV else rows_media), body
            if isinstance(result, QuerySolutions):
                header = [each.value for each in result.variables]
                return rows_media, _WRITERS[rows_media](header, _bounded(result, "rows"))
            triples = _bounded(result, "statements")
        except (SyntaxError, ValueError, OSError) as error:
            raise Invalid(f"the query was not carried out: {str(error)[:300]}") from None
        prefixes = None if graph_media == "application/ld+json" else PREFIXES
        return graph_media, _fits(
            serialize(triples, format=GRAPH_FORMATS[graph_media], prefixes=prefixes) or b""
        )


def _unchanged(statement: Triple) -> Triple:
    return statement


def graph_of(name: str) -> NamedNode:
    """The named graph of a Role."""
    return NamedNode(f"{FIERRO}{name}")


def _checked_iri(text: str) -> str:
    """:raises Invalid: it is no IRI, or would end the one in a query"""
    try:
        text = NamedNode(text).value
    except ValueError as error:
        raise Invalid(f"'{text[:60]}' is no IRI: {error}") from None
    if any(each in text for each in '<>"{}|^`\\ \n'):
        raise Invalid(f"'{text[:60]}' is no IRI")
    return text


def _dataset(names: Sequence[str] | None) -> dict[str, Any]:
    if names is None:
        return {"use_default_graph_as_union": True}
    graphs = [graph_of(each) for each in names]
    return {"default_graph": graphs, "named_graphs": graphs}


def _bounded(results: Iterable[Any], what: str) -> list[Any]:
    found = list(islice(results, MAX_ROWS + 1))
    if len(found) > MAX_ROWS:
        raise Invalid(f"the result has more than {MAX_ROWS} {what}; add LIMIT to the query")
    return found


def _fits(body: bytes) -> bytes:
    if len(body) > MAX_RESULT:
        raise Invalid(f"the result has more than {MAX_RESULT} bytes; add LIMIT to the query, or ask for less")
    return body


# --- forms of results -------------------------------------------------------------------------------------


def _boolean(value: bool, media: str) -> bytes:
    if media == RESULTS_XML:
        word = str(value).lower()
        return f"{_XML_HEAD}<head></head><boolean>{word}</boolean></sparql>".encode()
    return jsontext.encode({"head": {}, "boolean": value})


def _json(header: list[str], rows: list[Any]) -> bytes:
    bindings = [{name: _term(row[name]) for name in header if row[name] is not None} for row in rows]
    return _fits(jsontext.encode({"head": {"vars": header}, "results": {"bindings": bindings}}))


def _term(term: Any) -> dict[str, Any]:
    """SPARQL 1.1 Query Results JSON Format, section 3.2.2."""
    if isinstance(term, NamedNode):
        return {"type": "uri", "value": term.value}
    if isinstance(term, BlankNode):
        return {"type": "bnode", "value": term.value}
    if not isinstance(term, Literal):
        raise Invalid("the result has a statement as a value; ask for its parts")
    found: dict[str, Any] = {"type": "literal", "value": term.value}
    if term.language:
        found["xml:lang"] = term.language
    elif term.datatype.value != _XSD_STRING:
        found["datatype"] = term.datatype.value
    return found


_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 has no form for."""

_XML_HEAD = '<?xml version="1.0"?>\n<sparql xmlns="http://www.w3.org/2005/sparql-results#">'


def _xml(header: list[str], rows: list[Any]) -> bytes:
    out = [
        _XML_HEAD,
        "<head>",
        *(f"<variable name={quoteattr(each)}/>" for each in header),
        "</head><results>",
    ]
    for row in rows:
        out.append("<result>")
        for name in header:
            if row[name] is not None:
                out.append(f"<binding name={quoteattr(name)}>{_xml_term(_term(row[name]))}</binding>")
        out.append("</result>")
    return _fits("".join([*out, "</results></sparql>"]).encode())


def _xml_term(term: dict[str, Any]) -> str:
    kind, value = term["type"], escape(_NOT_XML.sub("\ufffd", term["value"]))
    more = "".join(f" {each}={quoteattr(term[each])}" for each in ("xml:lang", "datatype") if each in term)
    return f"<{kind}{more}>{value}</{kind}>"


def _csv(header: list[str], rows: list[Any]) -> bytes:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\r\n")
    writer.writerow(header)
    for row in rows:
        writer.writerow(["" if row[each] is None else _csv_term(row[each]) for each in header])
    return _fits(out.getvalue().encode())


def _csv_term(term: Any) -> str:
    return f"_:{term.value}" if isinstance(term, BlankNode) else str(_term(term)["value"])


_WRITERS = {RESULTS_JSON: _json, RESULTS_XML: _xml, RESULTS_CSV: _csv}
