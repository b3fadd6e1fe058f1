"""Documents of Roles: valid ones, errors of refused ones, and lossless conversion."""

from __future__ import annotations

from pathlib import Path

import pytest
from rdflib import Graph
from rdflib.compare import isomorphic

from relay_protocol.errors import Invalid
from relay_server.roles.documents import FORMATS, InvalidRole, load, write
from relay_server.roles.sparql import RESULTS_CSV, RoleGraphs
from relay_server.roles.sparql import TURTLE as TURTLE_RESULT
from relay_server.roles.vocabulary import PROPERTIES

LISTING = Path("docs/examples/roles/gamepad.rdf").read_bytes()
XML, TURTLE, JSON_LD = FORMATS
NAME = "GamePad-Drive-Motors"
HEAD = "@prefix fierro: <fierro:> . @prefix switchboard: <switchboard:> .\n"
WHOLE = "fierro:R a fierro:role ; fierro:subject fierro:S ; fierro:action fierro:A ; fierro:directObject fierro:D .\n"
BOUND = f"{WHOLE} fierro:S switchboard:resource"


def graph(body: bytes, media: str) -> Graph:
    return Graph().parse(data=body, format=media, publicID="fierro:")


@pytest.mark.parametrize("media", FORMATS)
def test_the_listing_is_the_same_in_each_form_and_back(media: str) -> None:
    (role,) = load(LISTING, XML)
    assert (role.name, role.statements, role.robots, role.notes) == (NAME, 23, ["pad"], [])
    body = write([role.document], media)
    assert isomorphic(graph(body, media), graph(LISTING, XML))
    assert load(body, media)[0].document == role.document


def test_resources_need_only_be_named() -> None:
    (role,) = load((HEAD + WHOLE).encode(), TURTLE)
    assert (role.name, role.statements) == ("R", 4)


def test_relative_names_are_in_the_namespace_of_roles() -> None:
    body = LISTING.replace(b'rdf:about="fierro:', b'rdf:about="').replace(
        b'rdf:resource="fierro:', b'rdf:resource="'
    )
    assert load(body, XML)[0].document == load(LISTING, XML)[0].document


def test_a_document_of_several_roles_is_parted() -> None:
    other = WHOLE.replace("fierro:R", "fierro:Q").replace("fierro:S", "fierro:T")
    more = (
        "fierro:S fierro:data fierro:X . fierro:T fierro:data fierro:Y . fierro:M fierro:mapping fierro:X ."
    )
    roles = load((HEAD + WHOLE + other + more).encode(), TURTLE)
    assert {each.name: each.statements for each in roles} == {"R": 6, "Q": 5}
    with pytest.raises(
        InvalidRole, match="'fierro:M fierro:mapping fierro:Z': this belongs to none of the Roles"
    ):
        load((HEAD + WHOLE + other + "fierro:M fierro:mapping fierro:Z .").encode(), TURTLE)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the document has no Role"),
        (WHOLE + "fierro:R fierro:action fierro:B .", "this Role has a fierro:action already"),
        (WHOLE + "fierro:S a fierro:port .", "the value has the type fierro:port, not fierro:subject"),
        (WHOLE + "fierro:S fierro:prot fierro:P .", "no property fierro:prot; is fierro:port meant?"),
        (WHOLE + "fierro:S a fierro:sbject .", "no type fierro:sbject; is fierro:subject meant?"),
        (WHOLE + 'fierro:S fierro:data "x" .', "'fierro:S fierro:data \"x\"': the value is a text"),
        (f'{BOUND} "rover" .', "the value is no address of a resource, such as robots/rover"),
        (WHOLE + "fierro:S switchboard:robot 1 .", "the only property there is switchboard:resource"),
        (WHOLE.replace("fierro:R", "<fierro:a%20b>"), "its name is not one of letters"),
    ],
)
def test_missing_role_field_is_named_with_the_statement(text: str, words: str) -> None:
    with pytest.raises(InvalidRole) as error:
        load((HEAD + text).encode(), TURTLE)
    assert any(words in each for each in error.value.problems), error.value.problems


def test_a_role_that_lacks_parts_is_loaded_and_says_so() -> None:
    (role,) = load((HEAD + "fierro:R a fierro:role ; fierro:action fierro:A .").encode(), TURTLE)
    lacks = [
        f"fierro:R is a Role without fierro:{part}; add 'fierro:R fierro:{part} …'"
        for part in ("subject", "directObject")
    ]
    assert role.notes == lacks
    graphs = RoleGraphs()
    graphs.put(role.name, role.document)
    assert graphs.missing("R") == lacks


PAPER = Path("tests/data/roles/lever-raises-gate.rdf").read_bytes()
"""In the form of the paper: its namespace without a hash for properties, literal IDs, resources that are only named."""


def test_a_file_in_the_form_of_the_paper_loads_and_comes_back_as_it_was() -> None:
    (role,) = load(PAPER, XML)
    assert (role.name, role.notes) == ("Lever-Raise-Gate", [])
    for media in FORMATS:
        body = write([role.document], media)
        assert isomorphic(graph(body, media), graph(PAPER, XML))
        assert load(body, media)[0].document == role.document


