"""What ``resources`` serves: topics, services, actions and parameters of a robot, with what they take.

And what any collection of a robot is asked for: a page, and one member.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import UNSET, Meta, UnsetType

from relay_server.edges.asked import LISTING, WAIT
from relay_server.edges.goals import GOAL_HEADERS, PREFER, Wish
from relay_server.edges.representing import Message, TypeName, Value
from relay_server.openapi import PROBLEM, Answer, Operation, Parameter, header, query, raw
from relay_server.openapi.told import (
    Actions,
    Available,
    CallAnswer,
    GoalStatus,
    Params,
    ParamValue,
    Provided,
    Services,
    Topics,
    TopicState,
)
from relay_server.resources import HEADER, KEY_HEADER
from relay_server.resources.forms import EVENTS, FORMS

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
_UNCHANGED = Answer("it is as it is known", headers=_TAGGED)
_NOT_ACCEPTABLE = {406: Answer("none of these forms is accepted", Available, media=(PROBLEM,))}
_NOT_READ = {415: Answer("the body is in another form", Available, media=(PROBLEM,))}
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
) -> Operation:
    """A page of a collection, in every form.

    :param listing: what the page can be asked by
    """
    return Operation(
        method="GET",
        path=f"{ROBOT}/{part}",
        tag="resources",
        summary=summary,
        parameters=(*listing, _KNOWN),
        answers={200: Answer("a page", page, media=_MEDIA, headers=_TAGGED), 304: _UNCHANGED},
        errors=errors,
        problems=_NOT_ACCEPTABLE,
    )


def member_of(part: str, summary: str, member: Any, *, errors: tuple[int, ...] = ()) -> Operation:
    """One member of a collection, in every form."""
    return Operation(
        method="GET",
        path=f"{ROBOT}/{part}/{{name}}",
        tag="resources",
        summary=summary,
        parameters=(_KNOWN,),
        answers={200: Answer("it", member, media=_MEDIA, headers=_TAGGED), 304: _UNCHANGED},
        errors=errors,
        problems=_NOT_ACCEPTABLE,
    )


def _publish(method: str) -> Operation:
    return Operation(
        method=method,
        path=f"{ROBOT}/topics/{{name}}",
        tag="resources",
        summary="Publish a message",
        more="It is sent once somebody hears it, as far as anybody subscribes. `If-Match` does not apply: 400.",
        parameters=_SENT,
        body=Message,
        media=_MEDIA,
        answers={204: Answer("sent", headers=_MOMENT)},
        errors=_MOVING,
        problems=_NOT_READ,
    )


MEMBERS = (
    members_of("topics", "A page of the topics that the caller may use", Topics),
    members_of("services", "A page of the services that the caller may use", Services),
    members_of("actions", "A page of the actions that the caller may use", Actions),
    members_of("params", "A page of the parameters that the caller may use", Params, errors=_ASKING),
)
ONE = (
    Operation(
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
            200: Answer("the message", TopicState, media=(*_MEDIA, EVENTS.media), headers=_TAGGED),
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
    Operation(
        method="POST",
        path=f"{ROBOT}/services/{{name}}",
        tag="resources",
        summary="Call a service",
        more="Without a body the request is empty. `/relay/stop` and `/relay/release_control` are never held back.",
        parameters=_SENT,
        body=Call,
        optional=True,
        answers={200: Answer("what it answered", CallAnswer, headers=_MOMENT)},
        errors=_MOVING,
    ),
    Operation(
        method="POST",
        path=f"{ROBOT}/actions/{{name}}",
        tag="goals",
        summary="Have a goal pursued",
        more="It goes on as long as somebody looks at it.",
        parameters=(*_SENT, PREFER),
        body=Wish,
        answers={
            200: Answer("it is over", GoalStatus, headers=GOAL_HEADERS),
            202: Answer("it is pursued", GoalStatus, headers=GOAL_HEADERS),
        },
        errors=_MOVING,
    ),
    Operation(
        method="PUT",
        path=f"{ROBOT}/params/{{name}}",
        tag="resources",
        summary="Set a parameter",
        parameters=(_MATCH,),
        body=Value,
        media=_MEDIA,
        answers={204: Answer("set", headers=_MOMENT)},
        errors=(409, 412, 504),
        problems=_NOT_READ,
    ),
    Operation(
        method="DELETE",
        path=f"{ROBOT}/params/{{name}}",
        tag="resources",
        summary="Delete a parameter",
        parameters=(_MATCH,),
        answers={204: Answer("deleted", headers=_MOMENT)},
        errors=(409, 412, 504),
    ),
)
