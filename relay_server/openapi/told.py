"""What the API answers about resources, goals, events, orders and tokens (SPEC sections 1.11 to 1.14)."""

from __future__ import annotations

from typing import Any, Literal, NotRequired, TypedDict

GoalState = Literal["active", "cancelling", "succeeded", "canceled", "aborted", "refused"]


class Topic(TypedDict):
    """A topic; publishers and subscribers are nodes.

    :param moves: whether it moves the robot
    """

    name: str
    types: list[str]
    publishers: NotRequired[list[str]]
    subscribers: NotRequired[list[str]]
    moves: bool


class Provided(TypedDict):
    """A service or an action; providers are nodes.

    :param moves: whether it moves the robot
    """

    name: str
    types: list[str]
    providers: NotRequired[list[str]]
    moves: bool


class Topics(TypedDict):
    """A page of topics.

    :param next: the name behind which there is more, or empty
    """

    topics: list[Topic]
    next: str
    online: bool


class Services(TypedDict):
    """A page of services.

    :param next: the name behind which there is more, or empty
    """

    services: list[Provided]
    next: str
    online: bool


class Actions(TypedDict):
    """A page of actions.

    :param next: the name behind which there is more, or empty
    """

    actions: list[Provided]
    next: str
    online: bool


class ParamName(TypedDict):
    """A parameter: ``<node>:<parameter>``."""

    name: str


class Params(TypedDict):
    """A page of parameters.

    :param next: the name behind which there is more, or empty
    """

    params: list[ParamName]
    next: str


class Module(TypedDict):
    """A node in the robot's graph.

    :param publishes: topics
    :param subscribes: topics
    """

    name: str
    publishes: list[str]
    subscribes: list[str]
    services: list[str]


class Modules(TypedDict):
    """A page of modules.

    :param next: the name behind which there is more, or empty
    """

    modules: list[Module]
    next: str
    online: bool


class TopicState(TypedDict):
    """The newest message of a topic.

    :param at: Unix seconds when the relay got it
    """

    topic: str
    type: str
    at: float
    value: Any


class ParamValue(TypedDict):
    """A parameter and its value."""

    name: str
    value: Any


class CallAnswer(TypedDict):
    """What a service answered."""

    values: Any


class GoalSummary(TypedDict):
    """A goal.

    :param reason: why it did not succeed
    :param begun: Unix seconds
    :param ended: Unix seconds
    """

    id: str
    action: str
    type: str
    state: GoalState
    reason: str | None
    begun: float
    ended: float | None


class GoalStatus(GoalSummary):
    """A goal with how far it came and what came of it."""

    feedback: Any
    result: Any


class GoalPage(TypedDict):
    """A page of the caller's own goals.

    :param next: the goal behind which there is more, or empty
    """

    goals: list[GoalSummary]
    next: str


class Event(TypedDict):
    """Something that happened (SPEC section 1.14).

    :param at: Unix seconds
    :param used: how often a query has given it
    """

    id: int
    source: str
    kind: str
    robot: str | None
    user: str | None
    at: float
    data: dict[str, Any]
    used: int


class EventPage(TypedDict):
    """Events, the newest first.

    :param next: goes into ``after`` of the next request
    """

    events: list[Event]
    next: str | None


class EventsKept(TypedDict):
    """Events as they were kept."""

    events: list[Event]


class EventCount(TypedDict):
    """How many events match.

    :param next: there may be more, to be counted by what has this as its ``after``
    """

    count: int
    next: str | None


class Group(TypedDict):
    """A group of robots, with those the caller has a right on."""

    name: str
    robots: list[str]


class Groups(TypedDict):
    """Groups of robots."""

    groups: list[Group]


class Token(TypedDict):
    """A token (RFC 6749 section 5.1).

    :param expires_in: seconds
    """

    access_token: str
    token_type: Literal["Bearer"]
    expires_in: int
    scope: NotRequired[str]
    refresh_token: NotRequired[str]


class TokenForm(TypedDict, total=False):
    """What is sent for a token."""

    grant_type: Literal["password", "client_credentials", "refresh_token"]
    username: str
    password: str
    refresh_token: str
    scope: str
    realm: str
    client_id: str
    client_secret: str


class AboutToken(TypedDict):
    """The token that is asked about; and, if they are not sent otherwise, key and secret of the program that asks."""

    token: str
    client_id: NotRequired[str]
    client_secret: NotRequired[str]


class Introspection(TypedDict):
    """What is left of a token (RFC 7662).

    :param iat: Unix seconds
    :param exp: Unix seconds
    :param expires_in: seconds
    """

    active: bool
    token_type: NotRequired[str]
    username: NotRequired[str]
    sub: NotRequired[str]
    realm: NotRequired[str]
    iat: NotRequired[int]
    scope: NotRequired[str]
    client_id: NotRequired[str]
    exp: NotRequired[int]
    expires_in: NotRequired[int]


class Nothing(TypedDict):
    """An empty object."""


class OAuthProblem(TypedDict):
    """An error in the words of RFC 6749 section 5.2, which are problem details, too."""

    type: str
    title: str
    status: int
    detail: str
    error: str
    error_description: str


class Available(TypedDict):
    """An error that names the media types there are."""

    type: str
    title: str
    status: int
    detail: str
    code: str
    available: list[str]
