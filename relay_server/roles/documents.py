"""Documents of Roles: reading and checking RDF/XML, Turtle and JSON-LD, and writing them.

Reading takes place in a process of its own (:mod:`relay_server.roles.worker`), since pyoxigraph can't be
interrupted, and deep nesting overflows its stack.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from difflib import get_close_matches
from typing import Any, NamedTuple
from xml.parsers import expat

from pyoxigraph import Literal, NamedNode, RdfFormat, Triple, parse, serialize

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, MalformedMessage
from relay_server.roles.bindings import RESOURCE_EXAMPLE, binding_of
from relay_server.roles.vocabulary import (
    FIERRO,
    ID,
    MAX_BODY,
    MAX_DEPTH,
    MAX_IRI,
    MAX_LITERAL,
    MAX_NAME,
    MAX_PROBLEMS,
    MAX_STATEMENTS,
    PAPER,
    PARTS_OF_ROLE,
    PREFIXES,
    PROPERTIES,
    RDF_TYPE,
    SWITCHBOARD,
    TYPES,
    canonical,
    canonical_word,
)

FORMATS = {
    "application/rdf+xml": RdfFormat.RDF_XML,
    "text/turtle": RdfFormat.TURTLE,
    "application/ld+json": RdfFormat.JSON_LD,
}
"""By media type."""

_NAME = re.compile(rf"[\w.~-]{{1,{MAX_NAME}}}\Z")
Statements = list[Triple]


class InvalidRole(Invalid):
    """A document lacks something that a Role needs.

    :ivar problems: sentences, each with the statement concerned
    """

    code = "invalid_role"
    http_status = 422

    def __init__(self, problems: list[str]) -> None:
        self.problems = problems[:MAX_PROBLEMS]
        more = len(problems) - len(self.problems)
        text = "; ".join(self.problems)
        super().__init__(f"{text}; and {more} more problems" if more else text)

    @property
    def problem_fields(self) -> dict[str, Any]:
        """Further fields of the error over HTTP."""
        return {"problems": self.problems}


class LoadedRole(NamedTuple):
    """A Role that was read and checked.

    :param document: in N-Triples, sorted, in the words that were read
    :param robots: names of the robots that it refers to
    :param notes: sentences about what the Role lacks to be started, and about unusual statements
    """

    name: str
    document: str
    statements: int
    robots: list[str]
    notes: list[str]


# --- reading ----------------------------------------------------------------------------------------------


def load(body: bytes, media: str) -> list[LoadedRole]:
    """The Roles of a document.

    :param media: media type, one of :data:`FORMATS`
    :raises InvalidRole: it lacks what a Role needs
    :raises Invalid: it is not valid, too large, or parsing could be dangerous
    """
    spellings: dict[Triple, list[Triple]] = defaultdict(list)
    for each in read(body, media):
        spellings[canonical_statement(each)].append(each)
    statements = list(spellings)
    check(statements)
    return [_loaded(name, part, spellings) for name, part in split(statements).items()]


def read(body: bytes, media: str) -> Statements:
    """The statements of a document, each once.

    :raises Invalid: as :func:`load`
    """
    if len(body) > MAX_BODY:
        raise Invalid(f"the document has {len(body)} bytes; {MAX_BODY} are allowed")
    try:
        text = body.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise Invalid(f"the document is not UTF-8 (byte {error.start})") from None
    if media == "application/rdf+xml":
        check_xml(text)
    if media == "application/ld+json":
        _check_json(text)
    found: dict[Triple, None] = {}
    try:
        quads = parse(text.encode(), format=FORMATS[media], base_iri=FIERRO, without_named_graphs=True)
        for quad in quads:
            found[_checked(quad.triple)] = None
            if len(found) > MAX_STATEMENTS:
                raise Invalid(f"the document has more than {MAX_STATEMENTS} statements; load it in parts")
    except (SyntaxError, ValueError, OSError) as error:
        raise Invalid(f"the document is not valid {media}: {str(error)[:200]}") from None
    return list(found)


def check_xml(text: str) -> None:
    """Check that RDF/XML is harmless to parse, in linear time.

    :raises Invalid: it has a document type, which could define entities; it is nested too deeply, or no XML
    """
    depth = 0

    def refuse_doctype(*_: Any) -> None:
        raise Invalid("the document has a document type (<!DOCTYPE …>); remove it: entities are not read")

    def begin(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > MAX_DEPTH:
            raise Invalid(f"the document has more than {MAX_DEPTH} elements within each other")

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate("UTF-8")
    parser.StartDoctypeDeclHandler = refuse_doctype
    parser.StartElementHandler, parser.EndElementHandler = begin, end
    try:
        parser.Parse(text.encode(), True)
    except expat.ExpatError as error:
        raise Invalid(f"the document is not valid XML: {error}") from None


def _check_json(text: str) -> None:
    """:raises Invalid: JSON-LD is nested too deeply, or has a key twice"""
    depth = 0
    for each in re.finditer(r'"(?:[^"\\]|\\.)*+"?|[\[\]{}]', text):
        depth += {"{": 1, "[": 1, "}": -1, "]": -1}.get(each[0], 0)
        if depth > MAX_DEPTH:
            raise Invalid(f"the document has more than {MAX_DEPTH} brackets within each other")
    try:
        jsontext.check_keys(text.encode())
    except MalformedMessage as error:
        raise Invalid(f"the document is not valid: {error}") from None


def _checked(triple: Triple) -> Triple:
    for term in triple:
        if isinstance(term, Literal) and len(term.value) > MAX_LITERAL:
            raise Invalid(
                f"the value of {short(triple.predicate)} of {short(triple.subject)} has {len(term.value)} "
                f"characters; {MAX_LITERAL} are allowed"
            )
        if isinstance(term, NamedNode) and len(term.value) > MAX_IRI:
            raise Invalid(f"the name {term.value[:60]}… has more than {MAX_IRI} characters")
    return triple


def canonical_statement(statement: Triple) -> Triple:
    """A statement with the words and names of the paper's namespace in ``fierro:``."""
    if not any(isinstance(each, NamedNode) and each.value.startswith(PAPER) for each in statement):
        return statement
    subject, predicate, value = statement
    is_type = predicate.value == RDF_TYPE
    return Triple(
        _canonical_term(subject),
        NamedNode(canonical_word(predicate.value)),
        NamedNode(canonical_word(value.value))
        if is_type and isinstance(value, NamedNode)
        else _canonical_term(value),
    )


