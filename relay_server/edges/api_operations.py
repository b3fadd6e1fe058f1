"""What ``api`` serves: sessions, robots, tickets, health and metrics, with the bodies they take."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from relay_protocol.limits import NAME
from relay_server.edges.asked import KNOWN, UNTYPED
from relay_server.openapi import PROBLEM, Answer, Credential, Operation
from relay_server.openapi.answers import Health, Me, Robot, Robots, Ticket
from relay_server.openapi.told import Available
from relay_server.resources.forms import FORMS


class Login(msgspec.Struct):
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
_UNCHANGED = Answer("it is as it is known", headers=_TAGGED)
_COOKIE = {"Set-Cookie": "the session"}

LOGIN = Operation(
    method="POST",
    path="/api/v1/session",
    tag="session",
    summary="Log in",
    more="By user and password, or by the code of a login link. For browsers; programs use `/oauth/token`.",
    body=Login,
    answers={200: Answer("logged in", Me, headers=_COOKIE)},
    errors=(401, 403, 503),
    credential=Credential.NONE,
)
SESSION = Operation(
    method="GET",
    path="/api/v1/session",
    tag="session",
    summary="Who is logged in",
    answers={200: Answer("who asks", Me)},
)
LOGOUT = Operation(
    method="DELETE",
    path="/api/v1/session",
    tag="session",
    summary="Log out",
    more="Ends the session or token this is asked with, and what was opened with it.",
    answers={204: Answer("logged out", headers=_COOKIE)},
)
ROBOTS = Operation(
    method="GET",
    path="/api/v1/robots",
    tag="robots",
    summary="A page of the robots the caller has a right on",
    parameters=(*UNTYPED, KNOWN),
    answers={200: Answer("a page", Robots, headers=_TAGGED), 304: _UNCHANGED},
)
STREAM = Operation(
    method="GET",
    path="/api/v1/robots/stream",
    tag="robots",
    summary="The same, and alerts, at every change",
    more="Server-sent events; asked for as a websocket, the same as text messages (SPEC section 1.7).",
    answers={200: Answer("events", media=("text/event-stream",))},
    lasts="It goes on until the reader leaves.",
)
ROBOT = Operation(
    method="GET",
    path="/api/v1/robots/{robot}",
    tag="robots",
    summary="One robot",
    parameters=(KNOWN,),
    answers={
        200: Answer("the robot", Robot, media=tuple(each.media for each in FORMS), headers=_TAGGED),
        304: _UNCHANGED,
    },
    problems={406: Answer("none of these forms is accepted", Available, media=(PROBLEM,))},
)
TICKETS = Operation(
    method="POST",
    path="/api/v1/tickets",
    tag="session",
    summary="A ticket for one use",
    more="It opens the robot's websocket or its cameras by `?ticket=`, within 60 s.",
    body=TicketFor,
    answers={201: Answer("the ticket", Ticket)},
    errors=(404,),
)
HEALTH = Operation(
    method="GET",
    path="/healthz",
    tag="relay",
    summary="Whether the relay and its database answer",
    answers={200: Answer("they do", Health)},
    errors=(503,),
    credential=Credential.NONE,
)
METRICS = Operation(
    method="GET",
    path="/metrics",
    tag="relay",
    summary="Figures for Prometheus",
    more="For administrators.",
    answers={200: Answer("figures", media=("text/plain",))},
)
