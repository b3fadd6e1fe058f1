"""Operations as an OpenAPI document."""

from __future__ import annotations

from typing import Annotated, Any, TypedDict

import msgspec
import pytest
from msgspec import Meta
from openapi_spec_validator import OpenAPIV31SpecValidator

from relay_server.http.openapi.document import document
from relay_server.http.openapi.operation import ApiOperation, Credential, Response, header, query, raw


class Wish(msgspec.Struct, forbid_unknown_fields=True):
    """What is wished.

    :param size: in metres,
        not in feet
    """

    size: Annotated[float, Meta(ge=0)] = 1.0
    more: msgspec.Raw = raw(b"{}")


class Granted(TypedDict):
    """What is granted; see :class:`Wish`."""

    size: float


class Counted(TypedDict):
    """How many."""

    count: int


Other = type(
    "Wish", (msgspec.Struct,), {"__annotations__": {"name": str}, "__module__": "relay_server.other.desk"}
)

GIVE = ApiOperation(
    method="POST",
    path="/api/v1/robots/{robot}/wishes",
    tag="robots",
    summary="Wish",
    parameters=(query("limit", "most", Annotated[int, Meta(ge=1, le=9)]), header("If-Match", "tags")),
    body=Wish,
    answers={
        200: Response("granted", (Granted, Counted)),
        204: Response("not told", headers={"ETag": "a tag"}),
    },
    errors=(409,),
)


def made(*operations: ApiOperation) -> dict[str, Any]:
    """The document of some operations, which is valid."""
    found = document(operations, "1.2.3", "sb")
    OpenAPIV31SpecValidator(found).validate()
    return found


@pytest.fixture
def told() -> dict[str, Any]:
    """What is told of one operation."""
    found: dict[str, Any] = made(GIVE)["paths"][GIVE.path]["post"]
    return found


def test_a_document_is_valid_openapi() -> None:
    """Of the version that it says."""
    found = made(GIVE)
    assert found["openapi"] == "3.1.1"
    assert found["info"]["version"] == "1.2.3"
    assert found["components"]["securitySchemes"]["session"]["name"] == "sb"


def test_schemas_are_those_of_the_types(told: dict[str, Any]) -> None:
    """Their bounds, defaults and closed fields; the words of docstrings stand at the fields they are about."""
    schemas = made(GIVE)["components"]["schemas"]
    assert told["requestBody"]["content"] == {
        "application/json": {"schema": {"$ref": "#/components/schemas/Wish"}}
    }
    size = {"type": "number", "minimum": 0, "default": 1.0, "description": "in metres, not in feet"}
    assert schemas["Wish"]["properties"] == {"size": size, "more": {}}
    assert schemas["Wish"]["additionalProperties"] is False
    assert schemas["Wish"]["description"] == "What is wished."
    assert schemas["Granted"]["description"] == "What is granted; see `Wish`."


def test_an_answer_may_have_one_of_several_types(told: dict[str, Any]) -> None:
    """Or none."""
    refs = [{"$ref": f"#/components/schemas/{name}"} for name in ("Granted", "Counted")]
    assert told["responses"]["200"]["content"]["application/json"]["schema"] == {"anyOf": refs}
    assert "content" not in told["responses"]["204"]
    assert told["responses"]["204"]["headers"]["ETag"]["description"] == "a tag"


def test_parameters_are_those_of_path_query_and_headers(told: dict[str, Any]) -> None:
    """Only those of the path are needed."""
    places = [(each["name"], each["in"], each.get("required", False)) for each in told["parameters"]]
    assert places == [("robot", "path", True), ("limit", "query", False), ("If-Match", "header", False)]


@pytest.mark.parametrize(
    ("credential", "errors"),
    [
        (Credential.USER, {"400", "401", "403", "404", "409", "413", "429", "503"}),
        (Credential.NONE, {"400", "404", "409", "413", "429"}),
    ],
)
def test_what_can_go_wrong_with_any_request_is_told(credential: Credential, errors: set[str]) -> None:
    """By what it needs, whether it has a body, and whether its address names something."""
    told = made(ApiOperation(**{**vars(GIVE), "credential": credential}))
    responses = told["paths"][GIVE.path]["post"]["responses"]
    assert {status for status in responses if status >= "400"} == errors
    assert all("$ref" in responses[status] for status in errors)


def test_types_of_one_name_are_told_apart() -> None:
    """By the room that they are in."""
    other = ApiOperation(**{**vars(GIVE), "path": "/api/v1/other", "body": Other})
    names = made(GIVE, other)["components"]["schemas"]
    assert "OtherWish" in names
    assert sum(name.endswith("Wish") for name in names) == 2


def test_each_operation_has_a_name_of_its_own() -> None:
    """Letters and underscores, by method and address."""
    assert GIVE.id == "post_robots_by_robot_wishes"
    live = ApiOperation(**{**vars(GIVE), "path": "/robots/{robot}/wishes"})
    assert live.id == "post_live_robots_by_robot_wishes"
