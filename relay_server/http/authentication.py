"""The principal of a request, by access token or session cookie (SPEC 1.1); each request counts once."""

from __future__ import annotations

from typing import Protocol

from twisted.web.server import Request

from relay_server.access import BadCredentials, Principal
from relay_server.auth.origins import Origins
from relay_server.cluster.forwarding import ForwardedClient
from relay_server.http.limits import RequestLimits


class TokenChecker(Protocol):
    """Looks up access tokens; see :class:`relay_server.auth.service.AuthService`."""

    async def token(self, token: str) -> Principal:
        """The principal of a token."""

    async def token_from_memory(self, token: str) -> Principal:
        """The same, with little or no delay by the database."""

    def remembers(self, token: str) -> bool:
        """Whether it was proved before."""


class RequestAuthenticator:
    """Finds the principal of a request, and counts the request for that user or for its network.

    :param cookie: name of the session cookie
    """

    def __init__(self, tokens: TokenChecker, origins: Origins, limits: RequestLimits, *, cookie: str) -> None:
        self.limits = limits
        self.origins = origins
        self._tokens = tokens
        self._cookie = cookie

    async def principal(
        self, request: Request, *, from_memory: bool = False, never_limited: bool = False
    ) -> Principal:
        """The principal of a request.

        :param from_memory: a token that was proved before needs no database: the request stops a robot, or shows the
            rights to do so
        :param never_limited: it stops something, so it is served however many requests there are
        :raises BadCredentials: no valid credentials
        :raises Refused: a cookie on a request that changes something, without a listed Origin
        :raises TooManyRequests: the user, or the network of an unknown sender, has sent too many
        """
        if request.forwarded_client is not None:
            request.known = True
            client: ForwardedClient = request.forwarded_client
            return client.principal
        try:
            found = await self._proved(request, from_memory)
        except BadCredentials:
            if not never_limited:
                self.limits.of_network(request)
            raise
        request.known = True
        if not never_limited:
            self.limits.of_user(request, found.user_id)
        return found

    async def _proved(self, request: Request, from_memory: bool) -> Principal:
        prove = self._tokens.token_from_memory if from_memory else self._tokens.token
        token = _bearer(request)
        if token is not None:
            return await prove(token)
        cookie = self._session(request)
        if cookie is None:
            raise BadCredentials(
                "log in first: send an access token (Authorization: Bearer …) or a session cookie"
            )
        if request.method not in (b"GET", b"HEAD"):
            self.origins.check(request.getHeader("origin"), request.getHeader("host") or "")
        return await prove(cookie.decode("ascii", "replace"))

    def _session(self, request: Request) -> bytes | None:
        names = self.origins.cookie_names(self._cookie, request.getHeader("host") or "")
        given = (request.getCookie(each.encode()) for each in names)
        return next((each for each in given if each is not None), None)

    def remembers(self, request: Request) -> bool:
        """Whether the token or cookie of a request was proved before. The database is not asked."""
        token = _bearer(request)
        if token is None:
            token = (self._session(request) or b"").decode("ascii", "replace")
        return self._tokens.remembers(token)

    def check_origin(self, request: Request) -> None:
        """:raises Refused: the request has an Origin, and it is neither listed nor the relay's own"""
        origin = request.getHeader("origin")
        if origin is not None and request.forwarded_client is None:
            self.origins.check(origin, request.getHeader("host") or "")

    def base(self, request: Request) -> str:
        """``scheme://host[:port]`` of the relay, as the sender addresses it.

        :raises Invalid: the request has no usable ``Host``
        """
        return self.origins.base(request.getHeader("host") or "")

    def set_cookie(self, request: Request, token: str, seconds: float) -> None:
        """Set the session cookie in the answer; 0 seconds removes it."""
        encrypted = self._is_encrypted(request)
        request.addCookie(
            self.origins.cookie_name(self._cookie, encrypted),
            token,
            path="/",
            max_age=str(int(seconds)),
            httpOnly=True,
            secure=encrypted,
            sameSite="strict",
        )

    def _is_encrypted(self, request: Request) -> bool:
        """Whether the browser uses TLS: by ``Host``, or by the origin of the portal if a proxy changes that."""
        if self.origins.encrypted(request.getHeader("host") or ""):
            return True
        origin = request.getHeader("origin") or ""
        own = request.getHeader("sec-fetch-site") == "same-origin"
        return own and origin.lower().startswith("https:") and self.origins.is_listed(origin)


def _bearer(request: Request) -> str | None:
    lines = request.requestHeaders.getRawHeaders(b"authorization", [b""])
    scheme, _, token = lines[-1].decode(errors="replace").partition(" ")
    return token.strip() if scheme.lower() == "bearer" else None
