"""Endpoints as operations of the OpenAPI document; bodies and answers come from the signatures of handlers."""

from __future__ import annotations

import inspect
import types
from collections.abc import Iterator, Mapping
from typing import Any, Union, get_args, get_origin

import msgspec

from relay_server.common.freshness_tokens import HEADER as FRESHNESS
from relay_server.common.freshness_tokens import PARAMETER
from relay_server.http.endpoint import (
    Accepted,
    Answered,
    Created,
    Document,
    Endpoint,
    Freshness,
    IdempotencyKey,
    Representation,
    Streamed,
    Tagged,
)
from relay_server.http.idempotency import KEY_HEADER
from relay_server.http.media_types import JSON
from relay_server.http.openapi.document import field_words
from relay_server.http.openapi.operation import (
    PROBLEM,
    ApiOperation,
    Available,
    Parameter,
    Response,
    header,
    query,
)
from relay_server.http.static_files import StaticFile

_ETAG = {"ETag": "entity tag of this state in this form"}
_FILE = {
    "ETag": "entity tag of this file in this encoding",
    "Vary": "`Accept-Encoding`: it may be compressed",
}
_LOCATION = {"Location": "its address"}
_GIVES = {FRESHNESS: "freshness token; a request that gives it back was sent after this answer"}
_NOT_MODIFIED = "not modified"


def operation_of(endpoint: Endpoint) -> ApiOperation:
    """The description of an endpoint."""
    options = endpoint.options
    answers = _answers(endpoint)
    return ApiOperation(
        method=options.method,
        path=options.path.replace(":path}", "}"),
        tag=options.tag,
        summary=options.summary,
        more=options.more,
        parameters=tuple(_parameters(endpoint, answers)),
        body=_body_type(endpoint.body or options.raw_body),
        media=tuple(each.media for each in options.reads),
        optional=options.raw_optional if endpoint.body is None else not endpoint.needs_body,
        answers=answers,
        errors=(*options.errors, *_errors(endpoint)),
        problems={**_problems(endpoint), **options.problems},
        credential=options.credential,
        lasts=options.lasts,
    )


# --- requests ---------------------------------------------------------------------------------------------


def _parameters(endpoint: Endpoint, answers: Mapping[int, Response]) -> Iterator[Parameter]:
    options = endpoint.options
    for name, words in options.names.items():
        yield Parameter(name, words, str, "path", True)
    if endpoint.query is not None:
        yield from query_parameters(endpoint.query)
    yield from options.parameters
    if 304 in answers:
        yield header("If-None-Match", "entity tags of states that the client has")
    if options.if_match:
        yield header("If-Match", "entity tags; the request is refused if the current state has none of them")
    if options.key in (IdempotencyKey.REMEMBERED, IdempotencyKey.HANDLED):
        yield header(
            KEY_HEADER, "a key chosen by the client; a repeated request with the same key is carried out once"
        )
    if options.freshness in (Freshness.TAKEN, Freshness.NEEDED):
        yield header(
            FRESHNESS, "the freshness token of the latest answer; needed for requests that move the robot"
        )
    if options.freshness is Freshness.TAKEN:
        yield query(PARAMETER, f"the same as the header `{FRESHNESS}`, for clients that can't set a header")


def query_parameters(query: type[msgspec.Struct]) -> Iterator[Parameter]:
    """The fields of a struct as query parameters, described by its docstring."""
    words = field_words(query)
    hints = inspect.get_annotations(query, eval_str=True)
    for base in query.__mro__:
        hints = {**inspect.get_annotations(base, eval_str=True), **hints} if base is not object else hints
    for each in msgspec.structs.fields(query):
        kind = each.type if isinstance(each.type, type) else hints.get(each.name, each.type)
        yield Parameter(
            each.encode_name, words.get(each.name, each.name), _present(kind), "query", each.required
        )


def _present(kind: Any) -> Any:
    """A type without :class:`msgspec.UnsetType`: an omitted parameter has no value."""
    if get_origin(kind) in (Union, types.UnionType):
        rest = [each for each in get_args(kind) if each is not msgspec.UnsetType]
        return rest[0] if len(rest) == 1 else kind
    return kind


def _body_type(kind: Any) -> Any:
    """The type of an optional body, without ``None``."""
    if get_origin(kind) in (Union, types.UnionType):
        rest = [each for each in get_args(kind) if each is not type(None)]
        return rest[0] if len(rest) == 1 else kind
    return kind


def _errors(endpoint: Endpoint) -> Iterator[int]:
    options = endpoint.options
    if endpoint.query is not None:
        yield from (414, 431)
    if options.if_match:
        yield 412
    if options.key in (IdempotencyKey.REMEMBERED, IdempotencyKey.HANDLED):
        yield 422
    if options.freshness in (Freshness.TAKEN, Freshness.NEEDED):
        yield from (412, 428)


def _problems(endpoint: Endpoint) -> dict[int, Response]:
    found = {}
    if any(each.is_rdf for each in endpoint.options.forms):
        found[406] = Response("none of the accepted forms is available", Available, media=(PROBLEM,))
    if len(endpoint.options.reads) > 1:
        found[415] = Response("the form of the body is not supported", Available, media=(PROBLEM,))
    return found


# --- answers ----------------------------------------------------------------------------------------------


def _answers(endpoint: Endpoint) -> dict[int, Response]:
    options = endpoint.options
    media = tuple(each.media for each in options.forms)
    shared = dict(options.headers)
    if options.freshness is not Freshness.NONE:
        shared |= _GIVES
    bodies: dict[int, list[Any]] = {}
    headers: dict[int, dict[str, str]] = {}
    for status, body, own in _results(endpoint.hints.get("return"), options.method):
        bodies.setdefault(status, []).extend([] if body is None else [body])
        headers.setdefault(status, dict(shared)).update(own)
    found = {}
    for status, kinds in bodies.items():
        words = options.returns if isinstance(options.returns, str) else options.returns.get(status, "")
        body = None if not kinds else kinds[0] if len(kinds) == 1 else tuple(kinds)
        types = (JSON.media,) if status == 204 else media
        found[status] = Response(words or "done", body, types, headers[status], options.items)
    if not isinstance(options.returns, str):
        for status, words in options.returns.items():
            found.setdefault(status, Response(words, media=media, headers=headers.get(200, shared)))
    if "ETag" in headers.get(200, {}) and options.method == "GET":
        found[304] = Response(_NOT_MODIFIED, headers=headers[200])
    return found


def _results(kind: Any, method: str) -> Iterator[tuple[int, Any, dict[str, str]]]:
    """Status, body and headers of each result that a handler may return."""
    origin, inside = get_origin(kind), get_args(kind)
    tagged = _ETAG if method == "GET" else {}
    if origin in (Union, types.UnionType):
        for each in inside:
            yield from _results(each, method)
    elif kind in (None, type(None)):
        yield 204, None, {}
    elif kind is Streamed:
        yield 200, None, {}
    elif kind is Document:
        yield 200, None, tagged
    elif kind is StaticFile:
        yield 200, dict[str, Any], _FILE
    elif origin is Created:
        for each in _several(inside[0]):
            yield 201, each, _LOCATION
    elif origin is Accepted:
        yield 202, inside[0], {}
    elif origin in (Representation, Tagged):
        yield 200, inside[0], _ETAG
    else:
        yield 200, inside[0] if origin is Answered else kind, tagged


def _several(kind: Any) -> tuple[Any, ...]:
    return get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)
