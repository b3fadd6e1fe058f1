"""Operations as an OpenAPI document."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any, TypedDict

import msgspec
import pytest
from msgspec import Meta
from openapi_spec_validator import OpenAPIV31SpecValidator

from relay_server.http.openapi.document import document
from relay_server.http.openapi.operation import ApiOperation, Credential, Response, header, query, raw


class ResizeBody(msgspec.Struct, forbid_unknown_fields=True):
    """A new size.

    :param size: in metres,
        not in feet
    """

    size: Annotated[float, Meta(ge=0)] = 1.0
    more: msgspec.Raw = raw(b"{}")


class ReasonedResizeBody(ResizeBody):
    """A new size and its reason.

    :param why: in words
    """

    why: str = ""


class Resized(TypedDict):
    """The new size; see :class:`ResizeBody`."""

    size: float


class Counted(TypedDict):
    """How many."""

    count: int


Other = type(
    "ResizeBody",
    (msgspec.Struct,),
    {"__annotations__": {"name": str}, "__module__": "relay_server.other.schemas"},
)

RESIZE = ApiOperation(
    method="POST",
    path="/api/v1/robots/{robot}/size",
    tag="robots",
    summary="Resize",
    parameters=(query("limit", "most", Annotated[int, Meta(ge=1, le=9)]), header("If-Match", "tags")),
    body=ResizeBody,
    answers={
        200: Response("resized", (Resized, Counted)),
        204: Response("no content", headers={"ETag": "a tag"}),
    },
    errors=(409,),
)


def made(*operations: ApiOperation) -> dict[str, Any]:
    """The valid document of some operations."""
    found = document(operations, "1.2.3", "sb")
    OpenAPIV31SpecValidator(found).validate()
    return found


@pytest.fixture
def reported() -> dict[str, Any]:
    """The description of one operation."""
    found: dict[str, Any] = made(RESIZE)["paths"][RESIZE.path]["post"]
    return found


def test_a_document_is_valid_openapi() -> None:
    """For the version that it names."""
    found = made(RESIZE)
    assert found["openapi"] == "3.1.1"
    assert found["info"]["version"] == "1.2.3"
    assert found["components"]["securitySchemes"]["session"]["name"] == "sb"


def test_schemas_are_those_of_the_types(reported: dict[str, Any]) -> None:
    """Bounds, defaults and closed fields are included; docstrings describe their fields."""
    schemas = made(RESIZE)["components"]["schemas"]
    assert reported["requestBody"]["content"] == {
        "application/json": {"schema": {"$ref": "#/components/schemas/ResizeBody"}}
    }
    size = {"type": "number", "minimum": 0, "default": 1.0, "description": "in metres, not in feet"}
    assert schemas["ResizeBody"]["properties"] == {"size": size, "more": {}}
    assert schemas["ResizeBody"]["additionalProperties"] is False
    assert schemas["ResizeBody"]["description"] == "A new size."
    assert schemas["Resized"]["description"] == "The new size; see `ResizeBody`."


def test_fields_of_a_base_class_are_described_too() -> None:
    schemas = made(dataclasses.replace(RESIZE, body=ReasonedResizeBody))["components"]["schemas"]
    described = {
        name: each.get("description") for name, each in schemas["ReasonedResizeBody"]["properties"].items()
    }
    assert described == {"size": "in metres, not in feet", "more": None, "why": "in words"}


def test_an_answer_may_have_one_of_several_types(reported: dict[str, Any]) -> None:
    """Or none."""
    refs = [{"$ref": f"#/components/schemas/{name}"} for name in ("Resized", "Counted")]
    assert reported["responses"]["200"]["content"]["application/json"]["schema"] == {"anyOf": refs}
    assert "content" not in reported["responses"]["204"]
    assert reported["responses"]["204"]["headers"]["ETag"]["description"] == "a tag"


def test_the_schema_of_a_stream_is_that_of_its_lines_or_events() -> None:
    streams = ("application/x-ndjson", "text/event-stream")
    answer = Response("lines", media=(*streams, "text/csv"), items=(Resized, Counted))
    found = made(ApiOperation(**{**vars(RESIZE), "answers": {200: answer}}))
    content = found["paths"][RESIZE.path]["post"]["responses"]["200"]["content"]
    refs = [{"$ref": f"#/components/schemas/{name}"} for name in ("Resized", "Counted")]
    assert content == {**{media: {"schema": {"anyOf": refs}} for media in streams}, "text/csv": {}}


def test_parameters_are_those_of_path_query_and_headers(reported: dict[str, Any]) -> None:
    """Only those of the path are required."""
    places = [(each["name"], each["in"], each.get("required", False)) for each in reported["parameters"]]
    assert places == [("robot", "path", True), ("limit", "query", False), ("If-Match", "header", False)]


@pytest.mark.parametrize(
    ("credential", "errors"),
    [
        (Credential.USER, {"400", "401", "403", "404", "409", "413", "429", "503"}),
        (Credential.NONE, {"400", "404", "409", "413", "429"}),
    ],
)
def test_common_errors_are_documented(credential: Credential, errors: set[str]) -> None:
    """They follow from its rights, its body, and the resource in its address."""
    reported = made(ApiOperation(**{**vars(RESIZE), "credential": credential}))
    responses = reported["paths"][RESIZE.path]["post"]["responses"]
    assert {status for status in responses if status >= "400"} == errors
    assert all("$ref" in responses[status] for status in errors)


def test_types_of_one_name_are_distinguished() -> None:
    """By their module."""
    other = ApiOperation(**{**vars(RESIZE), "path": "/api/v1/other", "body": Other})
    names = made(RESIZE, other)["components"]["schemas"]
    assert "OtherResizeBody" in names
    assert sum(name.endswith("ResizeBody") for name in names) == 2


def test_operations_have_unique_names() -> None:
    """They consist of letters and underscores and are made of method and address."""
    assert RESIZE.id == "post_robots_by_robot_size"
    live = ApiOperation(**{**vars(RESIZE), "path": "/robots/{robot}/size"})
    assert live.id == "post_live_robots_by_robot_size"
