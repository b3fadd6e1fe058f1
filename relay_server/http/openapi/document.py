"""Makes the OpenAPI document (OpenAPI 3.1.1) of operations; schemas are those of the types (JSON Schema 2020-12)."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Mapping, Sequence
from http import HTTPStatus
from typing import Any

import msgspec

from relay_protocol import limits
from relay_server.http.openapi.operation import (
    JSON,
    PROBLEM,
    STREAMS,
    ApiOperation,
    Credential,
    Parameter,
    Problem,
    Response,
)

VERSION = "3.1.1"

IN_PATHS = {
    "robot": "name of a robot",
    "package": "name of a package of ROS",
    "name": "name of the resource, with or without its first slash; a parameter is `<node>:<parameter>`",
    "id": "`id` of an earlier answer",
    "number": "`id` of an earlier answer",
    "module": "name of a module",
    "pipe": "name of a pipe",
    "function": "name of a function",
    "job": "id of a job",
    "role": "name of a Role",
    "element": "name of an element of the Role in `fierro:`, or its IRI",
    "action": "`start`, `stop` or `restart`",
}
"""Descriptions of path parameters."""

ABOUT = f"""\
Robots and clients connect to the relay. Live data comes by websocket (rosbridge v2); everything else is here.

Names, units and meanings are those of the protocol's specification (SPEC 1.1 to 1.24). Every error is \
problem details (RFC 9457); `detail` is for people. A request of more than {limits.HTTP_BODY // limits.KIB} KiB \
gets 413, one that has not arrived completely within 10 s gets 408. `HEAD` works wherever `GET` does; that of a \
stream ends at once. `RateLimit` and `RateLimit-Policy` show the limit of a user, or of a network without \
credentials. Requests over the limit get 429 with `Retry-After`. A stop is never rate limited."""

TAGS = {
    "session": "Login, logout and tickets",
    "foxglove": "URLs for Foxglove and Lichtblick",
    "robots": "Robots and their users",
    "control": "Control of robots; stop and resume",
    "resources": "Resources of a robot's ROS graph",
    "goals": "Action goals",
    "video": "Cameras",
    "recordings": "Recordings",
    "modules": "Modules and processes of a robot",
    "files": "Files that robots have uploaded",
    "pipes": "Pipes between topics of robots, and programs at their ends",
    "functions": "Functions that run on the relay's workers",
    "roles": "Roles: which elements work together, and queries over them",
    "things": "W3C Web of Things: Thing Descriptions of robots and Roles",
    "alerts": "Alerts and alert rules",
    "events": "The event log",
    "directory": "Registry of services and applications",
    "fleet": "Orders to many robots",
    "realm": "The caller's realm, for its administrators",
    "oauth": "Tokens for OAuth clients and users",
    "relay": "The relay itself",
}

_SECURITY: dict[Credential, list[dict[str, list[str]]]] = {
    Credential.NONE: [],
    Credential.USER: [{"token": []}, {"session": []}],
    Credential.VIEWER: [{"token": []}, {"session": []}, {"ticket": []}],
    Credential.OAUTH_CLIENT: [{}, {"digest": []}, {"basic": []}],
    Credential.OAUTH_CLIENT_OR_USER: [{"token": []}, {"digest": []}, {"basic": []}],
}

_ERRORS = {
    Credential.NONE: (400, 429),
    Credential.USER: (400, 401, 403, 429, 503),
    Credential.VIEWER: (400, 401, 403, 429, 503),
    Credential.OAUTH_CLIENT: (429, 503),
    Credential.OAUTH_CLIENT_OR_USER: (429, 503),
}
"""Statuses of errors that any request can get; operations of OAuth add their own."""

_LIMITS = {
    "RateLimit": "`r` requests are left; the full limit is available again in `t` seconds",
    "RateLimit-Policy": "`q` requests in `w` seconds",
}
_RETRY = {"Retry-After": "seconds to wait before the next request"}

_REF = "#/components/schemas/"
_IN_PATH = re.compile(r"\{(\w+)\}")
_PARAM = re.compile(r"^:(?:param|ivar) (\w+): (.*)$")


