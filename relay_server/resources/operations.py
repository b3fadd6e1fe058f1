"""What ``resources`` serves: topics, services, actions and parameters of a robot, with what they take.

And what any collection of a robot is asked for: a page, and one member.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import UNSET, Meta, UnsetType

from relay_server.common.freshness_tokens import HEADER
from relay_server.http.idempotency import KEY_HEADER
from relay_server.http.media_types import EVENTS, FORMS
from relay_server.http.negotiation import MessageBody, TypeName, ValueBody
from relay_server.http.openapi.operation import PROBLEM, ApiOperation, Parameter, Response, header, query, raw
from relay_server.http.openapi.schemas import (
    ActionPage,
    Available,
    CallAnswer,
    GoalInfo,
    ParamPage,
    ParamValue,
    Provided,
    ServicePage,
    TopicMessage,
    TopicPage,
)
from relay_server.http.request_params import LISTING, WAIT
from relay_server.resources.goals_http import GOAL_HEADERS, PREFER, GoalBody

THROTTLE_MS = 60_000.0

ROBOT = "/api/v1/robots/{robot}"

_MEDIA = tuple(each.media for each in FORMS)
_MOMENT = {HEADER: "when this was answered; what moves the robot gives it back"}
_TAGGED = {"ETag": "names this state in this form", **_MOMENT}
_KNOWN = header("If-None-Match", "entity tags of what is known already")
_MATCH = header("If-Match", "entity tags: only if it is one of these")
_SENT = (
    header(HEADER, "that of the latest answer, for what moves the robot"),
    header(KEY_HEADER, "a key of the sender's: the same again is not done again"),
)
_UNCHANGED = Response("it is as it is known", headers=_TAGGED)
_NOT_ACCEPTABLE = {406: Response("none of these forms is accepted", Available, media=(PROBLEM,))}
_NOT_READ = {415: Response("the body is in another form", Available, media=(PROBLEM,))}
_MOVING = (409, 412, 422, 428, 504)
"""What can be wrong with what may move a robot, and with a key."""
_ASKING = (409, 504)
"""What can be wrong with asking a node of the robot."""


TIMEOUT = 10.0
"""Seconds that a service may take where nothing is said of it."""

LEAST_TIMEOUT = 0.1


class Call(msgspec.Struct, forbid_unknown_fields=True):
    """A call of a service.

    :param args: an object, or a list in the order of the fields
    :param timeout: seconds; without it ``Prefer: wait``, else 10
    """

    args: msgspec.Raw = raw(b"{}")
    type: TypeName = ""
    timeout: Annotated[float, Meta(ge=LEAST_TIMEOUT, le=300.0)] | UnsetType = UNSET


def members_of(
    part: str,
    summary: str,
    page: Any,
    *,
    listing: tuple[Parameter, ...] = LISTING,
    errors: tuple[int, ...] = (),
) -> ApiOperation:
    """A page of a collection, in every form.

    :param listing: what the page can be asked by
    """
    return ApiOperation(
        method="GET",
        path=f"{ROBOT}/{part}",
        tag="resources",
        summary=summary,
        parameters=(*listing, _KNOWN),
        answers={200: Response("a page", page, media=_MEDIA, headers=_TAGGED), 304: _UNCHANGED},
        errors=errors,
        problems=_NOT_ACCEPTABLE,
    )


def member_of(part: str, summary: str, member: Any, *, errors: tuple[int, ...] = ()) -> ApiOperation:
    """One member of a collection, in every form."""
    return ApiOperation(
        method="GET",
        path=f"{ROBOT}/{part}/{{name}}",
        tag="resources",
        summary=summary,
        parameters=(_KNOWN,),
        answers={200: Response("it", member, media=_MEDIA, headers=_TAGGED), 304: _UNCHANGED},
        errors=errors,
        problems=_NOT_ACCEPTABLE,
    )


def _publish(method: str) -> ApiOperation:
    return ApiOperation(
        method=method,
        path=f"{ROBOT}/topics/{{name}}",
        tag="resources",
        summary="Publish a message",
        more="It is sent once somebody hears it, as far as anybody subscribes. `If-Match` does not apply: 400.",
        parameters=_SENT,
        body=MessageBody,
        media=_MEDIA,
        answers={204: Response("sent", headers=_MOMENT)},
        errors=_MOVING,
        problems=_NOT_READ,
    )


MEMBERS = (
    members_of("topics", "A page of the topics that the caller may use", TopicPage),
    members_of("services", "A page of the services that the caller may use", ServicePage),
    members_of("actions", "A page of the actions that the caller may use", ActionPage),
    members_of("params", "A page of the parameters that the caller may use", ParamPage, errors=_ASKING),
)
ONE = (
    ApiOperation(
        method="GET",
        path=f"{ROBOT}/topics/{{name}}",
        tag="resources",
        summary="The newest message of a topic",
        more="With `Accept: text/event-stream` every message as an event, until the reader leaves.",
        parameters=(
            query("wait", "seconds for one to come; 2 where left out", Annotated[float, Meta(ge=0, le=WAIT)]),
            query("max_age", "seconds that it may be old", Annotated[float, Meta(ge=0, le=1e9)]),
            query(
                "throttle_ms",
                "of a stream: least time between two",
                Annotated[float, Meta(ge=0, le=THROTTLE_MS)],
            ),
            _KNOWN,
        ),
        answers={
            200: Response("the message", TopicMessage, media=(*_MEDIA, EVENTS.media), headers=_TAGGED),
            304: _UNCHANGED,
        },
        errors=(504,),
        problems=_NOT_ACCEPTABLE,
    ),
    member_of("services", "A service", Provided),
    member_of("actions", "An action", Provided),
    member_of("params", "A parameter", ParamValue, errors=_ASKING),
)
CHANGE = (
    _publish("PUT"),
    _publish("POST"),
    ApiOperation(
        method="POST",
        path=f"{ROBOT}/services/{{name}}",
        tag="resources",
        summary="Call a service",
        more="Without a body the request is empty. `/relay/stop` and `/relay/release_control` are never held back.",
        parameters=_SENT,
        body=Call,
        optional=True,
        answers={200: Response("what it answered", CallAnswer, headers=_MOMENT)},
        errors=_MOVING,
    ),
    ApiOperation(
        method="POST",
        path=f"{ROBOT}/actions/{{name}}",
        tag="goals",
        summary="Have a goal pursued",
        more="It goes on as long as somebody looks at it.",
        parameters=(*_SENT, PREFER),
        body=GoalBody,
        answers={
            200: Response("it is over", GoalInfo, headers=GOAL_HEADERS),
            202: Response("it is pursued", GoalInfo, headers=GOAL_HEADERS),
        },
        errors=_MOVING,
    ),
    ApiOperation(
        method="PUT",
        path=f"{ROBOT}/params/{{name}}",
        tag="resources",
        summary="Set a parameter",
        parameters=(_MATCH,),
        body=ValueBody,
        media=_MEDIA,
        answers={204: Response("set", headers=_MOMENT)},
        errors=(409, 412, 504),
        problems=_NOT_READ,
    ),
    ApiOperation(
        method="DELETE",
        path=f"{ROBOT}/params/{{name}}",
        tag="resources",
        summary="Delete a parameter",
        parameters=(_MATCH,),
        answers={204: Response("deleted", headers=_MOMENT)},
        errors=(409, 412, 504),
    ),
)
