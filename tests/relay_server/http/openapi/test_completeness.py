"""The OpenAPI document describes every endpoint, and nothing else."""

from __future__ import annotations

import base64
import hashlib
import importlib
import inspect
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ForwardRef, is_typeddict

import pytest
from klein import Klein
from openapi_spec_validator import OpenAPIV31SpecValidator
from twisted.internet.task import Clock

import relay_server
from relay_server.common.clock import PeriodicTimers
from relay_server.http.admin_socket import AdminSocket
from relay_server.http.endpoint import endpoints_of
from relay_server.http.media_types import JSON
from relay_server.http.openapi.http import ENDPOINTS, SERVED, operations
from relay_server.http.openapi.operation import ApiOperation, operations_in
from relay_server.video.http import VideoResource
from tests.worlds.http_client import World


def modules() -> Iterator[Any]:
    """All modules of the relay."""
    for found in pkgutil.walk_packages(relay_server.__path__, "relay_server."):
        yield importlib.import_module(found.name)


def applications() -> list[type]:
    """All classes with routes of klein."""
    found = {
        each
        for module in modules()
        for each in vars(module).values()
        if inspect.isclass(each)
        and each.__module__ == module.__name__
        and isinstance(vars(each).get("app"), Klein)
    }
    return sorted(found, key=lambda each: each.__name__)


@pytest.fixture
def world(tmp_path: Path) -> World:
    """A site with the document."""
    return World(tmp_path, documented=True)


def test_every_group_of_endpoints_is_described() -> None:
    """Each group of a module is in the document."""
    found = {
        each
        for module in modules()
        for each in vars(module).values()
        if inspect.isclass(each) and each.__module__ == module.__name__ and endpoints_of(each)
    }
    assert found == set(ENDPOINTS)


def test_all_other_routes_are_endpoints() -> None:
    """Only the local socket is served by klein."""
    assert applications() == [AdminSocket]


def test_other_routes_are_described() -> None:
    """These are a robot's cameras, with all their addresses and the websocket."""
    clock = Clock()
    video: Any = VideoResource(clock, PeriodicTimers(clock), None, None, None, None)  # type: ignore[arg-type]
    reported = {
        each.path.removeprefix("/robots/{robot}/video/")
        for each in operations_in(vars(VideoResource).values())
    }
    assert reported == {each.decode() for each in video._answers} | {"ws"}


def test_only_endpoints_read_json_bodies() -> None:
    """Their signature says how it is read."""
    applications = [each for kind in SERVED for each in vars(kind).values()]
    assert not [each for each in operations_in(applications) if each.body and each.media[0] == JSON.media]


def test_operation_states_its_right_once() -> None:
    """No two operations have the same method and address."""
    reported = [(each.method, each.path) for each in operations()]
    assert len(reported) == len(set(reported))


def test_the_document_is_valid_and_public(world: World) -> None:
    """By the specification's own schema, and without a login."""
    answer = world.ask("GET", "/api/openapi.json")
    assert (answer.status, answer.headers["content-type"]) == (200, "application/json")
    OpenAPIV31SpecValidator(answer.json).validate()
    assert len([1 for methods in answer.json["paths"].values() for _ in methods]) == len(operations())


@pytest.mark.parametrize("path", ["/api/openapi.json", "/api/docs"])
def test_repeated_take_answers_that_control_is_held(world: World, path: str) -> None:
    """The entity tag is made from the content."""
    first = world.ask("GET", path)
    assert first.headers["cache-control"] == "no-cache"
    again = world.ask("GET", path, If_None_Match=first.headers["etag"])
    assert (again.status, again.body) == (304, b"")
    assert world.ask("GET", path, If_None_Match='"another"').status == 200


def test_the_page_is_html_under_the_relays_policy(world: World) -> None:
    """The policy allows its only style, and it has no script."""
    page = world.ask("GET", "/api/docs")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    assert b"/api/v1/robots/<wbr>" in page.body or b"{robot}" in page.body


@pytest.mark.parametrize("path", ["/api/openapi.json", "/api/docs"])
def test_documents_are_only_read(world: World, path: str) -> None:
    """Other methods get an error with a reason."""
    answer = world.ask("POST", path, {})
    assert (answer.status, answer.headers["allow"]) == (405, "GET, HEAD")
    assert answer.headers["content-type"] == "application/problem+json"


def test_operations_are_described() -> None:
    """Each has a short summary and at least one successful answer."""
    for each in operations():
        assert isinstance(each, ApiOperation)
        assert 0 < len(each.summary) < 80, each.path
        assert any(status < 400 for status in each.answers), each.path


def test_bodies_inherit_fields_within_their_module() -> None:
    """With Python 3.14, msgspec looks up the types of inherited fields in the heir's module, and fails."""
    bodies = {each for module in modules() for each in vars(module).values() if is_typeddict(each)}
    strange = {
        f"{body.__module__}.{body.__name__}.{field}"
        for body in bodies
        for field, type_ in body.__annotations__.items()
        if isinstance(type_, ForwardRef) and type_.__forward_module__ not in (None, body.__module__)
    }
    assert len(bodies) > 50
    assert not strange


def test_the_page_allows_its_own_style_by_its_hash_and_no_other(world: World) -> None:
    """As on every page, without ``unsafe-inline``."""
    answer = world.ask("GET", "/api/docs")
    policy = answer.headers["content-security-policy"]
    style = answer.body.decode().partition("<style>")[2].partition("</style>")[0]
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    assert f"style-src 'sha256-{digest}';" in policy
    for path in ("/api/docs", "/", "/api/v1/session", "/robots/rover/video/stream_viewer"):
        assert "unsafe" not in world.ask("GET", path).headers["content-security-policy"]
