"""What ``realm`` serves, with the shapes of what it takes and answers."""

from __future__ import annotations

from typing import Annotated, Any, TypedDict

import msgspec
from msgspec import UNSET, Meta, UnsetType

from relay_db.models import LABEL
from relay_db.queries.rights import PATTERNS
from relay_protocol.rights import Level
from relay_server.administration.limits import NAME_SENT, PATTERN_SENT
from relay_server.edges.goals import LISTING
from relay_server.openapi import Answer, Operation, Parameter, query
from relay_server.passwords import MAX_BYTES

HERE = "/api/v1/realm"

Name = Annotated[str, Meta(max_length=NAME_SENT)]
Password = Annotated[str, Meta(max_length=MAX_BYTES)]
Patterns = Annotated[list[Annotated[str, Meta(max_length=PATTERN_SENT)]], Meta(max_length=PATTERNS)]


class NewUser(msgspec.Struct, forbid_unknown_fields=True):
    """A user.

    :param password: at least 8 characters; without one only access tokens let the user in
    :param admin: an administrator of the realm
    """

    name: Name
    password: Password | UnsetType = UNSET
    admin: bool = False


class UserChange(msgspec.Struct, forbid_unknown_fields=True):
    """What is to be other than it is.

    :param password: ends the user's browser sessions, but for the one that asks
    :param disabled: shut out at once, with all rights and tokens kept for later
    """

    password: Password | UnsetType = UNSET
    disabled: bool | UnsetType = UNSET
    admin: bool | UnsetType = UNSET


class NewGroup(msgspec.Struct, forbid_unknown_fields=True):
    """A group of users."""

    name: Name


class NewRobot(msgspec.Struct, forbid_unknown_fields=True):
    """A robot.

    :param description: one line for people
    """

    name: Name
    description: Annotated[str, Meta(max_length=LABEL)] = ""


class Granted(msgspec.Struct, forbid_unknown_fields=True):
    """What somebody may do.

    :param allow: `operation:resource`, with wildcards: what is allowed beyond the level
    :param deny: the same: what is denied in spite of the rest
    """

    level: Level
    allow: Patterns = []
    deny: Patterns = []


class RealmAbout(TypedDict):
    """A realm.

    :param users: how many there are
    :param groups: how many there are
    :param robots: how many there are
    :param events_days: how long its memory keeps events; null: as long as the relay's
    """

    realm: str
    users: int
    groups: int
    robots: int
    events_days: float | None


class RealmUser(TypedDict):
    """A user.

    :param password: whether there is one
    """

    user: str
    admin: bool
    disabled: bool
    password: bool
    groups: list[str]


class RealmUsers(TypedDict):
    """A page of users.

    :param next: the name behind which there is more, or empty
    """

    users: list[RealmUser]
    next: str


class RealmGroup(TypedDict):
    """A group and the users in it."""

    group: str
    members: list[str]


class RealmGroups(TypedDict):
    """A page of groups.

    :param next: the name behind which there is more, or empty
    """

    groups: list[RealmGroup]
    next: str


class RealmRobot(TypedDict):
    """A robot.

    :param keys: how many of its keys are live; 0: it is not enrolled
    """

    robot: str
    description: str
    keys: int


class RealmRobots(TypedDict):
    """A page of robots.

    :param next: the name behind which there is more, or empty
    """

    robots: list[RealmRobot]
    next: str


class RealmNewRobot(TypedDict):
    """A robot that was added.

    :param enrolment_code: is told this once
    :param expires_in: seconds for which the code is good
    """

    robot: str
    description: str
    keys: int
    enrolment_code: str
    expires_in: float


class RealmCode(TypedDict):
    """A code with which a robot enrols.

    :param enrolment_code: is told this once
    :param expires_in: seconds for which the code is good
    """

    robot: str
    enrolment_code: str
    expires_in: float


class RealmKey(TypedDict):
    """A key of a robot.

    :param agent: what the robot said that it runs
    :param created: Unix seconds
    :param retired: Unix seconds; null while it is live
    """

    fingerprint: str
    agent: str
    created: float
    retired: float | None


class RealmKeys(TypedDict):
    """A page of keys.

    :param next: the fingerprint behind which there is more, or empty
    """

    keys: list[RealmKey]
    next: str


class RealmRight(TypedDict):
    """A right as it was given.

    :param holder: a user, or `@` and a group
    """

    holder: str
    robot: str
    level: Level
    allow: list[str]
    deny: list[str]


class RealmRights(TypedDict):
    """A page of rights.

    :param next: what goes on after these as ``after``, or empty
    """

    rights: list[RealmRight]
    next: str


class RealmToken(TypedDict):
    """A token, without what it could be used by.

    :param kind: ``access``, ``session`` or ``login``
    :param created: Unix seconds
    :param expires: Unix seconds; null: never
    :param scope: null: for all that the user may
    """

    id: str
    kind: str
    label: str
    created: float
    expires: float | None
    scope: str | None


class RealmTokens(TypedDict):
    """A page of tokens.

    :param next: the id behind which there is more, or empty
    """

    tokens: list[RealmToken]
    next: str


