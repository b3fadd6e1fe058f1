"""``@endpoint(...)``: one path and method of the HTTP API, with the framework's work around its handler.

A handler is a coroutine method. Its signature is the contract: path parameters by their names in the path, ``query``
and ``body`` by their types, the answer by the return annotation. :mod:`relay_server.http.router` serves it,
:mod:`relay_server.http.openapi.endpoints` describes it.
"""

from __future__ import annotations

import enum
import inspect
import os
import re
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from typing import Any, Generic, ParamSpec, TypeVar, get_type_hints

import msgspec
from twisted.web.server import Request

from relay_protocol.errors import Unavailable
from relay_server.access import Principal
from relay_server.cluster.forwarding import ForwardedClient, RequestForwarding
from relay_server.http.authentication import RequestAuthenticator
from relay_server.http.limits import extend_time_limit
from relay_server.http.media_types import JSON, MediaType
from relay_server.http.openapi.operation import Credential, Parameter, Response
from relay_server.http.request_fields import field as field_lines
from relay_server.http.request_fields import if_none_match

P = ParamSpec("P")
T_co = TypeVar("T_co", covariant=True)
Handler = Callable[..., Awaitable[Any]]
F = TypeVar("F", bound=Handler)


class IdempotencyKey(enum.Enum):
    """The effect of an ``Idempotency-Key``."""

    IGNORED = "ignored"
    """None: the request has the same effect when it is repeated."""
    REFUSED = "refused"
    """400: a repeated request would be carried out again."""
    REMEMBERED = "remembered"
    """A repeated request gets the first answer; see :meth:`Endpoint.replay`."""
    HANDLED = "handled"
    """The same, by the handler itself (:func:`relay_server.http.idempotency.once`)."""


class Freshness(enum.Enum):
    """The use of the freshness token (SPEC 1.13)."""

    NONE = "none"
    GIVEN = "given"
    """Each answer carries one."""
    TAKEN = "taken"
    """A request may also give one back: :attr:`ApiRequest.earliest_sent`."""
    NEEDED = "needed"
    """A request must also give one back."""


# --- requests ---------------------------------------------------------------------------------------------


class ApiRequest:
    """One request; authenticated and counted once :meth:`authenticate` has returned.

    :ivar form: media type of the answer, one of those that the endpoint offers
    :ivar answered_elsewhere: whether another relay of the cluster answers it
    :ivar earliest_sent: earliest time at which it can have been sent, monotonic nanoseconds; ``None`` without a
        freshness token
    """

    def __init__(self, http: Request, authenticator: RequestAuthenticator) -> None:
        self.http = http
        self.form: MediaType = JSON
        self.answered_elsewhere = False
        self.earliest_sent: int | None = None
        self._authenticator = authenticator
        self._content: bytes | None = None
        self._principal: Principal | None = None
        self.forwarding: RequestForwarding | None = None
        """``None``: this is the only relay."""

    async def answers_of_other_relays(self) -> list[bytes]:
        """The answers of all other relays to the same request: JSON, without those that did not answer in time.

        None if another relay sent this request, to collect the answers itself.
        """
        first: ForwardedClient | None = self.http.forwarded_client
        if self.forwarding is None or (first is not None and first.final):
            return []
        path = self.http.uri.decode("latin-1")
        return await self.forwarding.lists(path, self.principal, self.address)

    @property
    def principal(self) -> Principal:
        """The sender; only for endpoints that take credentials."""
        if self._principal is None:
            raise RuntimeError("this endpoint takes no credentials")
        return self._principal

    async def authenticate(self, *, from_memory: bool = False, never_limited: bool = False) -> Principal:
        """Authenticate the sender, and count the request. Streams do it again, since credentials may end.

        :raises SwitchboardError: as :meth:`relay_server.http.authentication.RequestAuthenticator.principal`
        """
        self._principal = await self._authenticator.principal(
            self.http, from_memory=from_memory, never_limited=never_limited
        )
        return self._principal

    @property
    def address(self) -> str:
        """The client's network address."""
        return str(getattr(self.http.getClientAddress(), "host", "local"))

    @property
    def base(self) -> str:
        """``scheme://host[:port]`` of the relay, as the sender addresses it.

        :raises Invalid: the request has no usable ``Host``
        """
        return self._authenticator.base(self.http)

    def check_origin(self) -> None:
        """Check the origin of a page that sends this request without a cookie.

        :raises Refused: the browser names another site as its origin
        """
        self._authenticator.check_origin(self.http)

    def header(self, name: str) -> str | None:
        """A list-valued header with all its lines joined (RFC 9110 section 5.3)."""
        return field_lines(self.http, name)

    def content(self) -> bytes:
        """The whole body.

        :raises Unavailable: it is large, and the disk that holds it fails
        """
        if self._content is None:
            try:
                self.http.content.seek(0)
                self._content = self.http.content.read()
            except OSError as error:
                raise Unavailable(
                    f"the relay can't read this request from its disk: {error.strerror}"
                ) from None
        return self._content

    @property
    def body_size(self) -> int:
        """Bytes of the body, which is not read for it."""
        return self.http.content.seek(0, os.SEEK_END) if self._content is None else len(self._content)

    @property
    def if_none_match(self) -> frozenset[str]:
        """Entity tags that the sender has already, without ``W/``."""
        return if_none_match(self.http)

    @property
    def connected(self) -> bool:
        """Whether the client is still connected."""
        return not self.http._disconnected

    def extend_time_limit(self, seconds: float) -> None:
        """Extend the time limit of the request by this number of seconds."""
        extend_time_limit(self.http, seconds)

    def set_cookie(self, token: str, seconds: float) -> None:
        """Set the session cookie in the answer; 0 seconds removes it."""
        self._authenticator.set_cookie(self.http, token, seconds)