def document(operations: Iterable[ApiOperation], version: str, cookie: str) -> dict[str, Any]:
    """The OpenAPI document.

    :param version: version of the relay
    :param cookie: name of its session cookie
    """
    ordered = sorted(operations, key=lambda each: (list(TAGS).index(each.tag), each.path, each.method))
    schemas = _Schemas(ordered)
    problem = schemas.of(Problem)
    paths: dict[str, Any] = {}
    for each in ordered:
        paths.setdefault(each.path, {})[each.method.lower()] = _operation(each, schemas)
    return {
        "openapi": VERSION,
        "info": {
            "title": "Switchboard",
            "version": version,
            "summary": "Reach, watch and drive robots anywhere",
            "description": ABOUT,
            "license": {"name": "Apache-2.0", "identifier": "Apache-2.0"},
        },
        "servers": [{"url": "/"}],
        "tags": [{"name": name, "description": words} for name, words in TAGS.items()],
        "paths": paths,
        "components": {
            "schemas": schemas.components,
            "responses": {_name(status): _problem(status, problem, PROBLEM) for status in _statuses(ordered)},
            "headers": {name: _header(words) for name, words in {**_LIMITS, **_RETRY}.items()},
            "securitySchemes": _schemes(cookie),
        },
    }


def _schemes(cookie: str) -> dict[str, Any]:
    session = (
        "for browsers; requests that change anything need an `Origin` that the relay lists. Over TLS its name has the "
        "prefix `__Host-`"
    )
    return {
        "token": {"type": "http", "scheme": "bearer", "description": "an access token"},
        "session": {"type": "apiKey", "in": "cookie", "name": cookie, "description": session},
        "ticket": {"type": "apiKey", "in": "query", "name": "ticket", "description": "for one use"},
        "digest": {
            "type": "http",
            "scheme": "digest",
            "description": "id and secret of an OAuth client (RFC 7616)",
        },
        "basic": {"type": "http", "scheme": "basic", "description": "the same, over TLS only"},
    }


def _operation(each: ApiOperation, schemas: _Schemas) -> dict[str, Any]:
    result: dict[str, Any] = {
        "operationId": each.id,
        "tags": [each.tag],
        "summary": each.summary,
        "security": _SECURITY[each.credential],
    }
    words = " ".join(filter(None, (each.more, each.lasts)))
    if words:
        result["description"] = words
    given = {parameter.name for parameter in each.parameters if parameter.place == "path"}
    named = [name for name in _IN_PATH.findall(each.path) if name not in given]
    parameters = [*(Parameter(name, IN_PATHS[name], str, "path", True) for name in named), *each.parameters]
    if parameters:
        result["parameters"] = [_parameter(one, schemas) for one in parameters]
    if each.body is not None:
        schema = schemas.of(each.body)
        # Only JSON and forms have a schema.
        alone = len(each.media) == 1 and each.body is not bytes
        content = {media: {"schema": schema} if alone or media == JSON else {} for media in each.media}
        result["requestBody"] = {"required": not each.optional, "content": content}
    result["responses"] = _responses(each, schemas)
    if each.lasts:
        result["x-lasts"] = each.lasts
    return result


def _parameter(one: Parameter, schemas: _Schemas) -> dict[str, Any]:
    result = {"name": one.name, "in": one.place, "description": one.words, "schema": schemas.of(one.type)}
    return {**result, "required": True} if one.required else result


def _errors(each: ApiOperation) -> set[int]:
    """Statuses of its errors with a :class:`Problem` as body."""
    errors = {*_ERRORS[each.credential], *each.errors}
    if "{" in each.path:
        errors.add(404)
    if each.body is not None:
        errors |= {400, 413}
    return errors - each.problems.keys()


def _statuses(operations: Iterable[ApiOperation]) -> list[int]:
    return sorted({status for each in operations for status in _errors(each)})


def _name(status: int) -> str:
    return f"Problem{status}"


def _responses(each: ApiOperation, schemas: _Schemas) -> dict[str, Any]:
    answers = {status: _answer(answer, schemas) for status, answer in each.answers.items()}
    for status in _errors(each):
        answers[status] = {"$ref": f"#/components/responses/{_name(status)}"}
    for status, problem in each.problems.items():
        answers[status] = _problem(status, schemas.of(problem.body), problem.media[0], problem.words)
    return {str(status): answers[status] for status in sorted(answers)}


def _answer(answer: Response, schemas: _Schemas) -> dict[str, Any]:
    result: dict[str, Any] = {"description": answer.words}
    result["headers"] = {name: _header(words) for name, words in answer.headers.items()} | _shared(_LIMITS)
    if answer.body is not None or answer.media != (JSON,):
        result["content"] = {media: _content(answer, media, schemas) for media in answer.media}
    return result


def _content(answer: Response, media: str, schemas: _Schemas) -> dict[str, Any]:
    if media == JSON:
        return {"schema": schemas.of(answer.body)}
    if media in STREAMS and answer.items:
        return {"schema": schemas.of(answer.items)}
    return {}


def _problem(status: int, schema: dict[str, Any], media: str, words: str = "") -> dict[str, Any]:
    result: dict[str, Any] = {"description": words or HTTPStatus(status).phrase}
    if status == 429:
        result["headers"] = _shared({**_RETRY, **_LIMITS})
    return {**result, "content": {media: {"schema": schema}}}


