"""The API described: nothing that is served is missing, nothing is told that is not there."""

from __future__ import annotations

import ast
import base64
import hashlib
import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from klein import Klein
from openapi_spec_validator import OpenAPIV31SpecValidator
from twisted.internet.task import Clock

import relay_server
from relay_server.common.timers import PeriodicTimers
from relay_server.fleet.order import FleetStopOrder
from relay_server.http.admin_socket import AdminSocket
from relay_server.http.openapi.http import SERVED, ApiDocuments, operations
from relay_server.http.openapi.operation import ApiOperation, operations_in
from relay_server.video.http import VideoResource
from tests.relay_server.edges.http_client import World

BRANCHES = {"below", "beside"}
"""Routes to further applications."""


def modules() -> Iterator[Any]:
    """All modules of the relay."""
    for found in pkgutil.walk_packages(relay_server.__path__, "relay_server."):
        yield importlib.import_module(found.name)


def applications() -> list[type]:
    """All classes with routes, but for that of the local socket."""
    found = {
        each
        for module in modules()
        for each in vars(module).values()
        if inspect.isclass(each)
        and each.__module__ == module.__name__
        and isinstance(vars(each).get("app"), Klein)
    }
    return sorted(found - {AdminSocket}, key=lambda each: each.__name__)


def template(rule: str) -> str:
    """A route's pattern as the end of a described address; what stands for several words as a pattern."""
    plain = re.sub(r"<any\(([^)]*)\):\w+>", lambda found: f"({found[1].replace(',', '|')})", rule)
    return re.sub(r"<(?:path:)?(\w+)>", r"\\{\\w+\\}", plain.rstrip("/")) + r"\Z"


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A site that tells of the API."""
    return World(tmp_path, documented=True)


@pytest.mark.parametrize("kind", applications(), ids=lambda kind: kind.__name__)
def test_every_route_is_described(kind: Any) -> None:
    """Each with its methods and its address; and whoever has routes is among those that are told of."""
    assert kind in (*SERVED, ApiDocuments)
    app = kind.app
    for rule in app.url_map.iter_rules():
        if rule.endpoint.removesuffix("_branch") in BRANCHES:
            continue
        told = operations_in([app.endpoints[rule.endpoint]])
        if rule.methods is None:
            # It tells which methods there are.
            assert not told, rule
            continue
        assert {each.method for each in told} == rule.methods - {"HEAD"}, rule
        for each in told:
            assert re.search(template(rule.rule), each.path), (rule, each.path)


def test_what_is_no_route_of_klein_is_described() -> None:
    """Of a robot's cameras: all addresses that are answered, and the websocket's."""
    clock = Clock()
    video: Any = VideoResource(clock, PeriodicTimers(clock), None, None, None)  # type: ignore[arg-type]
    told = {
        each.path.removeprefix("/robots/{robot}/video/")
        for each in operations_in(vars(VideoResource).values())
    }
    assert told == {each.decode() for each in video._answers} | {"ws"}


def test_the_bodies_described_are_those_that_are_validated() -> None:
    """Each type that an edge reads a body as stands at an operation, and no other does."""
    read = set()
    for module in modules():
        for node in ast.walk(ast.parse(inspect.getsource(module))):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("body_of", "_body", "self._added"):
                name = ast.unparse(node.args[1])
                # In such a helper it is the parameter.
                if name != "kind":
                    read.add(id(vars(module)[name]))
    told = {id(each.body) for each in operations() if each.media[0] == "application/json" and each.body}
    assert read - {id(FleetStopOrder)} == told


def test_what_an_operation_needs_is_told_once() -> None:
    """No two have one method and address."""
    told = [(each.method, each.path) for each in operations()]
    assert len(told) == len(set(told))


def test_the_document_is_valid_and_for_everybody(world: World) -> None:
    """By the specification's own schema; nobody needs to log in."""
    answer = world.ask("GET", "/api/openapi.json")
    assert (answer.status, answer.headers["content-type"]) == (200, "application/json")
    OpenAPIV31SpecValidator(answer.json).validate()
    assert len([1 for methods in answer.json["paths"].values() for _ in methods]) == len(operations())


@pytest.mark.parametrize("path", ["/api/openapi.json", "/api/docs"])
def test_who_has_it_already_is_told_so(world: World, path: str) -> None:
    """By its entity tag, which is of the content."""
    first = world.ask("GET", path)
    assert first.headers["cache-control"] == "no-cache"
    again = world.ask("GET", path, If_None_Match=first.headers["etag"])
    assert (again.status, again.body) == (304, b"")
    assert world.ask("GET", path, If_None_Match='"another"').status == 200


def test_the_page_is_html_under_the_relays_policy(world: World) -> None:
    """It has no script, and its one style is named by the policy."""
    page = world.ask("GET", "/api/docs")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    assert b"/api/v1/robots/<wbr>" in page.body or b"{robot}" in page.body


@pytest.mark.parametrize("path", ["/api/openapi.json", "/api/docs"])
def test_documents_are_only_read(world: World, path: str) -> None:
    """What else is tried is told in words."""
    answer = world.ask("POST", path, {})
    assert (answer.status, answer.headers["allow"]) == (405, "GET, HEAD")
    assert answer.headers["content-type"] == "application/problem+json"


def test_each_operation_says_what_it_is() -> None:
    """A summary of few words, and at least one answer that is no error."""
    for each in operations():
        assert isinstance(each, ApiOperation)
        assert 0 < len(each.summary) < 80, each.path
        assert any(status < 400 for status in each.answers), each.path


def test_the_page_allows_its_own_style_by_its_hash_and_no_other(world: World) -> None:
    """As every page, without ``unsafe-inline``."""
    answer = world.ask("GET", "/api/docs")
    policy = answer.headers["content-security-policy"]
    style = answer.body.decode().partition("<style>")[2].partition("</style>")[0]
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    assert f"style-src 'sha256-{digest}';" in policy
    for path in ("/api/docs", "/", "/api/v1/session", "/robots/rover/video/stream_viewer"):
        assert "unsafe" not in world.ask("GET", path).headers["content-security-policy"]