def _canonical_term(term: Any) -> Any:
    return NamedNode(canonical(term.value)) if isinstance(term, NamedNode) else term


# --- checks -----------------------------------------------------------------------------------------------


def check(statements: Statements) -> None:
    """:raises InvalidRole: statements lack what Roles need, or use words that do not exist"""
    problems = [*_word_problems(statements), *_role_problems(statements), *_binding_problems(statements)]
    if problems:
        raise InvalidRole(problems)


def _word_problems(statements: Statements) -> Iterator[str]:
    for each in statements:
        word = _word(each.predicate)
        if word == ID:
            if not isinstance(each.object, Literal):
                yield f"{sentence(each)}: the value is a resource; it must be a text"
        elif word is not None and (word not in TYPES or word == "role"):
            yield f"{sentence(each)}: there is no property fierro:{word}{_similar(word)}"
        elif word is not None and isinstance(each.object, Literal):
            yield f"{sentence(each)}: the value is a text; it must be a resource"
        if each.predicate.value == RDF_TYPE:
            word = _word(each.object)
            if word is not None and word not in TYPES:
                yield f"{sentence(each)}: there is no type fierro:{word}{_similar(word)}"


def _role_problems(statements: Statements) -> Iterator[str]:
    roles = _roles(statements)
    if not roles:
        yield "the document has no Role: one resource must have the type fierro:role"
    values: dict[tuple[Any, str], list[Triple]] = defaultdict(list)
    types: dict[Any, set[str]] = defaultdict(set)
    for each in statements:
        word = _word(each.predicate)
        if word is not None:
            values[each.subject, word].append(each)
        if each.predicate.value == RDF_TYPE and _word(each.object):
            types[each.subject].add(_word(each.object) or "")
    names: dict[str, Any] = {}
    for role in roles:
        name = local_name(role)
        if not isinstance(role, NamedNode) or not _NAME.match(name):
            yield f"{short(role)} is a Role, but its name is not one of letters, digits, '.', '_', '~' and '-'"
        elif names.setdefault(name, role) != role:
            yield f"{short(role)} and {short(names[name])} are two Roles of the same name"
        for part in PARTS_OF_ROLE:
            found = values[role, part]
            if not found:
                continue
            if len(found) > 1:
                yield f"{sentence(found[1])}: this Role has a fierro:{part} already, {short(found[0].object)}"
            elif not types[found[0].object] <= {part, "object"}:
                other = sorted(types[found[0].object] - {part, "object"})[0]
                yield f"{sentence(found[0])}: the value has the type fierro:{other}, not fierro:{part}"


def _binding_problems(statements: Statements) -> Iterator[str]:
    for each in statements:
        if each.predicate.value == f"{SWITCHBOARD}resource" and binding_of(_text(each.object)) is None:
            yield f"{sentence(each)}: the value is no address of a resource, such as {RESOURCE_EXAMPLE}"
        elif (
            each.predicate.value.startswith(SWITCHBOARD) and each.predicate.value != f"{SWITCHBOARD}resource"
        ):
            yield f"{sentence(each)}: the only property there is switchboard:resource"


def _notes(statements: Statements) -> Iterator[str]:
    types = {each.subject: _word(each.object) for each in statements if each.predicate.value == RDF_TYPE}
    for each in statements:
        word, kind = _word(each.predicate), types.get(each.subject)
        if word not in (None, ID) and kind is not None and word not in PROPERTIES.get(kind, ()):
            yield f"{sentence(each)}: a resource of type fierro:{kind} usually has no fierro:{word}"


