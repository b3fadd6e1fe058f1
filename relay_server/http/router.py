"""The routing table of the HTTP API, and the steps around each handler (``docs/explain/http.md``).

A request passes here in this order: route, time limit, authentication and rate limit, admission of the group
(``admit``), forwarding to the robot's relay, form of the answer, freshness token, query, body, idempotency key,
handler, entity tag, bytes. Errors on the way are problem details (RFC 9457).
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Container, Mapping
from functools import partial
from typing import Any, NamedTuple, TypeVar

import msgspec
from twisted.internet.defer import CancelledError, Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure
from twisted.web.resource import Resource
from twisted.web.server import NOT_DONE_YET, Request
from werkzeug.exceptions import MethodNotAllowed
from werkzeug.exceptions import NotFound as NoRoute
from werkzeug.routing import Map, MapAdapter, Rule

from relay_protocol import json_cost, jsontext, limits, nonfinite
from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_server.cluster.forwarding import (
    FORWARDED_SECONDS,
    STOP_WATCH_SECONDS,
    WATCH_SECONDS,
    ForwardedClient,
    RequestForwarding,
)
from relay_server.common.concurrency import detached
from relay_server.common.etags import tag_of, weak
from relay_server.common.freshness_tokens import HEADER as FRESHNESS
from relay_server.common.freshness_tokens import PARAMETER as FRESHNESS_PARAMETER
from relay_server.common.freshness_tokens import FreshnessTokens
from relay_server.http.authentication import RequestAuthenticator
from relay_server.http.endpoint import (
    Answered,
    ApiRequest,
    Created,
    Document,
    Endpoint,
    Freshness,
    Handler,
    IdempotencyKey,
    Representation,
    Streamed,
    Tagged,
    endpoints_of,
)
from relay_server.http.idempotency import KEY_HEADER, StoredReply, once
from relay_server.http.limits import ROBOT_SECONDS, in_time
from relay_server.http.media_types import JSON, MediaType, preferred, sent, wanted
from relay_server.http.openapi.operation import Credential
from relay_server.http.problems import WrongMethod, problem, problem_of
from relay_server.http.request_fields import field as field_lines
from relay_server.http.request_fields import query_of
from relay_server.http.static_files import StaticFile

T = TypeVar("T")

ROBOT = "/api/v1/robots/{robot}"
ABOUT_ROBOT = f"{ROBOT}/"
"""Requests below this path have :data:`ROBOT_SECONDS` more time: a channel may have to be opened first."""

STOP_SECONDS = 5.0
"""Seconds in which another relay must answer a request to stop a robot."""

NUMBER_DIGITS = 10
"""Longest number in a path."""

_WITHOUT_USER = (Credential.NONE, Credential.OAUTH_CLIENT, Credential.OAUTH_CLIENT_OR_USER)
"""Requests that count for their network. Handlers authenticate OAuth clients, by the header or the form."""

NO_ADDRESS = "There is nothing at this address."
FAILED = "The relay failed on this request; see its log."


class BoundEndpoint(NamedTuple):
    """An endpoint of a group of handlers.

    :param handler: of the group
    """

    endpoint: Endpoint
    group: Any
    handler: Handler


class _Rule(Rule):
    """A rule that is matched alone: functions that build its URLs would be compiled at each start, for 0.1 s."""

    def _compile_builder(self, append_unknown: bool = True) -> Callable[..., tuple[str, str]]:
        return _no_url


def _no_url(*_: Any) -> tuple[str, str]:
    raise NotImplementedError("addresses are not built from rules")


class Router(Resource):
    """Serves all endpoints that were added.

    A group of endpoints may have seven further members:

    ``admit(request)`` raises :class:`relay_protocol.errors.Refused` for a sender that may not use the group. It runs
    before anything else of the request is read.

    ``check_may_know(request, **path)``, a coroutine, is called for a method that the path does not support. It raises
    :class:`relay_protocol.errors.NotFound` for a sender that may not know of the resource; all others get 405. The
    handlers of other methods check rights themselves.

    ``admit_body(request, **path)``, a coroutine, raises :class:`relay_protocol.errors.Refused` for a sender whose large
    body is not worth reading.

    ``relay_of(request, **path)``, a coroutine, returns the other relay of the cluster that answers, or ``None``. For a
    path below that of a robot, the robot's home does.

    ``read_body(request, endpoint, form, **path)``, a coroutine, reads bodies that are not JSON.

    ``answer_error(http, error)`` sets the head of the answer to an error and returns its body, for a group whose
    errors have another form than :func:`relay_server.http.problems.problem_of`.

    ``remembered`` holds the answers to requests with an idempotency key.

    :param tokens: makes and reads freshness tokens
    :param forwarding: ``None``: this is the only relay
    """

    isLeaf = True
    log = Logger()

    def __init__(
        self,
        authenticator: RequestAuthenticator,
        tokens: FreshnessTokens,
        forwarding: RequestForwarding | None = None,
    ) -> None:
        super().__init__()
        self._forwarding = forwarding
        self.authenticator = authenticator
        self._tokens = tokens
        self._map = Map(strict_slashes=False, merge_slashes=False, redirect_defaults=False)
        self._routes: MapAdapter = self._map.bind("relay")

    def add(self, *groups: Any) -> None:
        """Serve the endpoints of these objects."""
        for group in groups:
            for each in endpoints_of(type(group)):
                path = each.options.path.replace(":path}", "\0").replace("{", "<").replace("}", ">")
                for name in each.path_names:
                    path = path.replace(f"<{name}\0", f"<path:{name}>")
                bound = BoundEndpoint(each, group, each.__get__(group))
                self._map.add(_Rule(path, methods=[each.options.method], endpoint=bound))
        self._map.update()

    # --- routing ------------------------------------------------------------------------------------------

    def render(self, http: Request) -> Any:
        """Answer a request whose path is left in ``postpath``, in UTF-8."""
        path = "/" + b"/".join(http.postpath).decode()
        method = http.method.decode("ascii", "replace")
        http.setHeader(b"cache-control", b"no-store")
        try:
            bound, names = self._routes.match(path, method)
        except NoRoute:
            return problem(http, 404, NO_ADDRESS)
        except MethodNotAllowed as error:
            return self._wrong_method(http, path, sorted(error.valid_methods or ()))
        content = None
        options = bound.endpoint.options
        request = ApiRequest(http, self.authenticator)
        request.forwarding = self._forwarding
        if options.detached or options.shielded is not False:
            # Read at once: Twisted drops the body when the client disconnects.
            try:
                content = request.content()
            except Unavailable as error:
                return problem_of(http, error)
        work = self._serve(request, bound, names)
        if options.detached:
            work = _await(detached(work))
        return self._start(request, bound.group, work, _evaluate(options.shielded, content))

    def _wrong_method(self, http: Request, path: str, methods: list[str]) -> Any:
        bound, names = self._routes.match(path, methods[0])
        error = WrongMethod(methods)
        if not hasattr(bound.group, "check_may_know"):
            return problem_of(http, error)
        request = ApiRequest(http, self.authenticator)

        async def refuse() -> bytes:
            try:
                await self._authenticate(request, bound.endpoint, names)
                await bound.group.check_may_know(request, **names)
            finally:
                self._give_token(request, bound.endpoint)
            raise error

        return self._start(request, bound.group, refuse(), shielded=False)

    # --- running ------------------------------------------------------------------------------------------

    def _start(self, request: ApiRequest, group: Any, work: Awaitable[bytes], shielded: bool) -> Any:
        """Run the work of a request to its end.

        :param shielded: it continues after the client disconnects or the time limit
        """
        http = request.http
        work = work if shielded else in_time(http, work)
        running = Deferred.fromCoroutine(self._run(http, group, work))
        if not shielded:
            http.notifyFinish().addErrback(lambda _: running.cancel())
        running.addErrback(self._failed, http)
        return NOT_DONE_YET

    async def _run(self, http: Request, group: Any, work: Awaitable[bytes]) -> None:
        try:
            body = await work
        except SwitchboardError as error:
            if http.startedWriting:
                # A truncated answer must not look complete.
                _cut(http)
                return
            body = getattr(group, "answer_error", problem_of)(http, error)
        _finish(http, body)

    def _failed(self, failure: Failure, http: Request) -> None:
        if http._disconnected and failure.check(CancelledError):
            return
        self.log.failure("{method} {path} failed", failure, method=http.method, path=http.path)
        if http.startedWriting:
            _cut(http)
        else:
            _finish(http, problem(http, 500, FAILED))

    async def _serve(self, request: ApiRequest, bound: BoundEndpoint, names: Mapping[str, str]) -> bytes:
        """Answer by an endpoint; returns the body, or the rest of it after streaming."""
        options = bound.endpoint.options
        if options.path.startswith(ABOUT_ROBOT):
            request.extend_time_limit(ROBOT_SECONDS)
        request.extend_time_limit(options.seconds)
        try:
            await self._authenticate(request, bound.endpoint, names)
            self._admit(request, bound.group)
            if await self._forwarded(request, bound, names):
                return b""
            try:
                result = await self._handled(request, bound, names)
            except NotFound:
                if options.any_relay and await self._found_elsewhere(request):
                    return b""
                raise
        finally:
            self._give_token(request, bound.endpoint)
        return await self._answer(request, result)

    async def _forwarded(self, request: ApiRequest, bound: BoundEndpoint, names: Mapping[str, str]) -> bool:
        """Have a request answered by the relay that its robot is at.

        :returns: false: the robot is here
        :raises Unavailable: that relay can't be reached
        """
        forwarding, options = self._forwarding, bound.endpoint.options
        if forwarding is None or request.http.forwarded_client is not None:
            return False
        urgent = options.proved_from_memory
        if options.path.startswith(ROBOT):
            relay = await forwarding.relay_of(request.principal, names["robot"], from_memory=urgent)
        elif hasattr(bound.group, "relay_of"):
            relay = await bound.group.relay_of(request, **names)
        else:
            return False
        if relay is None:
            return False
        request.answered_elsewhere = True
        request.extend_time_limit(FORWARDED_SECONDS)
        client = ForwardedClient.of(request.principal, request.address)
        seconds = STOP_SECONDS if urgent else None
        watch_seconds = STOP_WATCH_SECONDS if options.stored_if_unreachable else WATCH_SECONDS
        forwarder = forwarding.forwarder
        try:
            await forwarder.forward(
                request.http, request.content(), relay, client, seconds, watch_seconds=watch_seconds
            )
        except Unavailable:
            if not options.stored_if_unreachable or request.http.startedWriting:
                raise
            request.answered_elsewhere = False
            return False
        return True

    async def _found_elsewhere(self, request: ApiRequest) -> bool:
        """Have a request answered by another relay that has what is not found here.

        :raises Unavailable: a relay that could have it can't be reached
        """
        forwarding, first = self._forwarding, request.http.forwarded_client
        if forwarding is None or (first is not None and first.final):
            return False
        request.answered_elsewhere = True
        request.extend_time_limit(FORWARDED_SECONDS)
        return await forwarding.forward_to_others(
            request.http, request.content(), request.principal, request.address
        )

    def _give_token(self, request: ApiRequest, endpoint: Endpoint) -> None:
        """Add a freshness token to the answer, also to an error."""
        if endpoint.options.freshness is not Freshness.NONE and not request.answered_elsewhere:
            request.http.setHeader(FRESHNESS, self._tokens.now())

    async def _authenticate(self, request: ApiRequest, endpoint: Endpoint, names: Mapping[str, str]) -> None:
        options = endpoint.options
        if options.credential in _WITHOUT_USER:
            self.authenticator.limits.of_network(request.http)
            return
        never_limited = _evaluate(options.never_limited, request, names)
        await request.authenticate(from_memory=options.proved_from_memory, never_limited=never_limited)

    @staticmethod
    def _admit(request: ApiRequest, group: Any) -> None:
        """:raises Refused: the group does not serve this sender"""
        if hasattr(group, "admit"):
            group.admit(request)

    async def _handled(self, request: ApiRequest, bound: BoundEndpoint, names: Mapping[str, str]) -> Any:
        """The handler's result for a request."""
        endpoint, options = bound.endpoint, bound.endpoint.options
        request.form = _form(request, options.forms)
        if options.key is IdempotencyKey.REFUSED:
            refuse_key(request)
        if options.freshness is Freshness.NEEDED:
            request.earliest_sent = self._tokens.needed(request.http.getHeader(FRESHNESS))
        elif options.freshness is Freshness.TAKEN:
            given = request.http.getHeader(FRESHNESS) or query_of(request.http).get(FRESHNESS_PARAMETER)
            request.earliest_sent = self._tokens.read(given)
        arguments = {name: _path_value(text, endpoint.hints.get(name)) for name, text in names.items()}
        if endpoint.query is not None:
            arguments["query"] = decode_query(query_of(request.http), endpoint.query)
        if endpoint.body is not None:
            arguments["body"] = await _read_body(request, bound, names)
        if options.key is IdempotencyKey.REMEMBERED:
            return await self._once(request, bound, names.get("robot", ""), arguments)
        return await bound.handler(request, **arguments)

    async def _once(
        self, request: ApiRequest, bound: BoundEndpoint, robot: str, arguments: Mapping[str, Any]
    ) -> StoredReply:
        check = bound.endpoint.may_replay
        assert check is not None

        async def work() -> StoredReply:
            return _stored(await bound.handler(request, **arguments))

        may = partial(check, bound.group, request, **arguments)
        return await once(bound.group.remembered, request, robot, work, may)

    # --- answering ----------------------------------------------------------------------------------------

    async def _answer(self, request: ApiRequest, result: Any) -> bytes:
        """Set status and headers for a result; returns the body, or the rest of it after streaming."""
        http = request.http
        if isinstance(result, Streamed):
            return await self._stream(request, result)
        if isinstance(result, StoredReply):
            return _reply(http, result)
        if isinstance(result, StaticFile):
            return result.answer(http)
        if isinstance(result, Document):
            http.setResponseCode(result.status)
            return _tagged(
                request, result.body, result.media, result.etag or tag_of(result.body), result.headers
            )
        if isinstance(result, Representation):
            return await _represent(request, result)
        if result is None:
            http.setResponseCode(204)
            return b""
        answer = result if isinstance(result, Answered) else Answered(result)
        body = jsontext.encode(answer.value)
        etag = answer.etag
        if not etag and (http.method in (b"GET", b"HEAD") or isinstance(answer, Tagged)):
            etag = tag_of(body)
        if answer.status != 200:
            http.setResponseCode(answer.status)
        headers = dict(answer.headers)
        if isinstance(answer, Created) and answer.location:
            headers["location"] = answer.location
        return _tagged(request, body, JSON.media, etag, headers)

    async def _stream(self, request: ApiRequest, stream: Streamed) -> bytes:
        http = request.http
        try:
            if stream.counted:
                self.authenticator.limits.answer_streams(http, request.principal.user_id)
            http.setResponseCode(stream.status)
            for name, value in {**stream.headers, "content-type": stream.media}.items():
                http.setHeader(name, value)
            if http.method != b"HEAD":
                await stream.run(http)
        finally:
            stream.close()
        return b""