PAGED = tuple(each for each in LISTING if each.name != "type")
_PLACED = {"Location": "its address"}
_IN_PATH = {
    "user": "name of a user",
    "group": "name of a group",
    "robot": "name of a robot",
    "holder": "name of a user, or `@` and that of a group",
    "fingerprint": "of a key",
    "id": "what an earlier answer gave as `id`",
}


def _operation(
    method: str, path: str, summary: str, answers: dict[int, Answer], *, named: str = "", **more: Any
) -> Operation:
    """:param named: what ``{name}`` in the address is the name of"""
    inside = {"name": named} if named else {}
    inside |= {name: name for name in ("user", "holder", "fingerprint", "id") if f"{{{name}}}" in path}
    placed = tuple(Parameter(name, _IN_PATH[what], str, "path", True) for name, what in inside.items())
    parameters = (*placed, *more.pop("parameters", ()))
    place = f"{HERE}/{path}" if path else HERE
    return Operation(
        method=method,
        path=place,
        tag="realm",
        summary=summary,
        parameters=parameters,
        answers=answers,
        **more,
    )


def _page(path: str, summary: str, page: Any, *others: Parameter, **more: Any) -> Operation:
    return _operation(
        "GET", path, summary, {200: Answer("a page", page)}, parameters=(*PAGED, *others), **more
    )


def _new(path: str, summary: str, body: Any, made: Any, **more: Any) -> Operation:
    answers = {201: Answer("added", made, headers=_PLACED)}
    return _operation("POST", path, summary, answers, body=body, errors=(409,), **more)


def _gone(path: str, summary: str, **more: Any) -> Operation:
    return _operation("DELETE", path, summary, {204: Answer("done")}, **more)


ABOUT = _operation("GET", "", "The caller's own realm", {200: Answer("the realm", RealmAbout)})

USERS = _page("users", "Users", RealmUsers)
NEW_USER = _new("users", "Add a user", NewUser, RealmUser)
USER = _operation("GET", "users/{name}", "One user", {200: Answer("the user", RealmUser)}, named="user")
CHANGE_USER = _operation(
    "PATCH",
    "users/{name}",
    "Change a user",
    {200: Answer("the user", RealmUser)},
    named="user",
    more="Nobody disables himself, or ceases to be an administrator by his own hand.",
    body=UserChange,
    errors=(409,),
)
REMOVE_USER = _gone("users/{name}", "Remove a user with rights and tokens", named="user", errors=(409,))
TOKENS = _page("users/{name}/tokens", "A user's tokens and browser sessions", RealmTokens, named="user")
REVOKE_TOKEN = _gone("tokens/{id}", "Make a token worthless, and cut what it opened")

GROUPS = _page("groups", "Groups of users", RealmGroups)
NEW_GROUP = _new("groups", "Add a group", NewGroup, RealmGroup)
GROUP = _operation("GET", "groups/{name}", "One group", {200: Answer("the group", RealmGroup)}, named="group")
REMOVE_GROUP = _gone("groups/{name}", "Remove a group with its rights", named="group")
JOIN = _operation(
    "PUT",
    "groups/{name}/members/{user}",
    "Put a user into a group",
    {204: Answer("the user is in it")},
    named="group",
    errors=(409,),
)
LEAVE = _gone("groups/{name}/members/{user}", "Take a user out of a group", named="group")

ROBOTS = _page("robots", "Robots, enrolled or not", RealmRobots)
NEW_ROBOT = _new("robots", "Add a robot", NewRobot, RealmNewRobot)
ROBOT = _operation("GET", "robots/{name}", "One robot", {200: Answer("the robot", RealmRobot)}, named="robot")
REMOVE_ROBOT = _gone(
    "robots/{name}",
    "Remove a robot with its keys, rights and recordings",
    named="robot",
    more="Its link is cut.",
)
NEW_CODE = _operation(
    "POST",
    "robots/{name}/code",
    "A new code for a robot to enrol with",
    {201: Answer("the code", RealmCode)},
    named="robot",
    more="One that was not used yet is void.",
)
KEYS = _page("robots/{name}/keys", "All keys that a robot ever had", RealmKeys, named="robot")
REVOKE_KEY = _gone(
    "robots/{name}/keys/{fingerprint}", "Retire a key, and cut a link that uses it", named="robot"
)

RIGHTS = _page(
    "rights",
    "Rights as they were given",
    RealmRights,
    query("robot", "on this robot only"),
    query("user", "of this user only, also by groups"),
    errors=(404,),
)
GRANT = _operation(
    "PUT",
    "rights/{name}/{holder}",
    "Give a right, in the place of the one the holder has on the robot",
    {
        200: Answer("in the place of another", RealmRight),
        201: Answer("given", RealmRight, headers=_PLACED),
    },
    named="robot",
    body=Granted,
    errors=(409,),
)
REVOKE = _gone(
    "rights/{name}/{holder}", "Take a right away", named="robot", more="What is open by it is cut."
)