def _shared(headers: Iterable[str]) -> dict[str, Any]:
    return {name: {"$ref": f"#/components/headers/{name}"} for name in headers}


def _header(words: str) -> dict[str, Any]:
    return {"description": words, "schema": {"type": "string"}}


class _Schemas:
    """The schemas of all types of some operations."""

    def __init__(self, operations: Sequence[ApiOperation]) -> None:
        # Types that are no classes are not hashable by value, so they are looked up by id. They are kept alive, so
        # no other object can get an id that is a key here.
        types = self._types = {id(each): each for each in _types(operations)}
        made, components = msgspec.json.schema_components(list(types.values()), ref_template=_REF + "{name}")
        names = {name: _plain(name) for name in components}
        words = _words_by_schema(list(types.values()))
        self._of = {key: _renamed(schema, names) for key, schema in zip(types, made, strict=True)}
        self.components = {
            names[name]: _worded(_renamed(schema, names), words.get(name, {}))
            for name, schema in sorted(components.items())
        }

    def of(self, kind: Any) -> dict[str, Any]:
        """The schema of a type, or a reference to it; for a tuple of types, any of them."""
        if isinstance(kind, tuple):
            return {"anyOf": [self.of(each) for each in kind]} if len(kind) > 1 else self.of(kind[0])
        schema: dict[str, Any] = self._of[id(kind)]
        return schema


def _types(operations: Sequence[ApiOperation]) -> list[Any]:
    found: list[Any] = [Problem, str]
    for each in operations:
        found += [parameter.type for parameter in each.parameters]
        for answer in (*each.answers.values(), *each.problems.values()):
            found += [answer.body, *answer.items]
        found.append(each.body)
    several = [one for each in found for one in (each if isinstance(each, tuple) else (each,))]
    return [each for each in several if each is not None]


def _plain(name: str) -> str:
    """The name of a schema; types of the same name are prefixed with their package."""
    first, *rest = name.split(".")
    return name if not rest else f"{rest[0].capitalize()}{rest[-1]}" if first == "relay_server" else rest[-1]


def _renamed(schema: Any, names: Mapping[str, str]) -> Any:
    """The same schema with other names of those it refers to."""
    if isinstance(schema, list):
        return [_renamed(each, names) for each in schema]
    if not isinstance(schema, dict):
        return schema
    return {
        key: _REF + names[value.removeprefix(_REF)] if key == "$ref" else _renamed(value, names)
        for key, value in schema.items()
    }


def _words_by_schema(types: Sequence[Any]) -> dict[str, dict[str, str]]:
    """Descriptions of the fields of all structs that some types consist of, by the names of their schemas."""
    found: dict[str, dict[str, str]] = {}
    waiting: list[Any] = list(msgspec.inspect.multi_type_info(types))
    while waiting:
        each = waiting.pop()
        if (kind := getattr(each, "cls", None)) is not None:
            full_name = f"{kind.__module__}.{kind.__qualname__}"
            if full_name in found:
                continue
            # msgspec takes the full name if several types have the same.
            found[kind.__name__] = found[full_name] = field_words(kind)
        waiting += [field.type for field in getattr(each, "fields", ())]
        waiting += [*getattr(each, "types", ()), *getattr(each, "item_types", ())]
        parts = ("type", "item_type", "key_type", "value_type")
        waiting += [getattr(each, part) for part in parts if hasattr(each, part)]
    return found


def field_words(kind: type) -> dict[str, str]:
    """Descriptions of fields from the docstrings of a class and its bases."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        name = ""
        for line in inspect.cleandoc(base.__doc__ or "").splitlines():
            start = _PARAM.match(line)
            if start is not None:
                name = start[1]
                found[name] = start[2]
            elif name and line.strip():
                found[name] += " " + line.strip()
    return {name: _marked(text) for name, text in found.items()}


def _worded(schema: dict[str, Any], words: Mapping[str, str]) -> dict[str, Any]:
    """A type's schema, its fields with their descriptions."""
    about = inspect.cleandoc(schema.get("description", "")).partition("\n:param")[0]
    fields = {
        field: {**value, "description": words[field]} if field in words else value
        for field, value in schema.get("properties", {}).items()
    }
    result = {key: value for key, value in schema.items() if key != "title"}
    if about:
        result["description"] = _marked(about.strip())
    return {**result, "properties": fields} if fields else result


def _marked(text: str) -> str:
    """The marks of docstrings as those of Markdown."""
    return re.sub(r":\w+:`([^`]+)`", r"`\1`", text).replace("``", "`")
