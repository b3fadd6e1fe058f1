"""``/api/v1/vocabulary`` on transports in memory: formats, rights and missing resources."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rdflib import RDF, RDFS, Graph, URIRef

from relay_protocol.ros_types import TypeRegistry
from relay_server.access import Principal
from relay_server.http.rdf import vocabulary as module
from relay_server.http.rdf.vocabulary import DOCUMENTS, HTML
from tests.worlds.http_client import HOST, World

HERE = "/api/v1/vocabulary"
ANN, ROOT = ({"Authorization": f"Bearer {each}"} for each in ("ann", "root"))
MEDIA = [each.media for each in DOCUMENTS]


class Access:
    """Ann has a right on robot 7; other users have none."""

    async def robots(self, principal: Principal) -> list[Any]:
        """With the rights on each."""
        numbers = [7, 8] if principal.name == "ann" else []
        return [(SimpleNamespace(id=number), None) for number in numbers]


class Threads:
    """Runs everything at once."""

    async def run(self, work: Any, *args: Any) -> Any:
        """Runs it here."""
        return work(*args)


class Registry:
    """Robot 7 has one message type and one service type; robot 8 does not exist."""

    def __init__(self) -> None:
        types = TypeRegistry()
        types.add("made_up/msg/Odd", "bool on\n")
        types.add("made_up/srv/Ask", "string what\n---\nstring said\n")
        self._robot = SimpleNamespace(types=types)

    def find(self, number: int) -> Any:
        """The robot of this number."""
        return self._robot if number == 7 else None


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A site with the vocabulary."""
    made = World(tmp_path)
    parts: tuple[Any, ...] = Access(), Registry(), Threads()
    made.router.add(module.VocabularyEndpoints(module.TypeDocs(*parts)))
    return made


@pytest.mark.parametrize("media", MEDIA)
@pytest.mark.parametrize("name", ["switchboard", "fields", "made_up/Odd", "made_up/srv/Ask_Request"])
def test_terms_are_served_in_every_media_type(world: World, name: str, media: str) -> None:
    """At the requested host, with an entity tag."""
    answer = world.ask("GET", f"{HERE}/{name}", Accept=media, **ANN)
    assert (answer.status, answer.headers["content-type"]) == (200, f"{media}; charset=utf-8")
    assert answer.headers["vary"] == "Accept"
    if media != HTML.media:
        graph = Graph().parse(data=answer.body, format=media)
        assert (URIRef(f"http://{HOST}{HERE}/{name}"), RDF.type, None) in graph
    known = world.ask("GET", f"{HERE}/{name}", Accept=media, If_None_Match=answer.headers["etag"], **ANN)
    assert (known.status, known.body) == (304, b"")


def test_the_relays_own_terms_are_public(world: World) -> None:
    """They contain nothing about robots. Programs without ``Accept`` get Turtle, browsers a page."""
    plain = world.ask("GET", f"{HERE}/switchboard")
    assert plain.headers["content-type"] == "text/turtle; charset=utf-8"
    browser = world.ask("GET", f"{HERE}/switchboard", Accept="text/html,application/xml;q=0.9,*/*;q=0.8")
    assert browser.headers["content-type"] == "text/html; charset=utf-8"
    assert b'<dt id="snapshot">' in browser.body


def test_type_is_shown_to_users_of_a_robot_that_has_it(world: World) -> None:
    """Types of the relay's own services are shown to every authenticated user."""
    reported = world.ask("GET", f"{HERE}/made_up/Odd", **ANN)
    assert (None, RDFS.range, None) in Graph().parse(data=reported.body, format="turtle")
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
def test_missing_resource_is_reported(
    world: World, method: str, path: str, headers: dict[str, str], status: int
) -> None:
    """As problem details."""
    answer = world.ask(method, path, **headers)
    assert (answer.status, answer.json["status"]) == (status, status)


def test_a_host_that_can_not_be_gets_no_document(world: World) -> None:
    """The host must not appear in the text."""
    assert world.ask("GET", f"{HERE}/switchboard", Host='"><script>').status == 400