# --- requests ---------------------------------------------------------------------------------------------


async def _await(work: Deferred[T]) -> T:
    """Wrap a deferred as a coroutine, as the time limit needs one."""
    return await work


def _evaluate(option: Any, *arguments: Any) -> bool:
    """The value of an option that is a boolean, or a function of the request."""
    return option(*arguments) if callable(option) else bool(option)


def _path_value(text: str, kind: Any) -> Any:
    """A path parameter in the type that the handler takes.

    :raises NotFound: the handler takes a number, and it is none
    """
    if kind is not int:
        return text
    if not (text.isascii() and text.isdecimal() and len(text) <= NUMBER_DIGITS):
        raise NotFound(f"there is nothing at this address: '{text[:40]}' should be a number")
    return int(text)


def _form(request: ApiRequest, forms: tuple[MediaType, ...]) -> MediaType:
    """The form of the answer.

    :raises NotAcceptable: the client accepts none of them, and RDF is among them
    """
    if len(forms) == 1:
        return forms[0]
    request.http.responseHeaders.addRawHeader(b"vary", b"Accept")
    choose = wanted if any(each.is_rdf for each in forms) else preferred
    return choose(field_lines(request.http, "accept"), forms)


def refuse_key(request: ApiRequest) -> None:
    """:raises Invalid: the request has an idempotency key, which this endpoint does not support"""
    if request.http.requestHeaders.hasHeader(KEY_HEADER):
        raise Invalid(
            f"'{KEY_HEADER}' is not supported at this address, so a repeated request would be carried out again: "
            "remove the header, and after a lost answer check first whether the request took effect"
        )


