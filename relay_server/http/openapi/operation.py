"""What an operation of the HTTP API takes and answers; it stands at its route (:func:`described`)."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, TypeVar

import msgspec

F = TypeVar("F", bound=Callable[..., Any])

JSON = "application/json"
PROBLEM = "application/problem+json"

_MARK = "operations"
"""The attribute of a handler under which its operations are kept."""


class Credential(enum.Enum):
    """What proves who asks."""

    NONE = "none"
    """Nothing is needed."""
    USER = "user"
    """An access token or a session cookie (SPEC section 1.1)."""
    VIEWER = "viewer"
    """The same, or a ticket in the address (section 1.8)."""
    PROGRAM = "program"
    """Key and secret of a program, by Digest or Basic, where it has any (section 1.12)."""
    ASKER = "asker"
    """The same, or an access token."""


class Parameter(NamedTuple):
    """One parameter of the address or one header.

    :param type: what msgspec makes a schema of
    """

    name: str
    words: str
    type: Any = str
    place: Literal["query", "header", "path"] = "query"
    required: bool = False


class Response(NamedTuple):
    """An answer that is no error.

    :param body: its type, or several of which it has one; ``None`` for no body, or one that is not JSON
    :param media: the media types it may have; JSON alone has a schema
    :param headers: name and meaning of what it carries beside
    """

    words: str
    body: Any = None
    media: tuple[str, ...] = (JSON,)
    headers: Mapping[str, str] = {}


@dataclass(frozen=True, kw_only=True)
class ApiOperation:
    """One method of one address.

    :param path: with ``{name}`` for what differs; what stands there is described in :data:`IN_PATHS`
    :param tag: the group it is shown in
    :param more: further words, in whole sentences
    :param body: type of what is sent as JSON, or in the other ``media``
    :param optional: the body may be left out
    :param errors: statuses of errors beside those that all have
    :param problems: bodies of errors that are more than :class:`Problem`, by status
    :param lasts: why no answer comes whole and at once, where that is so
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
        """A name for programs that are made from the document: letters, digits, underscores."""
        words = self.path.replace("{", "by/").replace("}", "").replace(".", "/").replace("_", "/").split("/")
        kept = [each for each in words if each not in ("", "api", "v1")]
        # Some addresses are there twice: to ask about a robot, and to be connected to it.
        live = ["live"] if self.path.startswith("/robots/") else []
        return "_".join([self.method.lower(), *live, *kept])


class Problem(msgspec.Struct):
    """An error (RFC 9457).

    :param title: what the status means
    :param detail: a sentence for people: programs must not parse it
    :param code: a word for programs, where the status alone does not say enough
    """

    type: Literal["about:blank"]
    title: str
    status: int
    detail: str
    code: str | msgspec.UnsetType = msgspec.UNSET


def query(name: str, words: str, type: Any = str) -> Parameter:
    """A parameter of the query, which may be left out."""
    return Parameter(name, words, type)


def header(name: str, words: str, type: Any = str, *, required: bool = False) -> Parameter:
    """A header of the request, which may be left out unless it is said to be needed."""
    return Parameter(name, words, type, "header", required)


def raw(text: bytes) -> Any:
    """The default of a field of any JSON. By a factory, since a :class:`msgspec.Raw` can't stand in a schema."""
    return msgspec.field(default_factory=lambda: msgspec.Raw(text))


def described(*operations: ApiOperation) -> Callable[[F], F]:
    """Say at a route which operations it serves."""

    def mark(handler: F) -> F:
        handler.__dict__[_MARK] = operations
        return handler

    return mark


def operations_in(handlers: Iterable[Any]) -> list[ApiOperation]:
    """What some handlers serve, of those that say it."""
    return [each for handler in handlers for each in getattr(handler, _MARK, ())]
