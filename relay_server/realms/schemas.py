"""Limits of administration, and its requests and answers as the HTTP API has them."""

from __future__ import annotations

from typing import Annotated, Literal, TypedDict

import msgspec
from msgspec import UNSET, Meta, UnsetType

from relay_db.models import LABEL
from relay_db.queries.realms import MAX_EVENT_DAYS
from relay_db.queries.rights import PATTERNS
from relay_protocol.rights import Level
from relay_server.auth.passwords import MAX_BYTES

CHANGES_PER_SECOND = 2.0
CHANGES_BURST = 200
"""Changes of one realm: per second in the long run, and at once. After each the relay reads the database."""

PATTERNS_PER_CHANGE = 8
"""This many patterns of a right count as one more change, since they are compiled for every connection."""

PASSWORDS_AT_ONCE = 16
"""New passwords that are hashed or wait for it. Logins wait in the same queue."""

REALMS = 1000
"""Realms whose changes are counted; those that were quiet longest are forgotten first."""

MAX_NAME = 255
"""Longest name in a request, in characters; its normal form is shorter."""

MAX_PATTERN = 255
"""Longest pattern in a request, in characters."""

MAX_SCOPE = 4096
"""Longest scope of an OAuth client in a request, in characters."""

MAX_COUNTS = {
    "users": 5000,
    "groups": 1000,
    "robots": 1000,
    "memberships": 20_000,
    "rights": 20_000,
    "oauth_clients": 5000,
    "robot_groups": 1000,
    "robot_memberships": 20_000,
}
"""The most a realm may have over HTTP; the command line has no such limit."""

MAX_PATTERNS = 2000
MAX_PATTERNS_OF_A_ROBOT = 256
"""Most patterns of all rights in a realm, and of those on one robot, likewise."""

Name = Annotated[str, Meta(max_length=MAX_NAME)]
Password = Annotated[str, Meta(max_length=MAX_BYTES)]
Line = Annotated[str, Meta(max_length=LABEL)]
Patterns = Annotated[list[Annotated[str, Meta(max_length=MAX_PATTERN)]], Meta(max_length=PATTERNS)]


class RealmChange(msgspec.Struct, forbid_unknown_fields=True):
    """A change of the realm.

    :param events_days: days for which events are stored; null: the relay's setting
    """

    events_days: Annotated[float, Meta(gt=0, le=MAX_EVENT_DAYS)] | None


class NewUser(msgspec.Struct, forbid_unknown_fields=True):
    """A new user.

    :param password: at least 8 characters; without one the user can log in by access tokens only
    :param admin: an administrator of the realm
    """

    name: Name
    password: Password | UnsetType = UNSET
    admin: bool = False


class UserChange(msgspec.Struct, forbid_unknown_fields=True):
    """A change of a user. Omitted fields stay as they are.

    :param password: a new password; the user's other browser sessions end
    :param disabled: the user is shut out at once; rights and tokens are kept
    """

    password: Password | UnsetType = UNSET
    disabled: bool | UnsetType = UNSET
    admin: bool | UnsetType = UNSET


class NewGroup(msgspec.Struct, forbid_unknown_fields=True):
    """A new group of users."""

    name: Name


class NewRobot(msgspec.Struct, forbid_unknown_fields=True):
    """A new robot.

    :param description: one line for people
    """

    name: Name
    description: Line = ""


class RobotChange(msgspec.Struct, forbid_unknown_fields=True):
    """A change of a robot. Omitted fields stay as they are.

    :param description: one line for people
    """

    description: Line | UnsetType = UNSET


class NewRobotGroup(msgspec.Struct, forbid_unknown_fields=True):
    """A new group of robots."""

    name: Name


class NewOAuthClient(msgspec.Struct, forbid_unknown_fields=True):
    """A new OAuth client that acts as a user.

    :param label: one line for people
    :param scope: limits its tokens; without one they have all rights of the user
    """

    label: Line = ""
    scope: Annotated[str, Meta(max_length=MAX_SCOPE)] | UnsetType = UNSET


class GrantBody(msgspec.Struct, forbid_unknown_fields=True):
    """A right on a robot.

    :param allow: patterns `operation:resource`, with wildcards, that are allowed beyond the level
    :param deny: patterns that are denied, whatever else allows them
    """

    level: Level
    allow: Patterns = []
    deny: Patterns = []


