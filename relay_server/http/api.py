"""``/api/v1``: sessions, robots, tickets; ``/healthz`` and ``/metrics``.

A cookie that changes state counts only with a listed Origin. Every error is problem details (RFC 9457).
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Container, Mapping
from typing import Annotated, Any, Literal, Protocol, TypeVar

import msgspec
from klein import Klein
from msgspec import Meta
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from twisted.internet.defer import Deferred
from twisted.logger import Logger
from twisted.web.resource import IResource
from twisted.web.server import Request
from werkzeug.exceptions import HTTPException, MethodNotAllowed
from werkzeug.exceptions import NotFound as NothingHere
from werkzeug.routing import RequestRedirect

from relay_protocol import jsontext, nonfinite
from relay_protocol.errors import Invalid, Refused, SwitchboardError, Unavailable
from relay_protocol.limits import NAME, TICKET_SECONDS
from relay_protocol.realms import DEFAULT_REALM
from relay_server.access import BadCredentials, Principal
from relay_server.auth.authenticator import SESSION_SECONDS, TicketPurpose
from relay_server.auth.origins import Origins
from relay_server.common.clock import Clock, detached, shield
from relay_server.http.idempotent_requests import see_no_key
from relay_server.http.media_types import FORMS
from relay_server.http.openapi.operation import PROBLEM, ApiOperation, Credential, Response, described
from relay_server.http.openapi.schemas import Available, CurrentUser, HealthInfo, RobotInfo, RobotPage, Ticket
from relay_server.http.problems import problem, problem_of
from relay_server.http.rate_limits import RequestLimits
from relay_server.http.request_params import KNOWN, UNTYPED
from relay_server.http.sse import UpdateStream
from relay_server.http.time_limit import ROBOT_SECONDS, allow, in_time
from relay_server.http.update_sources import Sources


class LoginBody(msgspec.Struct):
    """A user with a password, or a code from a login link."""

    user: str = ""
    password: str = ""
    code: str = ""


class TicketFor(msgspec.Struct, rename={"purpose": "for"}):
    """For the robot's websocket, or for its cameras, or one of them."""

    robot: str
    purpose: Literal["robot", "video"] = "robot"
    camera: Annotated[str, Meta(max_length=NAME)] = ""


_TAGGED = {"ETag": "names this state, whatever `rtt_ms` and `last_seen` are"}
_UNCHANGED = Response("it is as it is known", headers=_TAGGED)
_COOKIE = {"Set-Cookie": "the session"}

LOGIN = ApiOperation(
    method="POST",
    path="/api/v1/session",
    tag="session",
    summary="Log in",
    more="By user and password, or by the code of a login link. For browsers; programs use `/oauth/token`.",
    body=LoginBody,
    answers={200: Response("logged in", CurrentUser, headers=_COOKIE)},
    errors=(401, 403, 503),
    credential=Credential.NONE,
)
SESSION = ApiOperation(
    method="GET",
    path="/api/v1/session",
    tag="session",
    summary="Who is logged in",
    answers={200: Response("who asks", CurrentUser)},
)
LOGOUT = ApiOperation(
    method="DELETE",
    path="/api/v1/session",
    tag="session",
    summary="Log out",
    more="Ends the session or token this is asked with, and what was opened with it.",
    answers={204: Response("logged out", headers=_COOKIE)},
)
ROBOTS = ApiOperation(
    method="GET",
    path="/api/v1/robots",
    tag="robots",
    summary="A page of the robots the caller has a right on",
    parameters=(*UNTYPED, KNOWN),
    answers={200: Response("a page", RobotPage, headers=_TAGGED), 304: _UNCHANGED},
)
STREAM = ApiOperation(
    method="GET",
    path="/api/v1/robots/stream",
    tag="robots",
    summary="The same, and alerts, at every change",
    more="Server-sent events; asked for as a websocket, the same as text messages (SPEC section 1.7).",
    answers={200: Response("events", media=("text/event-stream",))},
    lasts="It goes on until the reader leaves.",
)
ROBOT = ApiOperation(
    method="GET",
    path="/api/v1/robots/{robot}",
    tag="robots",
    summary="One robot",
    parameters=(KNOWN,),
    answers={
        200: Response("the robot", RobotInfo, media=tuple(each.media for each in FORMS), headers=_TAGGED),
        304: _UNCHANGED,
    },
    problems={406: Response("none of these forms is accepted", Available, media=(PROBLEM,))},
)
TICKETS = ApiOperation(
    method="POST",
    path="/api/v1/tickets",
    tag="session",
    summary="A ticket for one use",
    more="It opens the robot's websocket or its cameras by `?ticket=`, within 60 s.",
    body=TicketFor,
    answers={201: Response("the ticket", Ticket)},
    errors=(404,),
)
HEALTH = ApiOperation(
    method="GET",
    path="/healthz",
    tag="relay",
    summary="Whether the relay and its database answer",
    answers={200: Response("they do", HealthInfo)},
    errors=(503,),
    credential=Credential.NONE,
)
METRICS = ApiOperation(
    method="GET",
    path="/metrics",
    tag="relay",
    summary="Figures for Prometheus",
    more="For administrators.",
    answers={200: Response("figures", media=("text/plain",))},
)