def missing_parts(statements: Iterable[Triple]) -> Iterator[str]:
    """Sentences about what Roles lack to be started."""
    statements = list(statements)
    known = {(each.subject, _word(each.predicate)) for each in statements}
    for role in _roles(statements):
        for part in PARTS_OF_ROLE:
            if (role, part) not in known:
                yield f"{short(role)} is a Role without fierro:{part}; add '{short(role)} fierro:{part} …'"


def _similar(word: str) -> str:
    found = get_close_matches(word, TYPES, 1)
    return f"; is fierro:{found[0]} meant?" if found else ""


# --- Roles of a document ----------------------------------------------------------------------------------


def split(statements: Statements) -> dict[str, Statements]:
    """The statements of each Role, by its name: those of the Role and of all that it leads to, up to other Roles.

    :raises InvalidRole: a statement belongs to no Role
    """
    roles = _roles(statements)
    of_subject: dict[Any, Statements] = defaultdict(list)
    for each in statements:
        of_subject[each.subject].append(each)
    if len(roles) == 1:
        return {local_name(roles[0]): statements}
    closures = {role: _reached(role, of_subject, frozenset(roles)) for role in roles}
    for subject in of_subject:
        owners = [role for role, reached in closures.items() if subject in reached]
        if owners:
            continue
        targets = {each.object for each in of_subject[subject]}
        pointed = [role for role, reached in closures.items() if not targets.isdisjoint(reached)]
        if not pointed:
            raise InvalidRole([f"{sentence(of_subject[subject][0])}: this belongs to none of the Roles"])
        closures[pointed[0]][subject] = None
    return {
        local_name(role): [each for subject in reached for each in of_subject.get(subject, ())]
        for role, reached in closures.items()
    }


def _reached(role: Any, of_subject: dict[Any, Statements], roles: frozenset[Any]) -> dict[Any, None]:
    reached, waiting = {role: None}, [role]
    while waiting:
        for each in of_subject.get(waiting.pop(), ()):
            if (
                not isinstance(each.object, Literal)
                and each.object not in reached
                and each.object not in roles
            ):
                reached[each.object] = None
                waiting.append(each.object)
    return reached


def _roles(statements: Statements) -> list[Any]:
    return [
        each.subject
        for each in statements
        if each.predicate.value == RDF_TYPE and _word(each.object) == "role"
    ]


def _loaded(name: str, statements: Statements, spellings: dict[Triple, list[Triple]]) -> LoadedRole:
    lines = sorted(f"{each} ." for statement in statements for each in spellings[statement])
    robots = {
        found.robot
        for each in statements
        if each.predicate.value == f"{SWITCHBOARD}resource"
        and (found := binding_of(_text(each.object))) is not None
        and found.robot
    }
    notes = [*missing_parts(statements), *_notes(statements)]
    return LoadedRole(name, "\n".join(lines), len(lines), sorted(robots), notes[:MAX_PROBLEMS])


# --- writing ----------------------------------------------------------------------------------------------


def write(documents: Iterable[str], media: str) -> bytes:
    """Documents in N-Triples, as one of another form.

    :param media: media type, one of :data:`FORMATS`
    """
    found: dict[Triple, None] = {}
    for document in documents:
        for quad in parse(document, format=RdfFormat.N_TRIPLES, rename_blank_nodes=True):
            found[quad.triple] = None
    # Serialisers write statements with the same subject together where they follow each other.
    ordered = sorted(found, key=lambda each: (str(each.subject), str(each.predicate) != f"<{RDF_TYPE}>"))
    # The writer of JSON-LD makes a cyclic context of a prefix that equals its namespace.
    prefixes = None if media == "application/ld+json" else PREFIXES
    return serialize(ordered, format=FORMATS[media], prefixes=prefixes) or b""


# --- words ------------------------------------------------------------------------------------------------


def _word(term: Any) -> str | None:
    """The name of a type or property in the namespace of Roles."""
    if isinstance(term, NamedNode) and term.value.startswith(FIERRO):
        return str(term.value).removeprefix(FIERRO)
    return None


def _text(term: Any) -> str:
    return str(getattr(term, "value", ""))


def local_name(term: Any) -> str:
    """The end of an IRI that people call the resource by."""
    return re.split(r"[#/:]", _text(term).rstrip("#/:"))[-1]


def short(term: Any) -> str:
    """A term in an error message."""
    if isinstance(term, Literal):
        return f'"{term.value[:60]}"'
    if isinstance(term, NamedNode):
        name = str(term.value).replace("http://www.w3.org/1999/02/22-rdf-syntax-ns#", "rdf:")
        return name[:120]
    return str(term)[:60]


def sentence(statement: Triple) -> str:
    """A statement in an error message."""
    return f"'{short(statement.subject)} {short(statement.predicate)} {short(statement.object)}'"