class RealmAbout(TypedDict):
    """A realm.

    :param users: number of users
    :param groups: number of groups of users
    :param robots: number of robots
    :param oauth_clients: number of OAuth clients of all users
    :param robot_groups: number of groups of robots
    :param events_days: days for which events are stored; null: the relay's setting
    """

    realm: str
    users: int
    groups: int
    robots: int
    oauth_clients: int
    robot_groups: int
    events_days: float | None


class RealmUser(TypedDict):
    """A user.

    :param password: whether the user has a password
    :param guest: whether this is a linked account: its password belongs to an account in another realm
    """

    user: str
    admin: bool
    disabled: bool
    password: bool
    guest: bool
    groups: list[str]


class RealmUsers(TypedDict):
    """A page of users.

    :param next: ``after`` of the next page, empty on the last one
    """

    users: list[RealmUser]
    next: str


class RealmGroup(TypedDict):
    """A group and the users in it."""

    group: str
    members: list[str]


class RealmGroups(TypedDict):
    """A page of groups.

    :param next: ``after`` of the next page, empty on the last one
    """

    groups: list[RealmGroup]
    next: str


class RealmRobot(TypedDict):
    """A robot.

    :param keys: number of valid keys; 0: it is not enrolled
    :param guest: whether it belongs to another realm and is shared with this one
    """

    robot: str
    description: str
    keys: int
    guest: bool


class RealmRobots(TypedDict):
    """A page of robots.

    :param next: ``after`` of the next page, empty on the last one
    """

    robots: list[RealmRobot]
    next: str


class RealmNewRobot(TypedDict):
    """A robot that was added.

    :param enrolment_code: shown only in this answer
    :param expires_in: seconds for which the code is valid
    :param robots_port: the port of the relay that robots dial
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

    :param enrolment_code: shown only in this answer
    :param expires_in: seconds for which the code is valid
    :param robots_port: the port of the relay that robots dial
    """

    robot: str
    enrolment_code: str
    expires_in: float
    robots_port: int


class RealmRobotGroup(TypedDict):
    """A group of robots with its members."""

    group: str
    robots: list[str]


class RealmRobotGroups(TypedDict):
    """A page of groups of robots.

    :param next: ``after`` of the next page, empty on the last one
    """

    robot_groups: list[RealmRobotGroup]
    next: str


class RealmKey(TypedDict):
    """A key of a robot.

    :param agent: software that the robot reported
    :param created: Unix seconds
    :param retired: Unix seconds; null while it is valid
    """

    fingerprint: str
    agent: str
    created: float
    retired: float | None


class RealmKeys(TypedDict):
    """A page of keys.

    :param next: ``after`` of the next page, empty on the last one
    """

    keys: list[RealmKey]
    next: str


class RealmRight(TypedDict):
    """A right as it was granted.

    :param holder: a user, or `@` and a group
    """

    holder: str
    robot: str
    level: Level
    allow: list[str]
    deny: list[str]


class RealmRights(TypedDict):
    """A page of rights.

    :param next: ``after`` of the next page, empty on the last one
    """

    rights: list[RealmRight]
    next: str


class RealmToken(TypedDict):
    """A token, without the secret itself.

    :param created: Unix seconds
    :param expires: Unix seconds; null: never
    :param scope: null: all rights of the user
    """

    id: str
    kind: Literal["access", "session", "login", "foxglove"]
    label: str
    created: float
    expires: float | None
    scope: str | None


class RealmTokens(TypedDict):
    """A page of tokens.

    :param next: ``after`` of the next page, empty on the last one
    """

    tokens: list[RealmToken]
    next: str


class RealmOAuthClient(TypedDict):
    """An OAuth client, without its secret.

    :param created: Unix seconds
    :param scope: null: all rights of the user
    """

    key: str
    label: str
    created: float
    scope: str | None


class RealmOAuthClients(TypedDict):
    """A page of OAuth clients.

    :param next: ``after`` of the next page, empty on the last one
    """

    oauth_clients: list[RealmOAuthClient]
    next: str


class RealmNewOAuthClient(RealmOAuthClient):
    """An OAuth client that was added.

    :param secret: shown only in this answer
    """

    secret: str
