"""The OpenAPI document of functions: each is a path of its own, with the schemas of its signature."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from relay_protocol.functions import FunctionDescription
from relay_server.http.openapi.operation import PROBLEM

_VERSION = "3.1.1"
_DEFINITION = "#/$defs/"
_COMPONENT = "#/components/schemas/"
_NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9-]")
_HEADERS = [
    {"name": name, "in": "header", "schema": {"type": "string"}, "description": words}
    for name, words in (
        ("Prefer", "`wait=` seconds to wait for the result, or `respond-async` (RFC 7240)"),
        ("Idempotency-Key", "a repeated call with the same key is carried out once"),
    )
]

_PROBLEM = {
    "description": "problem details (RFC 9457); `code` says why a call has no result",
    "content": {
        PROBLEM: {
            "schema": {
                "type": "object",
                "properties": {each: {"type": "string"} for each in ("type", "title", "detail", "code")}
                | {"status": {"type": "integer"}},
            }
        }
    },
}
_JOB = {
    "description": "the call goes on as a job",
    "headers": {"Location": {"description": "address of the job", "schema": {"type": "string"}}},
    "content": {"application/json": {"schema": {"type": "object"}}},
}


def functions_document(path: str, functions: Iterable[FunctionDescription]) -> dict[str, Any]:
    """An OpenAPI 3.1 document with the newest version of each function.

    :param path: below which each is called by its name
    """
    newest: dict[str, FunctionDescription] = {}
    for each in functions:
        if each.name not in newest or newest[each.name].version < each.version:
            newest[each.name] = each
    components: dict[str, Any] = {}
    return {
        "openapi": _VERSION,
        "info": {
            "title": "Functions of this relay",
            "version": "1",
            "description": "Functions that the caller may run, as the workers have them now. "
            "`/api/openapi.json` has everything else.",
        },
        "servers": [{"url": "/"}],
        "security": [{"token": []}],
        "paths": {f"{path}/{name}": {"post": _call(each, components)} for name, each in newest.items()},
        "components": {
            "schemas": components,
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
    }


def _call(function: FunctionDescription, components: dict[str, Any]) -> dict[str, Any]:
    body = {
        "type": "object",
        "properties": {
            "arguments": _hoisted(function.name, function.arguments, components),
            "version": {"type": "integer", "default": function.version},
            "robot": {"type": "string", "description": "for which it is called"},
            "deadline": {"type": "number", "description": "seconds from now"},
        },
        "additionalProperties": False,
    }
    result = {
        "type": "object",
        "properties": {
            "job": {"type": "string"},
            "seconds": {"type": "number"},
            "result": _hoisted(function.name, function.result, components),
        },
        "required": ["job", "seconds", "result"],
    }
    return {
        "operationId": function.name,
        "summary": function.text.partition("\n")[0] or function.name,
        "description": function.text,
        "parameters": _HEADERS,
        "requestBody": {"required": True, "content": {"application/json": {"schema": body}}},
        "responses": {
            "200": {"description": "the result", "content": {"application/json": {"schema": result}}},
            "202": _JOB,
            "default": _PROBLEM,
        },
    }


def _hoisted(function: str, schema: Mapping[str, Any], components: dict[str, Any]) -> Any:
    """A schema whose definitions have become components, under names that begin with the function's."""

    def named(name: str) -> str:
        return f"{_NOT_IN_NAMES.sub('_', function)}.{_NOT_IN_NAMES.sub('_', name)}"

    def moved(part: Any) -> Any:
        if isinstance(part, list):
            return [moved(each) for each in part]
        if not isinstance(part, dict):
            return part
        found = {name: moved(each) for name, each in part.items() if name != "$defs"}
        target = found.get("$ref")
        if isinstance(target, str) and target.startswith(_DEFINITION):
            found["$ref"] = _COMPONENT + named(target.removeprefix(_DEFINITION))
        return found

    for name, each in schema.get("$defs", {}).items():
        components[named(name)] = moved(each)
    return moved(dict(schema))
