"""``/api/v1/vocabulary`` on transports in memory: in which form, to whom, and what is not there."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rdflib import RDF, RDFS, Graph, URIRef

from relay_protocol.ros_types import TypeRegistry
from relay_server.access import Principal
from relay_server.http.rdf import http as module
from relay_server.http.rdf.vocabulary_page import DOCUMENTS, HTML
from tests.relay_server.edges.http_client import HOST, World

HERE = "/api/v1/vocabulary"
ANN, ROOT = ({"Authorization": f"Bearer {each}"} for each in ("ann", "root"))
MEDIA = [each.media for each in DOCUMENTS]


class Access:
    """Ann has a right on robot 7, and nobody else on any."""

    async def robots(self, principal: Principal) -> list[Any]:
        """With what may be done there."""
        numbers = [7, 8] if principal.name == "ann" else []
        return [(SimpleNamespace(id=number), None) for number in numbers]


class Threads:
    """Does all at once."""

    async def run(self, work: Any, *args: Any) -> Any:
        """Here."""
        return work(*args)


class Registry:
    """Robot 7 has told of one type of messages and one of services; robot 8 is not there."""

    def __init__(self) -> None:
        types = TypeRegistry()
        types.add("made_up/msg/Odd", "bool on\n")
        types.add("made_up/srv/Ask", "string what\n---\nstring said\n")
        self._robot = SimpleNamespace(types=types)

    def find(self, number: int) -> Any:
        """What is known of it."""
        return self._robot if number == 7 else None


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A site with a vocabulary."""
    made = World(tmp_path)
    parts: tuple[Any, ...] = Access(), Registry(), Threads()
    made.beside["vocabulary"] = partial(module.beside, module.TypeDocs(*parts))
    return made


@pytest.mark.parametrize("media", MEDIA)
@pytest.mark.parametrize("name", ["switchboard", "fields", "made_up/Odd", "made_up/srv/Ask_Request"])
def test_words_are_told_in_every_form(world: World, name: str, media: str) -> None:
    """At the host that was asked; known again by a tag."""
    answer = world.ask("GET", f"{HERE}/{name}", Accept=media, **ANN)
    assert (answer.status, answer.headers["content-type"]) == (200, f"{media}; charset=utf-8")
    assert answer.headers["vary"] == "Accept"
    if media != HTML.media:
        graph = Graph().parse(data=answer.body, format=media)
        assert (URIRef(f"http://{HOST}{HERE}/{name}"), RDF.type, None) in graph
    known = world.ask("GET", f"{HERE}/{name}", Accept=media, If_None_Match=answer.headers["etag"], **ANN)
    assert (known.status, known.body) == (304, b"")


def test_the_relays_own_words_are_for_everybody(world: World) -> None:
    """They say nothing of any robot; programs that name no form get Turtle, browsers a page."""
    plain = world.ask("GET", f"{HERE}/switchboard")
    assert plain.headers["content-type"] == "text/turtle; charset=utf-8"
    browser = world.ask("GET", f"{HERE}/switchboard", Accept="text/html,application/xml;q=0.9,*/*;q=0.8")
    assert browser.headers["content-type"] == "text/html; charset=utf-8"
    assert b'<dt id="snapshot">' in browser.body


def test_what_a_type_is_is_told_to_who_may_see_a_robot_that_has_it(world: World) -> None:
    """What the relay's own services take everybody who is known may see."""
    told = world.ask("GET", f"{HERE}/made_up/Odd", **ANN)
    assert (None, RDFS.range, None) in Graph().parse(data=told.body, format="turtle")
    hidden = world.ask("GET", f"{HERE}/made_up/Odd", **ROOT)
    assert (hidden.status, hidden.json["detail"]) == (404, module.NOT_KNOWN)
    assert world.ask("GET", f"{HERE}/switchboard_msgs/Control", **ROOT).status == 200


@pytest.mark.parametrize(
    ("method", "path", "headers", "status"),
    [
        ("GET", f"{HERE}/made_up/Odd", {}, 401),
        ("GET", f"{HERE}/other", ANN, 404),
        ("GET", f"{HERE}/made_up/Other", ANN, 404),
        ("GET", f"{HERE}/made_up/srv/Ask", ANN, 404),
        ("GET", f"{HERE}/made-up/1", ANN, 404),
        ("GET", f"{HERE}/a/b/c/d", ANN, 404),
        ("GET", HERE, ANN, 404),
        ("GET", f"{HERE}/switchboard", {"Accept": "image/png"}, 406),
        ("PUT", f"{HERE}/switchboard", ANN, 405),
    ],
)
def test_what_is_not_there_is_told(
    world: World, method: str, path: str, headers: dict[str, str], status: int
) -> None:
    """As problem details."""
    answer = world.ask(method, path, **headers)
    assert (answer.status, answer.json["status"]) == (status, status)


def test_a_host_that_can_not_be_gets_no_document(world: World) -> None:
    """Nothing of it comes into the text."""
    assert world.ask("GET", f"{HERE}/switchboard", Host='"><script>').status == 400