def test_the_derivation_of_the_paper_is_a_query_on_its_file() -> None:
    """From an element over its mapping to the port, the process, the action and the Role."""
    (role,) = load(PAPER, XML)
    graphs = RoleGraphs()
    graphs.put(role.name, role.document)
    assert graphs.roles_of("http://lab.example/LEVER_0", None) == ["Lever-Raise-Gate"]
    assert graphs.missing(role.name) == []
    names = {each["iri"] for each in graphs.elements(role.name)}
    assert {"http://lab.example/LEVER_0", "fierro:Port_2"} <= names
    assert not {each for each in names if "Lever-Raise-Gate" in each or "titech" in each}
    _, rows = graphs.query(
        """PREFIX fierro: <http://www-robot.mes.titech.ac.jp/fierro#>
           SELECT ?port ?process ?action ?role {
             <http://lab.example/LEVER_0> fierro:mapping ?port . ?process fierro:port ?port .
             ?action fierro:process ?process . ?role fierro:action ?action ; a fierro:role }""",
        None,
        RESULTS_CSV,
        TURTLE_RESULT,
    )
    assert rows.decode().splitlines()[1] == (
        "fierro:Port_2,http://lab.example/leverdriver,http://lab.example/raise,"
        "http://lab.example/Lever-Raise-Gate"
    )


@pytest.mark.parametrize("spelling", ["{}", "#{}"])
@pytest.mark.parametrize("kind", PROPERTIES)
def test_each_type_of_the_paper_loads_with_all_its_properties(kind: str, spelling: str) -> None:
    space = "http://www-robot.mes.titech.ac.jp/fierro"
    lines = [
        f"<{space}{spelling.format(each)}> <http://lab.example/value{each}>"
        for each in sorted(PROPERTIES[kind])
    ]
    item = f"<http://lab.example/item> a <{space}#{kind}> ; <{space}{spelling.format('ID')}> 'ITEM' ;"
    text = f"{item} {' ; '.join(lines)} ."
    if kind != "role":
        text += f" <http://lab.example/R> a <{space}#role> ; <{space}subject> <http://lab.example/s> ."
    (role,) = load(text.encode(), TURTLE)
    assert all("without" in each for each in role.notes)
    graphs = RoleGraphs()
    graphs.put(role.name, role.document)
    (found,) = [each for each in graphs.elements(role.name) if each["iri"].endswith("item")] or [None]
    assert found is None if kind == "role" else found is not None and found["types"] == [kind]


def test_an_id_is_a_text() -> None:
    with pytest.raises(InvalidRole, match="it must be a text"):
        load((HEAD + WHOLE + "fierro:S fierro:ID fierro:T .").encode(), TURTLE)


def test_unusual_statements_are_noted() -> None:
    (role,) = load((HEAD + WHOLE + "fierro:S a fierro:subject ; fierro:port fierro:P .").encode(), TURTLE)
    assert role.notes == [
        "'fierro:S fierro:port fierro:P': a resource of type fierro:subject usually has no fierro:port"
    ]


@pytest.mark.parametrize(
    ("address", "robot"),
    [
        ("robots/rover/topics/joy#/axes/0", "rover"),
        ("/api/v1/robots/rover%40lab/services/reset", "rover@lab"),
        ("robots/rover/modules/base", "rover"),
    ],
)
def test_robots_of_elements_are_known(address: str, robot: str) -> None:
    assert load(f'{HEAD}{BOUND} "{address}" .'.encode(), TURTLE)[0].robots == [robot]


@pytest.mark.parametrize(
    ("media", "body", "words"),
    [
        (XML, b'<!DOCTYPE r [<!ENTITY a "aa">]><r>&a;</r>', "document type"),
        (XML, "<r/>".encode("utf-16"), "not UTF-8"),
        (XML, b"<a>" * 100_000, "64 elements within each other"),
        (XML, b"<a>", "not valid XML"),
        (JSON_LD, b'{"@id":"fierro:a","@id":"fierro:b"}', "the key '@id' twice"),
        (JSON_LD, b"[" * 100_000, "64 brackets within each other"),
        (JSON_LD, b'"' + b'\\"' * 400_000, "not valid"),
        (JSON_LD, b'{"@context": "http://127.0.0.1:9/x"}', "not valid"),
        (TURTLE, f'{HEAD}fierro:a fierro:b "{"x" * 900_000}" .'.encode(), "16384 are allowed"),
        (TURTLE, f"<fierro:{'x' * 2000}> a <fierro:b> .".encode(), "more than 1024 characters"),
        (TURTLE, b"\n".join(b"<a:%d> <b:b> <c:c> ." % each for each in range(20_000)), "10000 statements"),
        (TURTLE, b"#" * 2_000_000, "1048576 are allowed"),
        (TURTLE, b"nothing", "not valid"),
    ],
)
def test_hostile_documents_are_refused_with_a_reason(media: str, body: bytes, words: str) -> None:
    with pytest.raises(Invalid, match=words):
        load(body, media)
