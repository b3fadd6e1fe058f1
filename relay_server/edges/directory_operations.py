"""What ``directory`` serves, with the shapes of what it answers."""

from __future__ import annotations

from typing import Annotated, Any, TypedDict

from msgspec import Meta

from relay_server.directory.entries import Registration
from relay_server.directory.limits import MOST
from relay_server.openapi import JSON, Answer, Operation, header, query

HERE = "/api/v1/directory"
STREAM = "text/event-stream"


class Entry(TypedDict):
    """Something in the directory; what robots have has no user and no lease.

    :param robot: the one it is about
    :param user: who registered it
    :param ttl: seconds that its lease lasts
    :param registered: Unix seconds
    :param expires: Unix seconds
    """

    id: str
    kind: str
    name: str
    robot: str | None
    address: str
    description: str
    data: dict[str, Any]
    user: str | None
    ttl: float | None
    registered: float | None
    expires: float | None


class Entries(TypedDict):
    """A page of the directory.

    :param next: goes into `after`, where there is more
    """

    entries: list[Entry]
    next: str | None


_TAGGED = {"ETag": "names what is told"}
_KNOWN = header("If-None-Match", "entity tags of what is known already")
_MATCH = header("If-Match", "entity tags: only if it is one of these")
_UNCHANGED = Answer("it is as it is known", headers=_TAGGED)

LIST = Operation(
    method="GET",
    path=HERE,
    tag="directory",
    summary="Services, applications, and what robots have",
    more="By `Accept` also the changes of what is registered, as events that go on.",
    parameters=(
        query("kind", "exactly of this kind"),
        query("robot", "only about robots of this name; shell wildcards"),
        query("name", "only of this name; shell wildcards"),
        query("realm", "only of this realm: of another than the caller's there is nothing"),
        query("limit", "most entries of a page; 100 where left out", Annotated[int, Meta(ge=1, le=MOST)]),
        query("after", "`next` of an earlier answer: what comes behind that"),
        _KNOWN,
        header("Last-Event-ID", "of a stream: what came behind this first"),
    ),
    answers={200: Answer("entries", Entries, media=(JSON, STREAM), headers=_TAGGED), 304: _UNCHANGED},
)
REGISTER = Operation(
    method="POST",
    path=HERE,
    tag="directory",
    summary="Register a service or an application",
    more="It stays for `ttl` seconds, and as long as it is renewed.",
    body=Registration,
    answers={
        201: Answer("as it is kept", Entry, headers={"Location": "its address", **_TAGGED}),
        200: Answer("it was registered by the same user, and is renewed", Entry, headers=_TAGGED),
    },
    errors=(404, 409),
)
ONE = Operation(
    method="GET",
    path=f"{HERE}/{{id}}",
    tag="directory",
    summary="One entry",
    parameters=(_KNOWN,),
    answers={200: Answer("the entry", Entry, headers=_TAGGED), 304: _UNCHANGED},
)
PUT = Operation(
    method="PUT",
    path=f"{HERE}/{{id}}",
    tag="directory",
    summary="Renew an entry, or change it",
    more="Without a body it is renewed. What changes it needs `If-Match`.",
    parameters=(_MATCH,),
    body=Registration,
    optional=True,
    answers={200: Answer("the entry", Entry, headers=_TAGGED)},
    errors=(412, 428),
)
REMOVE = Operation(
    method="DELETE",
    path=f"{HERE}/{{id}}",
    tag="directory",
    summary="Remove an entry",
    parameters=(_MATCH,),
    answers={204: Answer("removed")},
    errors=(412,),
)
