"""What ``realm`` serves."""

from __future__ import annotations

from typing import Any

from relay_server.edges.asked import KNOWN, UNTYPED
from relay_server.edges.realm_shapes import (
    Granted,
    NewGroup,
    NewProgram,
    NewRobot,
    NewRobotGroup,
    NewUser,
    RealmAbout,
    RealmChange,
    RealmCode,
    RealmGroup,
    RealmGroups,
    RealmKeys,
    RealmNewProgram,
    RealmNewRobot,
    RealmPrograms,
    RealmRight,
    RealmRights,
    RealmRobot,
    RealmRobotGroup,
    RealmRobotGroups,
    RealmRobots,
    RealmTokens,
    RealmUser,
    RealmUsers,
    RobotChange,
    UserChange,
)
from relay_server.edges.tagged import TAGGED, answers
from relay_server.openapi import Answer, Operation, Parameter, header, query

HERE = "/api/v1/realm"

PAGED = UNTYPED
_MATCH = header("If-Match", "entity tags: only if it is one of these; `*`: only if it is there")
_NONE = header("If-None-Match", "`*`: only if it is not there")
_PLACED = {"Location": "its address"}
_IN_PATH = {
    "user": "name of a user",
    "group": "name of a group",
    "robot": "name of a robot",
    "holder": "name of a user, or `@` and that of a group",
    "fingerprint": "of a key",
    "member": "name of a robot",
    "key": "of a program",
    "id": "what an earlier answer gave as `id`",
}


def _operation(
    method: str, path: str, summary: str, answers: dict[int, Answer], *, named: str = "", **more: Any
) -> Operation:
    """:param named: what ``{name}`` in the address is the name of"""
    inside = {"name": named} if named else {}
    inside |= {
        name: name
        for name in ("user", "member", "holder", "fingerprint", "key", "id")
        if f"{{{name}}}" in path
    }
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
    return _told(path, summary, "a page", page, parameters=(*PAGED, *others), **more)


def _told(path: str, summary: str, words: str, body: Any, **more: Any) -> Operation:
    """What is read, with an entity tag."""
    parameters = (*more.pop("parameters", ()), KNOWN)
    return _operation("GET", path, summary, answers(words, body), parameters=parameters, **more)


def _new(path: str, summary: str, body: Any, made: Any, **more: Any) -> Operation:
    answers = {201: Answer("added", made, headers=_PLACED)}
    return _operation("POST", path, summary, answers, body=body, errors=(409,), **more)


def _gone(path: str, summary: str, **more: Any) -> Operation:
    return _operation("DELETE", path, summary, {204: Answer("done")}, **more)


def _joined(path: str, what: str) -> Operation:
    answers = {204: Answer(f"the {what} is in it")}
    return _operation("PUT", path, f"Put a {what} into a group", answers, named="group", errors=(409,))


ABOUT = _told("", "The caller's own realm", "the realm", RealmAbout)
CHANGE = _operation(
    "PATCH",
    "",
    "Say how long the realm's memory keeps events",
    {200: Answer("the realm", RealmAbout, headers=TAGGED)},
    more="Takes a token without a scope. The relay goes by it within ten minutes.",
    body=RealmChange,
    parameters=(_MATCH,),
    errors=(412,),
)

USERS = _page("users", "Users", RealmUsers)
NEW_USER = _new("users", "Add a user", NewUser, RealmUser)
USER = _told("users/{name}", "One user", "the user", RealmUser, named="user")
CHANGE_USER = _operation(
    "PATCH",
    "users/{name}",
    "Change a user",
    {200: Answer("the user", RealmUser, headers=TAGGED)},
    named="user",
    more="Nobody disables himself, or ceases to be an administrator by his own hand.",
    parameters=(_MATCH,),
    body=UserChange,
    errors=(409, 412),
)
REMOVE_USER = _gone("users/{name}", "Remove a user with rights and tokens", named="user", errors=(409,))
TOKENS = _page("users/{name}/tokens", "A user's tokens and browser sessions", RealmTokens, named="user")
REVOKE_TOKEN = _gone("tokens/{id}", "Make a token worthless, and cut what it opened")

PROGRAMS = _page("users/{name}/programs", "A user's programs, which act as him", RealmPrograms, named="user")
NEW_PROGRAM = _new(
    "users/{name}/programs",
    "Add a program that acts as a user",
    NewProgram,
    RealmNewProgram,
    named="user",
    more="It gets tokens by its key and its secret, which is told this once.",
)
REVOKE_PROGRAM = _gone("programs/{key}", "Make a program worthless with its tokens, and cut what they opened")

GROUPS = _page("groups", "Groups of users", RealmGroups)
NEW_GROUP = _new("groups", "Add a group", NewGroup, RealmGroup)
GROUP = _told("groups/{name}", "One group", "the group", RealmGroup, named="group")
REMOVE_GROUP = _gone("groups/{name}", "Remove a group with its rights", named="group")
JOIN = _joined("groups/{name}/members/{user}", "user")
LEAVE = _gone("groups/{name}/members/{user}", "Take a user out of a group", named="group")

ROBOTS = _page("robots", "Robots, enrolled or not", RealmRobots)
NEW_ROBOT = _new("robots", "Add a robot", NewRobot, RealmNewRobot)
ROBOT = _told("robots/{name}", "One robot", "the robot", RealmRobot, named="robot")
CHANGE_ROBOT = _operation(
    "PATCH",
    "robots/{name}",
    "Change a robot's description",
    {200: Answer("the robot", RealmRobot, headers=TAGGED)},
    named="robot",
    parameters=(_MATCH,),
    body=RobotChange,
    errors=(412,),
)
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

ROBOT_GROUPS = _page("robot-groups", "Groups of robots", RealmRobotGroups)
NEW_ROBOT_GROUP = _new("robot-groups", "Add a group of robots", NewRobotGroup, RealmRobotGroup)
ROBOT_GROUP = _told("robot-groups/{name}", "One group of robots", "the group", RealmRobotGroup, named="group")
REMOVE_ROBOT_GROUP = _gone("robot-groups/{name}", "Remove a group; its robots stay", named="group")
JOIN_ROBOT = _joined("robot-groups/{name}/members/{member}", "robot")
LEAVE_ROBOT = _gone("robot-groups/{name}/members/{member}", "Take a robot out of a group", named="group")

RIGHTS = _page(
    "rights",
    "Rights as they were given",
    RealmRights,
    query("robot", "on this robot only"),
    query("user", "of this user only, also by groups"),
    errors=(404,),
)
RIGHT = _told("rights/{name}/{holder}", "One right", "the right", RealmRight, named="robot")
GRANT = _operation(
    "PUT",
    "rights/{name}/{holder}",
    "Give a right, in the place of the one the holder has on the robot",
    {
        200: Answer("in the place of another", RealmRight, headers=TAGGED),
        201: Answer("given", RealmRight, headers={**_PLACED, **TAGGED}),
    },
    named="robot",
    parameters=(_MATCH, _NONE),
    body=Granted,
    errors=(409, 412),
)
REVOKE = _gone(
    "rights/{name}/{holder}", "Take a right away", named="robot", more="What is open by it is cut."
)
