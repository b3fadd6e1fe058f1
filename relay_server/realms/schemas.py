"""The shapes of what ``realm`` takes and answers."""

from __future__ import annotations

from typing import Annotated, TypedDict

import msgspec
from msgspec import UNSET, Meta, UnsetType

from relay_db.models import LABEL
from relay_db.queries.realms import MOST_DAYS
from relay_db.queries.rights import PATTERNS
from relay_protocol.rights import Level
from relay_server.auth.passwords import MAX_BYTES
from relay_server.realms.limits import NAME_SENT, PATTERN_SENT, SCOPE_SENT

Name = Annotated[str, Meta(max_length=NAME_SENT)]
Password = Annotated[str, Meta(max_length=MAX_BYTES)]
Line = Annotated[str, Meta(max_length=LABEL)]
Patterns = Annotated[list[Annotated[str, Meta(max_length=PATTERN_SENT)]], Meta(max_length=PATTERNS)]


class RealmChange(msgspec.Struct, forbid_unknown_fields=True):
    """What is to be other than it is.

    :param events_days: how long the realm's memory keeps events; null: as long as the relay's
    """

    events_days: Annotated[float, Meta(gt=0, le=MOST_DAYS)] | None


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
    description: Line = ""


class RobotChange(msgspec.Struct, forbid_unknown_fields=True):
    """What is to be other than it is.

    :param description: one line for people
    """

    description: Line | UnsetType = UNSET


class NewRobotGroup(msgspec.Struct, forbid_unknown_fields=True):
    """A group of robots."""

    name: Name


class NewProgram(msgspec.Struct, forbid_unknown_fields=True):
    """A program that acts as a user.

    :param label: one line for people
    :param scope: what its tokens may be used for at most; without one for all that the user may
    """

    label: Line = ""
    scope: Annotated[str, Meta(max_length=SCOPE_SENT)] | UnsetType = UNSET


class GrantBody(msgspec.Struct, forbid_unknown_fields=True):
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
    :param programs: how many all users have
    :param robot_groups: how many there are
    :param events_days: how long its memory keeps events; null: as long as the relay's
    """

    realm: str
    users: int
    groups: int
    robots: int
    programs: int
    robot_groups: int
    events_days: float | None


class RealmUser(TypedDict):
    """A user.

    :param password: whether there is one
    :param guest: whether it is that of an account elsewhere, where it is changed
    """

    user: str
    admin: bool
    disabled: bool
    password: bool
    guest: bool
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
    :param guest: whether it is another realm's, and shared with this one
    """

    robot: str
    description: str
    keys: int
    guest: bool


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
    :param robots_port: the port of the relay at which robots dial
    """

    robot: str
    description: str
    keys: int
    guest: bool
    enrolment_code: str
    expires_in: float
    robots_port: int


class RealmCode(TypedDict):
    """A code with which a robot enrols.

    :param enrolment_code: is told this once
    :param expires_in: seconds for which the code is good
    :param robots_port: the port of the relay at which robots dial
    """

    robot: str
    enrolment_code: str
    expires_in: float
    robots_port: int


class RealmRobotGroup(TypedDict):
    """A group of robots and what is in it."""

    group: str
    robots: list[str]


class RealmRobotGroups(TypedDict):
    """A page of groups of robots.

    :param next: the name behind which there is more, or empty
    """

    robot_groups: list[RealmRobotGroup]
    next: str


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


class RealmProgram(TypedDict):
    """A program, without its secret.

    :param created: Unix seconds
    :param scope: null: for all that the user may
    """

    key: str
    label: str
    created: float
    scope: str | None


class RealmPrograms(TypedDict):
    """A page of programs.

    :param next: the key behind which there is more, or empty
    """

    programs: list[RealmProgram]
    next: str


class RealmNewProgram(RealmProgram):
    """A program that was added.

    :param secret: is told this once
    """

    secret: str