def decode_query(query: Mapping[str, str], kind: type[Any]) -> Any:
    """The query parameters as a struct.

    :raises Invalid: an unknown parameter, or a value that is not allowed
    """
    try:
        return msgspec.convert(query, kind, strict=False)
    except msgspec.ValidationError as error:
        text = str(error)
    names = [each.encode_name for each in msgspec.structs.fields(kind)]
    strange = sorted(query.keys() - set(names))
    if strange:
        raise Invalid(
            f"there is no parameter '{strange[0][:40]}'; known parameters: {', '.join(names) or 'none'}"
        )
    raise Invalid(_query_fault(query, text))


def _query_fault(query: Mapping[str, str], text: str) -> str:
    """The error of msgspec about a parameter, in plain words.

    :param text: such as ``Expected `int` >= 1 - at `$.limit```
    """
    words, _, name = text.partition(" - at `$.")
    name = name.rstrip("`")
    kind = words.removeprefix("Expected ").partition(", got")[0]
    for ours, plain in (("`int`", "a whole number"), ("`float`", "a number"), ("`str`", "text")):
        kind = kind.replace(ours, plain)
    if words.startswith("Expected "):
        return f"'{name}' must be {kind}, not '{query.get(name, '')[:40]}'"
    return f"'{name}' can't be '{query.get(name, '')[:40]}': {words[:1].lower()}{words[1:]}"


