"""Makes the OpenAPI document (OpenAPI 3.1.1) of operations; schemas are those of the types (JSON Schema 2020-12)."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Mapping, Sequence
from http import HTTPStatus
from typing import Any

import msgspec

from relay_server.http.openapi.operation import (
    JSON,
    PROBLEM,
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
    "name": "name of what the robot has, with or without its first slash; a parameter is `<node>:<parameter>`",
    "id": "what an earlier answer gave as `id`",
    "number": "what an earlier answer gave as `id`",
}
"""What stands in addresses."""

ABOUT = """\
Robots dial out, people and programs dial in. What happens live is told by websockets (rosbridge v2); all else is here.

Names, units and meanings are those of the protocol's specification (SPEC sections 1.1 to 1.16). Every error is \
problem details (RFC 9457); `detail` is for people. A request of more than 64 KiB is 413, one that is not here whole \
within 10 s 408. `HEAD` works wherever `GET` does. How much a user may ask, or a network from which nobody is known, \
is told by `RateLimit` and `RateLimit-Policy`; who asks more gets 429 with `Retry-After`. A stop is never held back."""

TAGS = {
    "session": "Who is logged in",
    "robots": "Robots, and who is at them",
    "control": "Who moves a robot; stops",
    "resources": "What a robot has in its graph",
    "goals": "Goals that are pursued",
    "video": "Cameras",
    "recordings": "What is recorded",
    "alerts": "What people should know",
    "events": "The short-term memory",
    "directory": "Services and applications, and where they are",
    "fleet": "Orders to many robots",
    "realm": "One's own realm, for its administrators",
    "oauth": "Tokens for programs and people",
    "relay": "The relay itself",
}

_SECURITY: dict[Credential, list[dict[str, list[str]]]] = {
    Credential.NONE: [],
    Credential.USER: [{"token": []}, {"session": []}],
    Credential.VIEWER: [{"token": []}, {"session": []}, {"ticket": []}],
    # Where a program is not needed there is no proof of one.
    Credential.PROGRAM: [{}, {"digest": []}, {"basic": []}],
    Credential.ASKER: [{"token": []}, {"digest": []}, {"basic": []}],
}

_ERRORS = {
    Credential.NONE: (400, 429),
    Credential.USER: (400, 401, 403, 429, 503),
    Credential.VIEWER: (400, 401, 403, 429, 503),
    Credential.PROGRAM: (429, 503),
    Credential.ASKER: (429, 503),
}
"""What can be wrong with any request; what OAuth has of its own stands at its operations."""

_LIMITS = {
    "RateLimit": "what is left: `r` requests now, all of them again in `t` seconds",
    "RateLimit-Policy": "`q` requests in `w` seconds",
}
_RETRY = {"Retry-After": "seconds after which to come again"}

_REF = "#/components/schemas/"
_IN_PATH = re.compile(r"\{(\w+)\}")
_PARAM = re.compile(r"^:(?:param|ivar) (\w+): (.*)$")


