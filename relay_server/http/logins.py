"""``/api/v1/session`` and ``/api/v1/tickets``: log in, log out, and tickets for websockets and cameras."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Protocol, TypedDict, cast

import msgspec
from msgspec import Meta

from relay_protocol.errors import Invalid
from relay_protocol.limits import NAME, TICKET_SECONDS
from relay_server.access import Principal
from relay_server.auth.authenticator import SESSION_SECONDS, TicketPurpose
from relay_server.http.endpoint import Answered, ApiRequest, Created, IdempotencyKey, endpoint
from relay_server.http.openapi.operation import Credential

_COOKIE = {"Set-Cookie": "the session"}


class LoginBody(msgspec.Struct):
    """A user with a password, or a code from a login link."""

    user: str = ""
    password: str = ""
    code: str = ""


class TicketFor(msgspec.Struct, rename={"purpose": "for"}):
    """The purpose of a ticket: the robot's websocket, all its cameras, or one of them."""

    robot: str
    purpose: Literal["robot", "video"] = "robot"
    camera: Annotated[str, Meta(max_length=NAME)] = ""


class CurrentUser(TypedDict):
    """The user that is logged in."""

    user: str
    admin: bool
    realm: str


Ticket = TypedDict(
    "Ticket",
    {"ticket": str, "expires_in": float, "robot": str, "for": Literal["robot", "video"], "camera": str},
)
Ticket.__doc__ = """A ticket for one use.

:param expires_in: seconds
"""


class LoginService(Protocol):
    """Logs users in and out; see :class:`relay_server.auth.service.AuthService`."""

    async def password(self, user: str, password: str, address: str) -> tuple[Principal, str]:
        """A principal and the token of a new portal session."""

    async def login_code(self, code: str, address: str) -> tuple[Principal, str]:
        """The same for a one-time login link."""

    async def logout(self, principal: Principal) -> None:
        """End the session of the principal."""

    async def issue_ticket(self, principal: Principal, opens: TicketPurpose) -> str:
        """A ticket for one use."""


class LoginEndpoints:
    """Logins and tickets."""

    def __init__(self, service: LoginService) -> None:
        self._service = service

    @endpoint(
        "POST",
        "/api/v1/session",
        tag="session",
        summary="Log in",
        more="By user and password, or by the code of a login link. For browsers; other clients use `/oauth/token`.",
        returns="logged in",
        headers=_COOKIE,
        credential=Credential.NONE,
        errors=(401, 403, 503),
    )
    async def login(self, request: ApiRequest, body: LoginBody) -> Answered[CurrentUser]:
        request.check_origin()
        if body.code:
            principal, token = await self._service.login_code(body.code, request.address)
        elif body.user and body.password:
            principal, token = await self._service.password(body.user, body.password, request.address)
        else:
            raise Invalid("the login is incomplete: send 'user' and 'password', or 'code' from a login link")
        request.http.known = True
        request.set_cookie(token, SESSION_SECONDS)
        return Answered(_shown(principal))

    # The portal needs this to offer the stop button, also while the database hangs.
    @endpoint(
        "GET",
        "/api/v1/session",
        tag="session",
        summary="The user that is logged in",
        returns="the caller",
        proved_from_memory=True,
    )
    async def session(self, request: ApiRequest) -> CurrentUser:
        return _shown(request.principal)

    # Logging out completes even if the page is closed at once, or the database is slow.
    @endpoint(
        "DELETE",
        "/api/v1/session",
        tag="session",
        summary="Log out",
        more="Ends the session or token of this request, and everything opened with it.",
        returns="logged out",
        headers=_COOKIE,
        detached=True,
    )
    async def logout(self, request: ApiRequest) -> None:
        await self._service.logout(request.principal)
        request.set_cookie("", 0)

    @endpoint(
        "POST",
        "/api/v1/tickets",
        tag="session",
        summary="A ticket for one use",
        more="Opens the robot's websocket or its cameras with `?ticket=`, within 60 s.",
        returns="the ticket",
        key=IdempotencyKey.REFUSED,
        errors=(404,),
    )
    async def ticket(self, request: ApiRequest, body: TicketFor) -> Created[Ticket]:
        video = body.purpose == "video"
        if body.camera and not video:
            raise Invalid("'camera' needs 'for': 'video'")
        purpose = TicketPurpose(body.robot, video, body.camera)
        ticket = await self._service.issue_ticket(request.principal, purpose)
        issued: dict[str, Any] = {"ticket": ticket, "expires_in": TICKET_SECONDS, **msgspec.to_builtins(body)}
        return Created(cast(Ticket, issued))


def _shown(principal: Principal) -> CurrentUser:
    return {"user": principal.name, "admin": principal.admin, "realm": principal.realm}