# --- results ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Answered(Generic[T_co]):
    """200 with a value, and with headers set by the handler.

    :param value: a struct, a typed dict, or encoded JSON (:class:`msgspec.Raw`)
    :param etag: with its quotes; without one the framework makes it of the JSON
    """

    value: T_co | msgspec.Raw
    etag: str = ""
    headers: Mapping[str, str] = field(default_factory=dict)
    status = 200


@dataclass(frozen=True)
class Tagged(Answered[T_co]):
    """200 with a value and an entity tag, for any method."""


@dataclass(frozen=True)
class Created(Answered[T_co]):
    """201 with a value.

    :param location: its address, or empty
    """

    location: str = ""
    status = 201


@dataclass(frozen=True)
class Accepted(Answered[T_co]):
    """202 with a value: the request is being carried out."""

    status = 202


@dataclass(frozen=True)
class Representation(Generic[T_co]):
    """200 with a value that has other forms than JSON.

    :param value: as of :class:`Answered`
    :param render: makes the other forms; not called for a client that already has this state
    :param etag: of the JSON; without one the framework makes it of the JSON
    :param weak: whether equal tags allow insignificant differences (RFC 9110 section 8.8.1)
    """

    value: T_co | msgspec.Raw
    render: Callable[[MediaType], Awaitable[bytes]]
    etag: str = ""
    weak: bool = False


@dataclass(frozen=True)
class Document:
    """A whole body other than JSON, with 200 unless it names another status.

    :param media: its ``Content-Type``
    :param etag: with its quotes, or empty
    """

    body: bytes
    media: str
    etag: str = ""
    headers: Mapping[str, str] = field(default_factory=dict)
    status: int = 200


def _nothing() -> None:
    """Do nothing: the default of ``close``."""


@dataclass(frozen=True)
class Streamed:
    """A body that is written as fast as the client reads it.

    :param media: its ``Content-Type``
    :param run: writes the body to the request after its head; not called for ``HEAD``
    :param counted: whether it counts towards the streams that a user may have open
    :param close: always called at the end, even if ``run`` was never called
    """

    media: str
    run: Callable[[Request], Awaitable[None]]
    counted: bool = True
    status: int = 200
    headers: Mapping[str, str] = field(default_factory=dict)
    close: Callable[[], object] = _nothing


# --- endpoints --------------------------------------------------------------------------------------------

_IN_PATH = re.compile(r"\{(\w+)(?::path)?\}")


