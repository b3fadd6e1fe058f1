"""Resources of robots, and goals, as the HTTP API answers with them."""

from __future__ import annotations

from typing import Any, Literal, NotRequired, TypedDict

GoalState = Literal["active", "cancelling", "succeeded", "canceled", "aborted", "refused"]


class TopicInfo(TypedDict):
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


class TopicPage(TypedDict):
    """A page of topics.

    :param next: ``after`` of the next page, or empty
    """

    topics: list[TopicInfo]
    next: str
    online: bool


class ServicePage(TypedDict):
    """A page of services.

    :param next: ``after`` of the next page, or empty
    """

    services: list[Provided]
    next: str
    online: bool


class ActionPage(TypedDict):
    """A page of actions.

    :param next: ``after`` of the next page, or empty
    """

    actions: list[Provided]
    next: str
    online: bool


class ParamName(TypedDict):
    """A parameter: ``<node>:<parameter>``."""

    name: str


class ParamPage(TypedDict):
    """A page of parameters.

    :param next: ``after`` of the next page, or empty
    """

    params: list[ParamName]
    next: str


class NodeInfo(TypedDict):
    """A node in the robot's graph.

    :param publishes: topics
    :param subscribes: topics
    """

    name: str
    publishes: list[str]
    subscribes: list[str]
    services: list[str]


class NodePage(TypedDict):
    """A page of nodes.

    :param next: ``after`` of the next page, or empty
    """

    nodes: list[NodeInfo]
    next: str
    online: bool


class TopicMessage(TypedDict):
    """The newest message of a topic.

    :param at: Unix seconds at which the relay received it
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
    """The answer of a service."""

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


class GoalInfo(GoalSummary):
    """A goal with its feedback and its result."""

    feedback: Any
    result: Any


class GoalPage(TypedDict):
    """A page of the caller's own goals.

    :param next: ``after`` of the next page, or empty
    """

    goals: list[GoalSummary]
    next: str
