"""``/oauth``: issues tokens (RFC 6749), inspects them (RFC 7662) and revokes them (RFC 7009).

Cookies are ignored here, so no page can act in a user's name.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol
from urllib.parse import parse_qsl

from twisted.web.server import Request

from relay_db.queries import OAuthClientRecord
from relay_protocol.errors import Invalid, SwitchboardError, Unavailable
from relay_server.access import BadCredentials, Principal
from relay_server.auth.authenticator import TooManyTries
from relay_server.http.endpoint import ApiRequest, Endpoint, endpoint
from relay_server.http.limits import TooManyRequests
from relay_server.http.media_types import MediaType
from relay_server.http.openapi.operation import Credential, Response
from relay_server.http.problems import WrongMethod, problem, problem_of
from relay_server.oauth.digest import Digest, StaleNonce, WrongAddress
from relay_server.oauth.schemas import AboutToken, Introspection, Nothing, OAuthProblem, TokenForm, TokenInfo
from relay_server.oauth.service import IssuedToken, OAuthError, TokenRequest

FIELDS = 32
"""Most fields of a body."""

FORM = MediaType("application/x-www-form-urlencoded")
_PROBLEMS = {
    400: Response("the request is not valid, or is refused", OAuthProblem),
    401: Response("no valid credentials", OAuthProblem),
}


class OAuthServicePort(Protocol):
    """Issues tokens; see :class:`relay_server.oauth.service.OAuthService`."""

    digest: Digest

    async def authenticate_client(
        self, header: str, method: str, uri: str, address: str, inside: tuple[str, str] | None = None
    ) -> OAuthClientRecord | None:
        """The OAuth client that sent a request, ``None`` without credentials of one."""

    async def principal(self, token: str) -> Principal:
        """The principal of an access token."""

    async def token(self, ask: TokenRequest, client: OAuthClientRecord | None, address: str) -> IssuedToken:
        """Issue a token."""

    async def introspect(self, token: str, realm: str, client_id: str | None = None) -> Introspection:
        """The state of a token."""

    async def revoke(self, token: str, realm: str, client_id: str | None = None) -> None:
        """Revoke a token."""


def _endpoint(path: str, summary: str, returns: str, **options: Any) -> Callable[[Any], Endpoint]:
    return endpoint(
        "POST",
        f"/oauth/{path}",
        tag="oauth",
        summary=summary,
        returns=returns,
        reads=(FORM,),
        problems=_PROBLEMS,
        **options,
    )


class OAuthEndpoints:
    """The three addresses below ``/oauth``. Handlers authenticate OAuth clients themselves."""

    def __init__(self, service: OAuthServicePort) -> None:
        self._service = service

    @_endpoint(
        "token",
        "Issue a token (RFC 6749)",
        "the token",
        more="For user and password, for key and secret of an OAuth client, or for a refresh token.",
        raw_body=TokenForm,
        raw_optional=True,
        credential=Credential.OAUTH_CLIENT,
    )
    async def token(self, request: ApiRequest) -> TokenInfo:
        fields = _fields(request)
        client = await self._oauth_client(request, fields)
        if "grant_type" not in fields:
            if client is None:
                # curl first sends an empty body, to get the challenge of Digest.
                raise BadCredentials(
                    "send grant_type, and authenticate the OAuth client by its key and secret"
                )
            raise OAuthError("invalid_request", "send grant_type")
        wanted = TokenRequest(
            fields["grant_type"],
            username=fields.get("username", ""),
            password=fields.get("password", ""),
            refresh_token=fields.get("refresh_token", ""),
            scope=fields.get("scope"),
            realm=fields.get("realm"),
        )
        return (await self._service.token(wanted, client, request.address)).as_json()

    @_endpoint(
        "introspect",
        "Inspect a token (RFC 7662)",
        "its state",
        raw_body=AboutToken,
        credential=Credential.OAUTH_CLIENT_OR_USER,
    )
    async def introspect(self, request: ApiRequest) -> Introspection:
        fields = _fields(request)
        return await self._service.introspect(_token_in(fields), *await self._caller(request, fields))

    @_endpoint(
        "revoke",
        "Revoke a token (RFC 7009)",
        "the token is not valid, any more or ever",
        more="Revoking a refresh token revokes all tokens of the same login.",
        raw_body=AboutToken,
        # The token is revoked even if the OAuth client disconnects at once.
        detached=True,
        credential=Credential.OAUTH_CLIENT_OR_USER,
    )
    async def revoke(self, request: ApiRequest) -> Nothing:
        fields = _fields(request)
        await self._service.revoke(_token_in(fields), *await self._caller(request, fields))
        return {}

    # --- authentication -----------------------------------------------------------------------------------

    async def _caller(self, request: ApiRequest, fields: dict[str, str]) -> tuple[str, str | None]:
        """Realm of the caller, and key of an OAuth client. It may use tokens of that realm and its own."""
        scheme, _, token = (request.http.getHeader("authorization") or "").partition(" ")
        if scheme.lower() == "bearer":
            return (await self._service.principal(token.strip())).realm, None
        client = await self._oauth_client(request, fields)
        if client is None:
            raise BadCredentials("send an access token, or the key and secret of an OAuth client")
        return client.realm, client.key

    async def _oauth_client(self, request: ApiRequest, fields: dict[str, str]) -> OAuthClientRecord | None:
        header = request.http.getHeader("authorization") or ""
        inside = (fields["client_id"], fields["client_secret"]) if fields.keys() >= _INSIDE else None
        if header and inside is not None:
            raise OAuthError(
                "invalid_request",
                "authenticate the OAuth client in one way, not in two (RFC 6749 section 2.3)",
            )
        method, uri = request.http.method.decode("ascii"), request.http.uri.decode("ascii", "replace")
        return await self._service.authenticate_client(header, method, uri, request.address, inside)

    # --- errors -------------------------------------------------------------------------------------------

    def answer_error(self, request: Request, error: SwitchboardError) -> bytes:
        """Answer with an error as in RFC 6749 section 5.2, which is problem details (RFC 9457) as well."""
        if isinstance(error, (TooManyTries, TooManyRequests, Unavailable, WrongMethod)):
            return problem_of(request, error)
        name, status = "invalid_request", 400
        if isinstance(error, BadCredentials) and not isinstance(error, WrongAddress):
            name, status = "invalid_client", 401
            challenge = self._service.digest.challenge(stale=isinstance(error, StaleNonce))
            challenges = [challenge.encode(), b'Basic realm="switchboard", charset="UTF-8"']
            request.responseHeaders.setRawHeaders(b"www-authenticate", challenges)
        elif isinstance(error, OAuthError):
            name = error.error
        body = problem(request, status, str(error), error=name, error_description=str(error))
        # Clients of OAuth expect this type, not that of problem details.
        request.setHeader(b"content-type", b"application/json")
        return body


_INSIDE = {"client_id", "client_secret"}


def _fields(request: ApiRequest) -> dict[str, str]:
    """The fields of a form, each of which occurs once (RFC 6749 section 3.2).

    :raises Invalid: the body is not a form, or a field occurs twice
    """
    body = request.content()
    kind = (request.http.getHeader("content-type") or "").partition(";")[0].strip().lower()
    if body and kind != FORM.media:
        raise Invalid(f"send the body as {FORM.media}")
    try:
        pairs = parse_qsl(body.decode(), keep_blank_values=False, max_num_fields=FIELDS, errors="strict")
    except ValueError:
        raise Invalid(f"the body is not a form in UTF-8 with at most {FIELDS} fields") from None
    fields = dict(pairs)
    if len(fields) < len(pairs):
        raise Invalid("a field occurs twice")
    return fields


def _token_in(fields: dict[str, str]) -> str:
    if "token" not in fields:
        raise OAuthError("invalid_request", "send token")
    return fields["token"]