@dataclass(frozen=True)
class EndpointOptions:
    """The framework's work around a handler.

    :param path: with ``{name}`` for a segment, ``{name:path}`` for the rest
    :param tag: its group in the OpenAPI document
    :param summary: a few words; ``more`` whole sentences
    :param returns: the answer in words; by status if there are several
    :param names: descriptions of path parameters that have an unusual meaning
    :param forms: media types of the answer; the first is the default. If RDF is among them, a client that accepts
        none of them gets 406; otherwise it gets the default
    :param reads: media types of the body; all but JSON are read by the handler's group, see :class:`Router`
    :param numbers: fields of the body that may hold NaN and infinity, see :mod:`relay_protocol.nonfinite`
    :param raw_body: type of a body that the handler itself reads (:meth:`ApiRequest.content`)
    :param raw_optional: whether such a body may be omitted
    :param proved_from_memory: a token that was proved before needs no database, so a slow one does not delay it
    :param stored_if_unreachable: it is a stop: where the relay that has the robot can't be reached, it is stored here,
        and sent by the relay that reaches the robot
    :param never_limited: it stops something, so no rate limit applies. A function decides by the request and its
        path parameters
    :param shielded: it has no time limit, and continues when the client disconnects. A function decides by the body
    :param detached: it always runs to its end, but a client that waits beyond the time limit gets 503
    :param any_relay: what it names may be at any relay of the cluster: one that does not find it asks the others
    :param seconds: added to the usual time limit
    :param parameters: other parameters than those of the path, the query and the framework
    :param headers: additional headers of its answers, with their meaning
    :param errors: statuses of errors beside the common ones
    :param problems: error bodies with more than the usual fields, by status
    :param lasts: why the answer is a stream, if it is one
    :param items: types of the JSON in a stream: of its lines, or of the ``data`` of its events
    """

    method: str
    path: str
    _: KW_ONLY
    tag: str
    summary: str
    more: str = ""
    returns: str | Mapping[int, str] = ""
    names: Mapping[str, str] = field(default_factory=dict)
    credential: Credential = Credential.USER
    forms: tuple[MediaType, ...] = (JSON,)
    reads: tuple[MediaType, ...] = (JSON,)
    numbers: tuple[str, ...] = ()
    raw_body: Any = None
    raw_optional: bool = False
    key: IdempotencyKey = IdempotencyKey.IGNORED
    freshness: Freshness = Freshness.NONE
    if_match: bool = False
    proved_from_memory: bool = False
    stored_if_unreachable: bool = False
    never_limited: bool | Callable[[ApiRequest, Mapping[str, str]], bool] = False
    shielded: bool | Callable[[bytes], bool] = False
    detached: bool = False
    any_relay: bool = False
    seconds: float = 0.0
    parameters: tuple[Parameter, ...] = ()
    headers: Mapping[str, str] = field(default_factory=dict)
    errors: tuple[int, ...] = ()
    problems: Mapping[int, Response] = field(default_factory=dict)
    lasts: str = ""
    items: tuple[Any, ...] = ()


class Endpoint:
    """A handler with its options. As an attribute of an object it is the bound handler."""

    def __init__(self, options: EndpointOptions, handler: Handler) -> None:
        self.options = options
        self.handler = handler
        self.may_replay: Handler | None = None
        self.path_names = tuple(_IN_PATH.findall(options.path))

    def __get__(self, instance: object, owner: type | None = None) -> Any:
        return self if instance is None else self.handler.__get__(instance, owner)

    def replay(self, check: F) -> F:
        """Mark the coroutine that decides, by the handler's arguments, whether a remembered answer is given again.

        It raises an error if the sender may not get that answer.
        """
        self.may_replay = check
        return check

    @cached_property
    def hints(self) -> dict[str, Any]:
        """Types of the handler's parameters and of its result."""
        return get_type_hints(self.handler, include_extras=True)

    @property
    def query(self) -> type[msgspec.Struct] | None:
        """The struct that the query is read as."""
        return self.hints.get("query")

    @property
    def body(self) -> Any:
        """The type that the body is read as, ``None`` for no body."""
        return self.hints.get("body")

    @cached_property
    def body_default(self) -> Any:
        """The value of an omitted body, if it may be omitted."""
        parameter = inspect.signature(self.handler).parameters.get("body")
        return inspect.Parameter.empty if parameter is None else parameter.default

    @property
    def needs_body(self) -> bool:
        """Whether an empty body is an error."""
        return self.body_default is inspect.Parameter.empty

    @cached_property
    def decoder(self) -> msgspec.json.Decoder[Any]:
        """The decoder of the body."""
        return msgspec.json.Decoder(self.body)


def _decorator(options: Callable[P, EndpointOptions]) -> Callable[P, Callable[[Handler], Endpoint]]:
    def decorate(*args: P.args, **kwargs: P.kwargs) -> Callable[[Handler], Endpoint]:
        made = options(*args, **kwargs)
        return lambda handler: Endpoint(made, handler)

    return decorate


endpoint = _decorator(EndpointOptions)
"""Decorator that serves a method and path by a handler; takes the arguments of :class:`EndpointOptions`."""


def endpoints_of(group: type) -> list[Endpoint]:
    """The endpoints of a class, including inherited ones."""
    found = {name: each for kind in reversed(group.__mro__) for name, each in vars(kind).items()}
    return [each for each in found.values() if isinstance(each, Endpoint)]