def document(operations: Iterable[ApiOperation], version: str, cookie: str) -> dict[str, Any]:
    """The OpenAPI document.

    :param version: the relay's
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
    session = "for browsers; what changes anything needs an `Origin` that the relay lists"
    return {
        "token": {"type": "http", "scheme": "bearer", "description": "an access token"},
        "session": {"type": "apiKey", "in": "cookie", "name": cookie, "description": session},
        "ticket": {"type": "apiKey", "in": "query", "name": "ticket", "description": "for one use"},
        "digest": {
            "type": "http",
            "scheme": "digest",
            "description": "key and secret of a program (RFC 7616)",
        },
        "basic": {"type": "http", "scheme": "basic", "description": "the same, over TLS alone"},
    }


def _operation(each: ApiOperation, schemas: _Schemas) -> dict[str, Any]:
    told: dict[str, Any] = {
        "operationId": each.id,
        "tags": [each.tag],
        "summary": each.summary,
        "security": _SECURITY[each.credential],
    }
    words = " ".join(filter(None, (each.more, each.lasts)))
    if words:
        told["description"] = words
    given = {parameter.name for parameter in each.parameters if parameter.place == "path"}
    named = [name for name in _IN_PATH.findall(each.path) if name not in given]
    parameters = [*(Parameter(name, IN_PATHS[name], str, "path", True) for name in named), *each.parameters]
    if parameters:
        told["parameters"] = [_parameter(one, schemas) for one in parameters]
    if each.body is not None:
        schema = schemas.of(each.body)
        # Forms beside JSON have no schema here.
        content = {
            media: {"schema": schema} if len(each.media) == 1 or media == JSON else {} for media in each.media
        }
        told["requestBody"] = {"required": not each.optional, "content": content}
    told["responses"] = _responses(each, schemas)
    if each.lasts:
        told["x-lasts"] = each.lasts
    return told


def _parameter(one: Parameter, schemas: _Schemas) -> dict[str, Any]:
    told = {"name": one.name, "in": one.place, "description": one.words, "schema": schemas.of(one.type)}
    return {**told, "required": True} if one.required else told


def _errors(each: ApiOperation) -> set[int]:
    """Statuses of its errors that are told by :class:`Problem`."""
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
    told: dict[str, Any] = {"description": answer.words}
    told["headers"] = {name: _header(words) for name, words in answer.headers.items()} | _shared(_LIMITS)
    if answer.body is not None or answer.media != (JSON,):
        told["content"] = {
            media: {"schema": schemas.of(answer.body)} if media == JSON else {} for media in answer.media
        }
    return told


def _problem(status: int, schema: dict[str, Any], media: str, words: str = "") -> dict[str, Any]:
    told: dict[str, Any] = {"description": words or HTTPStatus(status).phrase}
    if status == 429:
        told["headers"] = _shared({**_RETRY, **_LIMITS})
    return {**told, "content": {media: {"schema": schema}}}


def _shared(headers: Iterable[str]) -> dict[str, Any]:
    return {name: {"$ref": f"#/components/headers/{name}"} for name in headers}


def _header(words: str) -> dict[str, Any]:
    return {"description": words, "schema": {"type": "string"}}


class _Schemas:
    """The schemas of all types of some operations."""

    def __init__(self, operations: Sequence[ApiOperation]) -> None:
        # What is no class can't be a key of a dict by its value: it is found again by what it is.
        # They are kept, so no other object can get an address that is a key here.
        types = self._types = {id(each): each for each in _types(operations)}
        made, components = msgspec.json.schema_components(list(types.values()), ref_template=_REF + "{name}")
        names = {name: _plain(name) for name in components}
        self._of = {key: _renamed(schema, names) for key, schema in zip(types, made, strict=True)}
        self.components = {
            names[name]: _worded(_renamed(schema, names)) for name, schema in sorted(components.items())
        }

    def of(self, kind: Any) -> dict[str, Any]:
        """The schema of a type, or a reference to it; of several, that it is one of them."""
        if isinstance(kind, tuple):
            return {"anyOf": [self.of(each) for each in kind]}
        schema: dict[str, Any] = self._of[id(kind)]
        return schema


def _types(operations: Sequence[ApiOperation]) -> list[Any]:
    found: list[Any] = [Problem, str]
    for each in operations:
        found += [parameter.type for parameter in each.parameters]
        found += [answer.body for answer in (*each.answers.values(), *each.problems.values())]
        found.append(each.body)
    several = [one for each in found for one in (each if isinstance(each, tuple) else (each,))]
    return [each for each in several if each is not None]


def _plain(name: str) -> str:
    """The name of a schema: two types of one name have those of their rooms before it."""
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


def _worded(schema: dict[str, Any]) -> dict[str, Any]:
    """A type's schema with its docstring taken apart: the words for each field stand there."""
    text = inspect.cleandoc(schema.get("description", ""))
    about, _, rest = text.partition("\n:param") if "\n:param" in text else (text, "", "")
    words: dict[str, str] = {}
    name = ""
    for line in (f":param{rest}" if rest else "").splitlines():
        found = _PARAM.match(line)
        if found is not None:
            name = found[1]
            words[name] = found[2]
        elif name and line.strip():
            words[name] += f" {line.strip()}"
    fields = {
        field: {**value, "description": _marked(words[field])} if field in words else value
        for field, value in schema.get("properties", {}).items()
    }
    told = {key: value for key, value in schema.items() if key != "title"}
    if about:
        told["description"] = _marked(about.strip())
    return {**told, "properties": fields} if fields else told


def _marked(text: str) -> str:
    """The marks of docstrings as those of Markdown."""
    return re.sub(r":\w+:`([^`]+)`", r"`\1`", text).replace("``", "`")