T = TypeVar("T")


class ApiServices(Protocol):
    """What the API asks for; the composition root's."""

    async def password(self, user: str, password: str, address: str) -> tuple[Principal, str]:
        """A principal and the token of a new portal session."""

    async def login_code(self, code: str, address: str) -> tuple[Principal, str]:
        """The same for a one-time login link."""

    async def token(self, token: str) -> Principal:
        """The principal of a token."""

    async def urgent_token(self, token: str) -> Principal:
        """The same, with little or no waiting for the database."""

    async def logout(self, principal: Principal) -> None:
        """End the session the principal came with."""

    async def robots(self, principal: Principal) -> list[dict[str, Any]]:
        """What the principal may see of its robots."""

    async def issue_ticket(self, principal: Principal, opens: TicketPurpose) -> str:
        """A ticket for one use."""

    async def healthy(self) -> bool:
        """Whether the database answers."""

    def on_change(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Call ``listener`` when something about robots may have changed; returns what ends that."""


class RobotLister(Protocol):
    """What tells of robots themselves; see :class:`relay_server.resources.robots_http.RobotResource`."""

    async def page(self, api: Api, request: Request) -> Any:
        """A page of those that who asks has a right on."""

    async def one(self, api: Api, request: Request, name: str) -> Any:
        """One of them."""


class Api:
    """The HTTP API as a klein application.

    :param below: what serves the addresses below those of robots, by their first part
    :param beside: the same for those beside them
    :param robots: tells of robots themselves
    :param sources: what pages show
    :param cookie: name of the session cookie
    :param secure: cookies only over TLS
    :param limits: how many requests there may be; without them as many as come
    """

    log = Logger()
    app = Klein()

    def __init__(
        self,
        clock: Clock,
        desk: ApiServices,
        origins: Origins,
        metrics: CollectorRegistry,
        below: Mapping[str, Callable[[Api, str], IResource]],
        beside: Mapping[str, Callable[[Api], IResource]],
        robots: RobotLister,
        sources: Sources,
        *,
        cookie: str,
        secure: bool,
        limits: RequestLimits | None = None,
    ) -> None:
        self._sources = sources
        self._limits = limits or RequestLimits(0.0, clock.seconds)
        self._clock = clock
        self._desk = desk
        self._origins = origins
        self._metrics = metrics
        self._below = below
        self._beside = beside
        self._robots = robots
        self._cookie = cookie
        self._secure = secure

    # --- who asks -----------------------------------------------------------------------------------------

    async def principal(self, request: Request, *, urgent: bool = False, passes: bool = False) -> Principal:
        """Who sent this request, which counts as one of his.

        :param urgent: it stops robots, or must not keep somebody from it
        :param passes: it stops something: however many there are, it is served
        :raises BadCredentials: nobody that can be told
        :raises Refused: a cookie that changes state without a listed Origin
        :raises TooManyRequests: he, or who is not known in his network, has sent too many
        """
        try:
            found = await self._proved(request, urgent)
        except BadCredentials:
            if not passes:
                self._limits.of_network(request)
            raise
        request.known = True
        if not passes:
            self._limits.of_user(request, found.user_id)
        return found

    async def _proved(self, request: Request, urgent: bool) -> Principal:
        prove = self._desk.urgent_token if urgent else self._desk.token
        scheme, _, token = (request.getHeader("authorization") or "").partition(" ")
        if scheme.lower() == "bearer":
            return await prove(token.strip())
        cookie = request.getCookie(self._cookie.encode())
        if cookie is None:
            raise BadCredentials(
                "log in first: send an access token (Authorization: Bearer …) or a session cookie"
            )
        if request.method not in (b"GET", b"HEAD"):
            self._origins.check(request.getHeader("origin"), request.getHeader("host") or "")
        return await prove(cookie.decode("ascii", "replace"))

    def base(self, request: Request) -> str:
        """``scheme://host[:port]`` of the relay, as who asks sees it.

        :raises Invalid: the request does not say
        """
        return self._origins.base(request.getHeader("host") or "")

    def _set_cookie(self, request: Request, token: str, seconds: float) -> None:
        request.addCookie(
            self._cookie,
            token,
            path="/",
            max_age=str(int(seconds)),
            httpOnly=True,
            secure=self._secure,
            sameSite="strict",
        )

    # --- sessions -----------------------------------------------------------------------------------------

    @app.route("/api/v1/session", methods=["POST"])
    @described(LOGIN)
    def login(self, request: Request) -> Any:
        return self.answer(request, self._login(request))

    async def _login(self, request: Request) -> Any:
        self._limits.of_network(request)
        if request.getHeader("origin") is not None:
            self._origins.check(request.getHeader("origin"), request.getHeader("host") or "")
        body = body_of(request, LoginBody)
        address = getattr(request.getClientAddress(), "host", "local")
        if body.code:
            principal, token = await self._desk.login_code(body.code, address)
        elif body.user and body.password:
            principal, token = await self._desk.password(body.user, body.password, address)
        else:
            raise Invalid("send 'user' and 'password', or 'code' from a login link")
        request.known = True
        self._set_cookie(request, token, SESSION_SECONDS)
        return _me(principal)

    @app.route("/api/v1/session", methods=["GET"])
    @described(SESSION)
    def session(self, request: Request) -> Any:
        return self.answer(request, self._session(request))

    async def _session(self, request: Request) -> Any:
        # By it the portal finds out whether anybody is there to stop robots, also while the database hangs.
        return _me(await self.principal(request, urgent=True))

    @app.route("/api/v1/session", methods=["DELETE"])
    @described(LOGOUT)
    def logout(self, request: Request) -> Any:
        return self.answer(request, self._logout(request))

    async def _logout(self, request: Request) -> Any:
        # It is done also when a page is closed at once, or the database takes too long for an answer.
        await detached(self._log_out(request))

    async def _log_out(self, request: Request) -> None:
        await self._desk.logout(await self.principal(request))
        self._set_cookie(request, "", 0)

    # --- robots -------------------------------------------------------------------------------------------

    @app.route("/api/v1/robots", methods=["GET"])
    @described(ROBOTS)
    def robots(self, request: Request) -> Any:
        return self.answer(request, self._robots.page(self, request))

    @app.route("/api/v1/robots/stream", methods=["GET"])
    @described(STREAM)
    def stream(self, request: Request) -> Any:
        return self.answer(request, self._stream(request))

    async def _stream(self, request: Request) -> Any:
        self.streams(request, await self.principal(request))
        await UpdateStream(self._clock, request, self.principal, self._sources).run()
        return STREAMED

    @app.route("/api/v1/robots/<name>", methods=["GET"])
    @described(ROBOT)
    def robot(self, request: Request, name: str) -> Any:
        return self.answer(request, self._robots.one(self, request, name))

    @app.route("/api/v1/robots/<name>/<part>", branch=True)
    def below(self, request: Request, name: str, part: str) -> Any:
        if part not in self._below:
            raise NothingHere
        # Without this, klein would redirect from the address without a slash at its end.
        request.postpath = request.postpath or [b""]
        allow(request, ROBOT_SECONDS)
        return self._below[part](self, name)

    @app.route("/api/v1/<any(alerts,directory,events,fleet,realm,vocabulary):part>", branch=True)
    def beside(self, request: Request, part: str) -> Any:
        if part not in self._beside:
            raise NothingHere
        request.postpath = request.postpath or [b""]
        return self._beside[part](self)

    @app.route("/api/v1/tickets", methods=["POST"])
    @described(TICKETS)
    def tickets(self, request: Request) -> Any:
        return self.answer(request, self._tickets(request))

    async def _tickets(self, request: Request) -> Any:
        principal = await self.principal(request)
        see_no_key(request)
        wanted = body_of(request, TicketFor)
        video = wanted.purpose == "video"
        if wanted.camera and not video:
            raise Invalid("'camera' goes with 'for': 'video'")
        ticket = await self._desk.issue_ticket(principal, TicketPurpose(wanted.robot, video, wanted.camera))
        request.setResponseCode(201)
        return {"ticket": ticket, "expires_in": TICKET_SECONDS, **msgspec.to_builtins(wanted)}

    # --- operations ---------------------------------------------------------------------------------------

    @app.route("/healthz", methods=["GET"])
    @described(HEALTH)
    def healthz(self, request: Request) -> Any:
        return self.answer(request, self._healthz(request))

    async def _healthz(self, request: Request) -> Any:
        self._limits.of_network(request)
        if not await self._desk.healthy():
            raise Unavailable("the database does not answer; what is open goes on, new logins fail")
        return {"status": "ok"}

    @app.route("/metrics", methods=["GET"])
    @described(METRICS)
    def metrics(self, request: Request) -> Any:
        return self.answer(request, self._show_metrics(request))

    async def _show_metrics(self, request: Request) -> Any:
        principal = await self.principal(request)
        if not principal.admin or principal.realm != DEFAULT_REALM:
            raise Refused(
                f"metrics are for administrators of the realm '{DEFAULT_REALM}': they tell of all realms"
            )
        request.setHeader(b"content-type", CONTENT_TYPE_LATEST.encode())
        request.write(generate_latest(self._metrics))
        return STREAMED

    def streams(self, request: Request, principal: Principal) -> None:
        """The answer is a stream, which counts as one of its user's.

        :raises TooManyStreams: they have too many
        """
        self._limits.answer_streams(request, principal.user_id)

    # --- answering ----------------------------------------------------------------------------------------

    def answer(self, request: Request, work: Any, *, lasts: bool = False) -> Deferred[bytes]:
        """Answer a request with what comes of a coroutine: JSON, nothing, :data:`STREAMED`, or an error in words.

        :param lasts: the work goes on when the client leaves or its time is over, which ends any other. The body has
            to be read before anything is waited for: it is gone with the client
        """
        request.setHeader(b"cache-control", b"no-store")
        running = Deferred.fromCoroutine(self._finish(request, work, lasts))
        running.addErrback(self._unexpected, request, lasts)
        # Whoever leaves has the Deferred that is returned here cancelled by klein.
        return shield(running) if lasts else running

    async def _finish(self, request: Request, work: Awaitable[Any], lasts: bool) -> bytes:
        try:
            result = await (work if lasts else in_time(request, work))
        except SwitchboardError as error:
            return problem_of(request, error)
        if result is STREAMED:
            return b""
        if result is None:
            request.setResponseCode(204)
            return b""
        request.setHeader(b"content-type", b"application/json")
        return jsontext.encode(result)

    def _unexpected(self, failure: Any, request: Request, lasts: bool) -> bytes:
        if request._disconnected and not lasts:
            return b""
        self.log.failure("{method} {path} failed", failure, method=request.method, path=request.path)
        return problem(request, 500, "The relay failed on this request; its log tells more.")

    @app.handle_errors(HTTPException)
    def unrouted(self, request: Request, failure: Any) -> bytes:
        """There is nothing here, or not by this method."""
        error: Any = failure.value
        if isinstance(error, RequestRedirect):
            # To what the same address would be without a slash too many: nobody is sent about.
            error = NothingHere()
        if isinstance(error, MethodNotAllowed) and error.valid_methods:
            request.setHeader("allow", ", ".join(sorted(error.valid_methods)))
        details = {404: "There is nothing at this address.", 405: "This address does not take that method."}
        status = error.code or 500
        return problem(request, status, details.get(status, "The request can't be served."))


STREAMED = object()
"""Result of a handler that has written the answer itself."""


def is_empty(request: Request) -> bool:
    """Whether a request has no body; what there is stays to be read."""
    request.content.seek(0)
    empty = not request.content.read(1)
    request.content.seek(0)
    return empty


def body_of(request: Request, kind: type[T], numbers: Container[str] = ()) -> T:
    """A request's JSON, checked.

    :param numbers: fields with values of a robot's types, in which NaN and infinity are marked, see
        :mod:`relay_protocol.nonfinite`
    :raises Invalid: it is not said to be JSON, or has NaN or infinity in another field
    :raises MalformedMessage: it is none, or not of this form
    """
    if (request.getHeader("content-type") or "").partition(";")[0].strip().lower() != "application/json":
        raise Invalid("send the body as application/json")
    return nonfinite.decode(msgspec.json.Decoder(kind), request.content.read(), numbers)


def _me(principal: Principal) -> dict[str, Any]:
    return {"user": principal.name, "admin": principal.admin, "realm": principal.realm}
