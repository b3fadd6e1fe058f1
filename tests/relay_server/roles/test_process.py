"""The process that queries Roles: results, and the end of queries that explode while others go on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import Deferred

from relay_protocol.errors import Invalid, Unavailable
from relay_server.roles.documents import load
from relay_server.roles.process import RoleProcess
from relay_server.roles.sparql import RESULTS_CSV, RESULTS_JSON, RESULTS_XML, TURTLE

(ROLE,) = load(Path("docs/examples/roles/gamepad.rdf").read_bytes(), "application/rdf+xml")
DOCS = Path("docs/guides/roles.md").read_text()
HERE = {"realm": "lab", "names": None}
FORMS = {"media": RESULTS_CSV, "graph_media": TURTLE}
PORTS = "SELECT ?port { ?process fierro:port ?port } ORDER BY ?port"


@pytest.fixture(scope="module")
def process() -> Iterator[RoleProcess]:
    made = RoleProcess(reactor)
    pytest_twisted.blockon(
        Deferred.fromCoroutine(made.ask("put", realm="lab", name=ROLE.name, text=ROLE.document))
    )
    yield made
    pytest_twisted.blockon(made.close())


@pytest_twisted.ensureDeferred
async def test_an_element_leads_to_its_role(process: RoleProcess) -> None:
    assert await process.ask("roles_of", text="fierro:AXIS_0", **HERE) == ["GamePad-Drive-Motors"]
    assert await process.ask("roles_of", text="fierro:AXIS_9", **HERE) == []
    assert await process.ask("roles_of", text="fierro:AXIS_0", realm="lab", names=[]) == []
    with pytest.raises(Invalid):
        await process.ask("roles_of", text="fierro:a> ?b ?c } #", **HERE)


@pytest.mark.parametrize(
    ("query", "media", "expected"),
    [
        (PORTS, RESULTS_CSV, b"port\r\nfierro:Port_5\r\nfierro:Port_6\r\n"),
        (PORTS + " LIMIT 1", RESULTS_JSON, b'{"head":{"vars":["port"]},"results":{"bindings":[{"port":{"type":"uri",'
         b'"value":"fierro:Port_5"}}]}}'),
        ("SELECT ('<\\u0001' AS ?x) {}", RESULTS_XML, "<literal>&lt;\ufffd</literal>".encode()),
        ("SELECT (1 AS ?x) ('a'@en AS ?y) {}", RESULTS_JSON, b'"xml:lang":"en"'),
        ("ASK { ?s fierro:port ?o }", RESULTS_XML, b"<boolean>true</boolean>"),
        ("CONSTRUCT { ?s fierro:port ?o } { ?s fierro:port ?o }", RESULTS_CSV, b"fierro:GamePadX fierro:port"),
        ("SELECT ?g { GRAPH ?g { ?s fierro:subject ?o } }", RESULTS_CSV, b"g\r\nfierro:GamePad-Drive-Motors\r\n"),
    ],
)  # fmt: skip
@pytest_twisted.ensureDeferred
async def test_results_have_the_form_that_is_asked_for(
    process: RoleProcess, query: str, media: str, expected: bytes
) -> None:
    _, body = await process.ask("query", text=query, media=media, graph_media=TURTLE, **HERE)
    assert expected in body


@pytest.mark.parametrize(
    "query",
    [
        "SELECT ?s { ?s ?p ?o }",
        "SELECT ?s FROM <fierro:GamePad-Drive-Motors> { ?s ?p ?o }",
        "SELECT ?s { GRAPH <fierro:GamePad-Drive-Motors> { ?s ?p ?o } }",
    ],
)
@pytest_twisted.ensureDeferred
async def test_a_query_has_only_the_roles_of_its_user(process: RoleProcess, query: str) -> None:
    names: list[str] = []
    _, body = await process.ask("query", text=query, realm="lab", names=names, **FORMS)
    assert body == b"s\r\n"


@pytest_twisted.ensureDeferred
async def test_the_queries_of_the_documentation_have_their_answers(process: RoleProcess) -> None:
    _, derivation, path = (each.partition("```")[0] for each in DOCS.split("```sparql\n"))
    _, body = await process.ask("query", text=derivation, **HERE, **FORMS)
    header, row = (each.split(",") for each in body.decode().split())
    assert f"| {' | '.join(header)} |\n|---|---|---|---|\n| {' | '.join(row)} |\n" in DOCS
    assert row == ["fierro:Port_5", "fierro:GamePadX", "fierro:Drive", "fierro:GamePad-Drive-Motors"]
    _, body = await process.ask("query", text=path, **HERE, **FORMS)
    assert body == b"role\r\nfierro:GamePad-Drive-Motors\r\n"


@pytest_twisted.ensureDeferred
async def test_an_element_leads_over_the_visible_roles_alone(process: RoleProcess) -> None:
    near = ROLE.document.replace("GamePad-Drive-Motors", "Near").replace("fierro:", "fierro:n")
    near = near.replace("fierro:nNear", "fierro:Near").replace("fierro:nrole", "fierro:role")
    for word in (
        "subject",
        "action",
        "directObject",
        "data",
        "structuredData",
        "field",
        "process",
        "port",
        "mapping",
    ):
        near = near.replace(f"<fierro:n{word}>", f"<fierro:{word}>")
    bridge = "<fierro:nAXIS_1> <fierro:mapping> <fierro:Port_6> ."
    for name, document in {"Near": near, "Bridge": bridge, "Whole": ROLE.document}.items():
        await process.ask("put", realm="bridged", name=name, text=document)

    async def roles(*names: str) -> list[str]:
        return sorted(
            await process.ask("roles_of", realm="bridged", names=list(names), text="fierro:nAXIS_1")
        )

    assert await roles("Near", "Whole") == ["Near"]
    assert await roles("Near", "Whole", "Bridge") == ["GamePad-Drive-Motors", "Near"]
    assert await roles("Whole", "Bridge") == ["GamePad-Drive-Motors"]


@pytest_twisted.ensureDeferred
async def test_an_element_of_many_roles_is_resolved_in_a_process_of_its_own(process: RoleProcess) -> None:
    kind, names = "<http://www.w3.org/1999/02/22-rdf-syntax-ns#type>", [f"M{each}" for each in range(1100)]
    for name in names:
        text = f"<fierro:{name}> {kind} <fierro:role> .\n<fierro:{name}> <fierro:action> <fierro:COMMON> ."
        await process.ask("put", realm="many", name=name, text=text)
    shared = {"realm": "many", "text": "fierro:COMMON"}
    for seen in (None, names, names[:3]):
        assert await process.ask("roles_of", names=seen, **shared) is None
        found = await process.ask("all_roles_of", names=seen, **shared)
        assert sorted(found) == sorted(names if seen is None else seen)
    with pytest.raises(Invalid, match="took longer than"):
        await process.ask("all_roles_of", names=None, seconds=0.0001, **shared)


PRODUCT = " ".join(f"?a{each} ?b{each} ?c{each} ." for each in range(8))


@pytest.mark.parametrize(
    ("query", "words"),
    [
        (f"SELECT (COUNT(*) AS ?n) {{ {PRODUCT} }}", "took longer than 0.2 s"),
        ("SELECT * " + "{" * 5000 + "}" * 5000, "nested too deeply"),
        ("SELECT * { SERVICE <http://127.0.0.1:9/> { ?a ?b ?c } }", "was not carried out"),
        ("SELECT * { ?a ?b ?c . ?d ?e ?f . ?g ?h ?i }", "more than 10000 rows"),
        ("DELETE WHERE { ?a ?b ?c }", "was not carried out"),
        ("no query", "was not carried out"),
    ],
)
@pytest_twisted.ensureDeferred
async def test_an_exploding_query_is_ended_with_a_reason(
    process: RoleProcess, query: str, words: str
) -> None:
    seconds = 0.2 if "COUNT" in query else 60.0
    failing = Deferred.fromCoroutine(process.ask("query", text=query, seconds=seconds, **HERE, **FORMS))
    failing.addErrback(lambda failure: failure.value)
    # Another query is answered meanwhile.
    assert await process.ask("query", text=PORTS, **HERE, **FORMS)
    error: Any = await failing
    assert isinstance(error, Invalid)
    assert words in str(error)


@pytest_twisted.ensureDeferred
async def test_after_its_death_the_process_begins_again() -> None:
    process = RoleProcess(reactor)
    await process.ask("roles_of", text="fierro:AXIS_0", **HERE)
    waiting = Deferred.fromCoroutine(process.ask("query", text="SELECT (COUNT(*) AS ?n) {}", **HERE, **FORMS))
    process._late()
    with pytest.raises(Unavailable, match="has ended"):
        await waiting
    assert await process.ask("roles_of", text="fierro:AXIS_0", **HERE) == []
    assert process.generation == 2
    await process.close()
    with pytest.raises(Unavailable, match="shutting down"):
        await process.ask("roles_of", text="fierro:AXIS_0", **HERE)


@pytest_twisted.ensureDeferred
async def test_resources_of_an_element_are_those_of_the_roles_that_may_be_used(process: RoleProcess) -> None:
    """However many others have it."""
    resource = '<fierro:X> <switchboard:resource> "robots/rover/topics/x" .'
    for number in range(150):
        await process.ask("put", realm="wide", name=f"W{number}", text=resource)
    one = {"realm": "wide", "items": ["fierro:X", "fierro:Y"]}
    for number in (0, 77, 149):
        found = await process.ask("resources_of", names=[f"W{number}"], **one)
        assert found == [["fierro:X", f"W{number}", "robots/rover/topics/x"]]
    with pytest.raises(Invalid, match="more than 100 resources"):
        await process.ask("resources_of", names=None, **one)
