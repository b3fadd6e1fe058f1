"""Pages of listed origins: preflights, answers that they may read, frames; and those of all other origins."""

from __future__ import annotations

from pathlib import Path

import pytest

from relay_protocol.errors import Invalid
from relay_server.auth.origins import Origins
from relay_server.http.cross_origin import ANSWER_FIELDS, METHODS, REQUEST_FIELDS
from relay_server.http.openapi.document import document
from relay_server.http.openapi.http import operations
from tests.worlds.http_client import ORIGIN, Answer, World

PAGE = "https://pages.example:8443"
OTHER = "https://pages.example"
BEARER = {"Authorization": "Bearer ann"}


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A site that lists the origin of a page."""
    return World(tmp_path, documented=True, listed=(PAGE,))


def names(answer: Answer) -> set[str]:
    """The fields of an answer that are about other origins."""
    return {each for each in answer.headers if each.startswith("access-control-")}


def preflight(world: World, path: str, origin: str = PAGE, method: str = "POST") -> Answer:
    """The answer to the question whether a page may send a request."""
    asked = {"Access-Control-Request-Method": method, "Access-Control-Request-Headers": "authorization"}
    return world.ask("OPTIONS", path, Origin=origin, **asked)


@pytest.mark.parametrize(
    "path", ["/api/v1/tickets", "/api/v1/robots", "/oauth/token", "/robots/rover/video/snapshot", "/healthz"]
)
def test_a_preflight_of_a_listed_origin_is_answered_without_credentials(world: World, path: str) -> None:
    answer = preflight(world, path)
    assert (answer.status, answer.body) == (204, b"")
    assert answer.headers["access-control-allow-origin"] == PAGE
    assert answer.headers["access-control-allow-credentials"] == "true"
    assert "POST" in answer.headers["access-control-allow-methods"].split(", ")
    assert "Authorization" in answer.headers["access-control-allow-headers"].split(", ")
    assert answer.headers["vary"] == "Origin"


@pytest.mark.parametrize("origin", [OTHER, "null", "*", "", "https://pages.example:8443.evil", "http://a b"])
def test_other_origins_get_no_permission(world: World, origin: str) -> None:
    refused = preflight(world, "/api/v1/tickets", origin)
    assert refused.status == 405
    read = world.ask("GET", "/api/v1/robots", Origin=origin, **BEARER)
    assert not names(refused) | names(read)
    assert "Origin" in read.headers["vary"]


def test_without_a_list_no_page_of_another_origin_gets_permission(tmp_path: Path) -> None:
    """Nor does the relay's own origin need any."""
    world = World(tmp_path)
    for origin in (PAGE, ORIGIN):
        assert not names(preflight(world, "/api/v1/tickets", origin))
        assert not names(world.ask("GET", "/api/v1/robots", Origin=origin, **BEARER))


def test_a_page_of_a_listed_origin_gets_a_ticket_and_reads_answers(world: World) -> None:
    made = world.ask("POST", "/api/v1/tickets", {"robot": "rover"}, Origin=PAGE, **BEARER)
    assert (made.status, made.json["ticket"]) == (201, "ticket of ann")
    for path, status in (("/api/v1/robots", 200), ("/api/v1/none", 404), ("/robots/rover", 200)):
        answer = world.ask("GET", path, Origin=PAGE, **BEARER)
        assert answer.status == status
        assert answer.headers["access-control-allow-origin"] == PAGE
        assert "ETag" in answer.headers["access-control-expose-headers"].split(", ")


def test_a_page_of_a_listed_origin_may_read_why_it_is_refused(world: World) -> None:
    refused = world.ask("GET", "/api/v1/robots", Origin=PAGE)
    assert refused.status == 401
    assert refused.headers["access-control-allow-origin"] == PAGE


def test_a_preflight_counts_as_a_request_of_its_network(tmp_path: Path) -> None:
    world = World(tmp_path, listed=(PAGE,), rate=0.1)
    assert preflight(world, "/api/v1/tickets").status == 204
    refused = preflight(world, "/api/v1/tickets")
    assert refused.status == 429
    assert "retry-after" in refused.headers


def test_the_portal_stays_with_its_own_origin(world: World) -> None:
    """Its pages are in no frame, and no page of another origin reads them."""
    for path in ("/", "/login"):
        answer = world.ask("GET", path, Origin=PAGE)
        assert not names(answer)
        assert answer.headers["x-frame-options"] == "DENY"
        assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]


def test_pages_may_use_every_method_and_field_of_the_api() -> None:
    """Those that the OpenAPI document names."""
    paths = document(operations(), "1", "session")["paths"]
    found = [(method.upper(), each) for methods in paths.values() for method, each in methods.items()]
    assert {method for method, _ in found} <= set(METHODS)
    sent = {
        parameter["name"]
        for _, each in found
        for parameter in each.get("parameters", [])
        if parameter["in"] == "header"
    }
    answered = {
        name
        for _, each in found
        for answer in each["responses"].values()
        for name in answer.get("headers", {})
    }
    lower = [str.lower(each) for each in REQUEST_FIELDS]
    assert sorted(each for each in sent if each.lower() not in lower) == []
    readable = [str.lower(each) for each in ANSWER_FIELDS]
    # No page reads the session.
    assert sorted(each for each in answered if each.lower() not in readable) == ["Set-Cookie"]


def test_an_origin_is_written_as_browsers_write_it() -> None:
    origins = Origins("http", ["HTTPS://Pages.Example:443/", "http://[::1]:80", PAGE])
    assert origins.listed == ("http://[::1]", "https://pages.example", PAGE)


@pytest.mark.parametrize(
    "listed", ["https://a;script-src", "https://a b", "https://a,b", "https://ä.example"]
)
def test_an_origin_that_could_change_the_policy_is_not_taken(listed: str) -> None:
    with pytest.raises(Invalid):
        Origins("http", [listed])
