"""Descriptions of operations, and answers of the framework itself; features have schemas of their own."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypedDict, TypeVar

import msgspec

F = TypeVar("F", bound=Callable[..., Any])

JSON = "application/json"
PROBLEM = "application/problem+json"
STREAMS = frozenset({"application/jsonl", "application/x-ndjson", "text/event-stream"})
"""Media types of streams: their schema is that of one line or event."""

_MARK = "operations"
"""The attribute of a handler under which its operations are kept."""


class Credential(enum.Enum):
    """How the sender of a request authenticates."""

    NONE = "none"
    """Not at all."""
    USER = "user"
    """An access token or a session cookie (SPEC 1.1)."""
    VIEWER = "viewer"
    """The same, or a ticket in the address (section 1.8)."""
    OAUTH_CLIENT = "oauth_client"
    """Optional: id and secret of an OAuth client, by Digest or Basic (section 1.12)."""
    OAUTH_CLIENT_OR_USER = "oauth_client_or_user"
    """The same, or an access token; one of them is needed."""


class Parameter(NamedTuple):
    """One query parameter, path parameter or header.

    :param type: the type of which msgspec makes the schema
    """

    name: str
    words: str
    type: Any = str
    place: Literal["query", "header", "path"] = "query"
    required: bool = False


class Response(NamedTuple):
    """An answer that is not an error.

    :param body: its type, or a tuple of types of which it has one; ``None`` for no body, or one that is not JSON
    :param media: its media types; JSON has the schema of ``body``, a stream that of ``items``
    :param headers: its headers with their meanings
    :param items: types of the JSON in a stream: of its lines, or of the ``data`` of its events
    """

    words: str
    body: Any = None
    media: tuple[str, ...] = (JSON,)
    headers: Mapping[str, str] = {}
    items: tuple[Any, ...] = ()


@dataclass(frozen=True, kw_only=True)
class ApiOperation:
    """One method of one path.

    :param path: with ``{name}`` for a parameter, described in :data:`relay_server.http.openapi.document.IN_PATHS`
    :param tag: its group in the document
    :param more: further whole sentences
    :param body: type of the body
    :param optional: the body may be omitted
    :param errors: statuses of errors beside the common ones
    :param problems: bodies of errors that have more fields than :class:`Problem`, by status
    :param lasts: why the answer is a stream, if it is one
    """

    method: str
    path: str
    tag: str
    summary: str
    more: str = ""
    parameters: tuple[Parameter, ...] = ()
    body: Any = None
    media: tuple[str, ...] = (JSON,)
    optional: bool = False
    answers: Mapping[int, Response] = field(default_factory=dict)
    errors: tuple[int, ...] = ()
    problems: Mapping[int, Response] = field(default_factory=dict)
    credential: Credential = Credential.USER
    lasts: str = ""

    @property
    def id(self) -> str:
        """A name for generated clients: letters, digits, underscores."""
        words = self.path.replace("{", "by/").replace("}", "").replace(".", "/").replace("_", "/").split("/")
        kept = [each for each in words if each not in ("", "api", "v1")]
        # Some resources have two addresses: below /api/v1/robots/ and below /robots/.
        live = ["live"] if self.path.startswith("/robots/") else []
        return "_".join([self.method.lower(), *live, *kept])


class Problem(msgspec.Struct):
    """An error (RFC 9457).

    :param title: meaning of the status
    :param detail: a sentence for people; it must not be parsed
    :param code: a fixed word that distinguishes errors of the same status
    """

    type: Literal["about:blank"]
    title: str
    status: int
    detail: str
    code: str | msgspec.UnsetType = msgspec.UNSET


def query(name: str, words: str, type: Any = str) -> Parameter:
    """An optional query parameter."""
    return Parameter(name, words, type)


def header(name: str, words: str, type: Any = str, *, required: bool = False) -> Parameter:
    """A header of the request, optional by default."""
    return Parameter(name, words, type, "header", required)


def raw(text: bytes) -> Any:
    """The default of a field of any JSON, from a factory, since a schema cannot contain :class:`msgspec.Raw`."""
    return msgspec.field(default_factory=lambda: msgspec.Raw(text))


def described(*operations: ApiOperation) -> Callable[[F], F]:
    """Decorator that describes the operations of a handler."""

    def mark(handler: F) -> F:
        handler.__dict__[_MARK] = operations
        return handler

    return mark


def operations_in(handlers: Iterable[Any]) -> list[ApiOperation]:
    """The described operations of some handlers."""
    return [each for handler in handlers for each in getattr(handler, _MARK, ())]


class HealthInfo(TypedDict):
    """The relay and its database answer."""

    status: Literal["ok"]


class ServerInfo(TypedDict):
    """The server behind a robot's websocket."""

    product: str
    version: str
    protocol: str
    transport: str


class Available(TypedDict):
    """An error with the available media types."""

    type: str
    title: str
    status: int
    detail: str
    code: str
    available: list[str]
