"""``/oauth``: tokens for programs and people (RFC 6749), what is left of them (RFC 7662), their end (RFC 7009).

Cookies count for nothing here, so no page can ask in a person's name.
"""

from __future__ import annotations

from collections.abc import Awaitable
from typing import Any, Protocol
from urllib.parse import parse_qsl

from klein import Klein
from twisted.internet.defer import Deferred
from twisted.logger import Logger
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException
from werkzeug.routing import RequestRedirect

from relay_db.queries import OAuthClientRecord
from relay_protocol import jsontext
from relay_protocol.errors import Invalid, SwitchboardError, Unavailable
from relay_server.access import BadCredentials, Principal
from relay_server.auth.authenticator import TooManyTries
from relay_server.common.clock import detached
from relay_server.http.openapi.operation import ApiOperation, Credential, Response, described
from relay_server.http.openapi.schemas import (
    AboutToken,
    Introspection,
    Nothing,
    OAuthProblem,
    TokenForm,
    TokenInfo,
)
from relay_server.http.problems import problem, problem_of
from relay_server.http.rate_limits import RequestLimits, TooManyRequests
from relay_server.http.time_limit import in_time
from relay_server.oauth.digest import Digest, StaleNonce
from relay_server.oauth.service import IssuedToken, OAuthError, TokenRequest

FIELDS = 32
"""Most fields of a body."""

FORM = "application/x-www-form-urlencoded"
_PROBLEMS = {
    400: Response("the request makes no sense, or is refused", OAuthProblem),
    401: Response("nobody is proved", OAuthProblem),
}


class OAuthServicePort(Protocol):
    """What is asked; see :class:`relay_server.oauth.service.OAuthService`."""

    digest: Digest

    async def program(
        self, header: str, method: str, uri: str, address: str, inside: tuple[str, str] | None = None
    ) -> OAuthClientRecord | None:
        """Which program asks."""

    async def principal(self, token: str) -> Principal:
        """Who asks with a token of his own."""

    async def token(self, ask: TokenRequest, program: OAuthClientRecord | None, address: str) -> IssuedToken:
        """A token."""

    async def introspect(self, token: str, realm: str, program: str | None = None) -> dict[str, Any]:
        """What is left of one."""

    async def revoke(self, token: str, realm: str, program: str | None = None) -> None:
        """Its end."""