async def _read_body(request: ApiRequest, bound: BoundEndpoint, names: Mapping[str, str]) -> Any:
    """The body of a request as the type that the handler takes.

    :raises UnsupportedMediaType: the relay does not read its form
    :raises Invalid: its media type is not JSON
    :raises MalformedMessage: it does not fit the type
    :raises TooCostly: it is large JSON with too much in it
    """
    endpoint, content_type = bound.endpoint, request.http.getHeader("content-type")
    large = request.body_size > limits.HTTP_BODY
    if large and hasattr(bound.group, "admit_body"):
        await bound.group.admit_body(request, **names)
    if not endpoint.needs_body and not request.content():
        return endpoint.body_default
    if len(endpoint.options.reads) > 1:
        form = sent(content_type, endpoint.options.reads)
        if form is not JSON:
            return await bound.group.read_body(request, endpoint, form, **names)
    if large:
        json_cost.check(request.content())
    return decode_body(content_type, request.content(), endpoint.decoder, endpoint.options.numbers)


def decode_body(
    content_type: str | None, content: bytes, decoder: msgspec.json.Decoder[T], numbers: Container[str] = ()
) -> T:
    """A request's JSON, checked.

    :param numbers: fields that may hold NaN and infinity, see :mod:`relay_protocol.nonfinite`
    :raises Invalid: its media type is not JSON, or another field has NaN or infinity
    :raises MalformedMessage: it is not JSON, or does not fit the decoder's type
    """
    if (content_type or "").partition(";")[0].strip().lower() != JSON.media:
        raise Invalid("the body is not declared as JSON: send it with 'Content-Type: application/json'")
    return nonfinite.decode(decoder, content, numbers)


# --- answers ----------------------------------------------------------------------------------------------


def _tagged(request: ApiRequest, body: bytes, media: str, etag: str, headers: Mapping[str, str]) -> bytes:
    """Set the head of a whole answer; returns the body, empty for a client that already has it."""
    http = request.http
    for name, value in headers.items():
        http.setHeader(name, value)
    if etag:
        http.setHeader(b"etag", etag.encode())
        if http.method in (b"GET", b"HEAD") and _is_known(request, etag):
            http.setResponseCode(304)
            return b""
    http.setHeader(b"content-type", media.encode())
    return body


def _is_known(request: ApiRequest, etag: str) -> bool:
    return etag.removeprefix("W/") in request.if_none_match


async def _represent(request: ApiRequest, result: Representation[Any]) -> bytes:
    body = jsontext.encode(result.value)
    etag = request.form.tag(result.etag or tag_of(body))
    if result.weak:
        etag = weak(etag)
    if request.form is JSON or _is_known(request, etag):
        return _tagged(request, body, JSON.media, etag, {})
    body = await result.render(request.form)
    return _tagged(request, body, f"{request.form.media}; charset=utf-8", etag, {})


def _stored(result: Any) -> StoredReply:
    """The stored form of a result that a repeated request gets."""
    if result is None:
        return StoredReply(204)
    answer = result if isinstance(result, Answered) else Answered(result)
    location = answer.location if isinstance(answer, Created) else ""
    return StoredReply(answer.status, jsontext.encode(answer.value), location)


def _reply(http: Request, reply: StoredReply) -> bytes:
    http.setResponseCode(reply.status)
    if reply.location:
        http.setHeader(b"location", reply.location.encode())
    if reply.body:
        http.setHeader(b"content-type", JSON.media.encode())
    return reply.body


def _finish(http: Request, body: bytes) -> None:
    """Send the rest of an answer."""
    if http._disconnected:
        return
    whole = not http.startedWriting and http.code not in (204, 304)
    if whole and not http.responseHeaders.hasHeader(b"content-length"):
        http.setHeader(b"content-length", b"%d" % len(body))
    http.write(body)
    http.finish()


def _cut(http: Request) -> None:
    if not http._disconnected:
        http.transport.abortConnection()