class OAuthResource:
    """The three addresses as a klein application."""

    log = Logger()
    app = Klein()

    def __init__(self, desk: OAuthServicePort, limits: RequestLimits) -> None:
        self._desk = desk
        self._limits = limits

    @app.route("/oauth/token", methods=["POST"])
    @described(
        ApiOperation(
            method="POST",
            path="/oauth/token",
            tag="oauth",
            summary="A token (RFC 6749)",
            more="By user and password, by key and secret of a program, or by a refresh token.",
            body=TokenForm,
            media=(FORM,),
            optional=True,
            answers={200: Response("the token", TokenInfo)},
            problems=_PROBLEMS,
            credential=Credential.PROGRAM,
        )
    )
    def token(self, request: Request) -> Any:
        return self._answer(request, self._token(request))

    async def _token(self, request: Request) -> Any:
        self._limits.of_network(request)
        fields = _fields(request)
        program = await self._program(request, fields)
        if "grant_type" not in fields:
            if program is None:
                # curl asks with an empty body whether it needs to answer a challenge.
                raise BadCredentials("send grant_type, and prove the program by its key and secret")
            raise OAuthError("invalid_request", "send grant_type")
        ask = TokenRequest(
            fields["grant_type"],
            username=fields.get("username", ""),
            password=fields.get("password", ""),
            refresh_token=fields.get("refresh_token", ""),
            scope=fields.get("scope"),
            realm=fields.get("realm"),
        )
        return (await self._desk.token(ask, program, _address(request))).told()

    @app.route("/oauth/introspect", methods=["POST"])
    @described(
        ApiOperation(
            method="POST",
            path="/oauth/introspect",
            tag="oauth",
            summary="What is left of a token (RFC 7662)",
            body=AboutToken,
            media=(FORM,),
            answers={200: Response("what is left", Introspection)},
            problems=_PROBLEMS,
            credential=Credential.ASKER,
        )
    )
    def introspect(self, request: Request) -> Any:
        return self._answer(request, self._introspect(request))

    async def _introspect(self, request: Request) -> Any:
        self._limits.of_network(request)
        fields = _fields(request)
        return await self._desk.introspect(_token_in(fields), *await self._asker(request, fields))

    @app.route("/oauth/revoke", methods=["POST"])
    @described(
        ApiOperation(
            method="POST",
            path="/oauth/revoke",
            tag="oauth",
            summary="End a token (RFC 7009)",
            more="With a refresh token all that came of the same login.",
            body=AboutToken,
            media=(FORM,),
            answers={200: Response("it is none any more, or never was one", Nothing)},
            problems=_PROBLEMS,
            credential=Credential.ASKER,
        )
    )
    def revoke(self, request: Request) -> Any:
        return self._answer(request, self._revoke(request))

    async def _revoke(self, request: Request) -> Any:
        self._limits.of_network(request)
        fields = _fields(request)
        # It is done also when the program leaves at once.
        await detached(self._revoke_token(request, fields))
        return {}

    async def _revoke_token(self, request: Request, fields: dict[str, str]) -> None:
        await self._desk.revoke(_token_in(fields), *await self._asker(request, fields))

    # --- who asks -----------------------------------------------------------------------------------------

    async def _asker(self, request: Request, fields: dict[str, str]) -> tuple[str, str | None]:
        """Whose tokens may be asked about: those of the realm of who asks, a program or anybody with a token; and the
        key of the program.
        """
        scheme, _, token = (request.getHeader("authorization") or "").partition(" ")
        if scheme.lower() == "bearer":
            return (await self._desk.principal(token.strip())).realm, None
        program = await self._program(request, fields)
        if program is None:
            raise BadCredentials("prove yourself by a token of your own, or a program by its key and secret")
        return program.realm, program.key

    async def _program(self, request: Request, fields: dict[str, str]) -> OAuthClientRecord | None:
        header = request.getHeader("authorization") or ""
        inside = (fields["client_id"], fields["client_secret"]) if fields.keys() >= _INSIDE else None
        if header and inside is not None:
            raise OAuthError(
                "invalid_request", "prove the program in one way, not in two (RFC 6749 section 2.3)"
            )
        uri = request.uri.decode("ascii", "replace")
        return await self._desk.program(
            header, request.method.decode("ascii"), uri, _address(request), inside
        )

    # --- answering ----------------------------------------------------------------------------------------

    def _answer(self, request: Request, work: Any) -> Deferred[bytes]:
        request.setHeader(b"cache-control", b"no-store")
        running = Deferred.fromCoroutine(self._finish(request, work))
        running.addErrback(self._unexpected, request)
        return running

    async def _finish(self, request: Request, work: Awaitable[Any]) -> bytes:
        try:
            result = await in_time(request, work)
        except SwitchboardError as error:
            return self._refuse(request, error)
        request.setHeader(b"content-type", b"application/json")
        return jsontext.encode(result)

    def _refuse(self, request: Request, error: SwitchboardError) -> bytes:
        """An error in the words of RFC 6749 section 5.2, which are problem details (RFC 9457), too."""
        if isinstance(error, (TooManyTries, TooManyRequests, Unavailable)):
            return problem_of(request, error)
        name, status = "invalid_request", 400
        if isinstance(error, BadCredentials):
            name, status = "invalid_client", 401
            challenge = self._desk.digest.challenge(stale=isinstance(error, StaleNonce))
            said = [challenge.encode(), b'Basic realm="switchboard", charset="UTF-8"']
            request.responseHeaders.setRawHeaders(b"www-authenticate", said)
        elif isinstance(error, OAuthError):
            name = error.error
        body = problem(request, status, str(error), error=name, error_description=str(error))
        # What clients of OAuth look for.
        request.setHeader(b"content-type", b"application/json")
        return body

    def _unexpected(self, failure: Any, request: Request) -> bytes:
        if request._disconnected:
            return b""
        self.log.failure("{method} {path} failed", failure, method=request.method, path=request.path)
        return problem(request, 500, "The relay failed on this request; its log tells more.")

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        """There is nothing here, or not by this method."""
        status = 404 if isinstance(failure.value, RequestRedirect) else failure.value.code or 500
        if status == 405:
            request.setHeader("allow", "POST")
        details = {404: "There is nothing at this address.", 405: "This address takes POST."}
        return problem(request, status, details.get(status, "The request can't be served."))


_INSIDE = {"client_id", "client_secret"}


def resource(desk: OAuthServicePort, limits: RequestLimits) -> IResource:
    """What serves ``/oauth``."""
    made: IResource = OAuthResource(desk, limits).app.resource()
    return made


def _fields(request: Request) -> dict[str, str]:
    """The fields of a body, each given once (RFC 6749 section 3.2).

    :raises Invalid: it is no form, or one field is given twice
    """
    body = request.content.read()
    kind = (request.getHeader("content-type") or "").partition(";")[0].strip().lower()
    if body and kind != FORM:
        raise Invalid(f"send the body as {FORM}")
    try:
        pairs = parse_qsl(body.decode(), keep_blank_values=False, max_num_fields=FIELDS, errors="strict")
    except ValueError:
        raise Invalid(f"the body is no form in UTF-8 with {FIELDS} fields or fewer") from None
    fields = dict(pairs)
    if len(fields) < len(pairs):
        raise Invalid("a field is given twice")
    return fields


def _token_in(fields: dict[str, str]) -> str:
    if "token" not in fields:
        raise OAuthError("invalid_request", "send token")
    return fields["token"]


def _address(request: Request) -> str:
    return getattr(request.getClientAddress(), "host", "local")
