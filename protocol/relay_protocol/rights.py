"""Rights on a robot, compiled once and checked at every message.

A right is a level, with optional patterns that allow or deny more. Deny beats allow, allow beats the
level, and everything else is denied.
"""

from __future__ import annotations

import enum
import fnmatch
import re
from collections.abc import Iterable
from functools import cached_property, lru_cache
from typing import NamedTuple

from relay_protocol.errors import Invalid
from relay_protocol.wildcards import check_pattern


class Level(str, enum.Enum):
    """Levels of rights; each includes the ones before it."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    OWNER = "owner"

    def __str__(self) -> str:
        return self.value


class Operation(str, enum.Enum):
    """Operations on the resources of a robot."""

    SUBSCRIBE = "subscribe"
    VIEW = "view"
    """Watch a camera."""
    RECORD = "record"
    """Record topics and cameras on the relay, and download recordings."""
    DOWNLOAD = "download"
    """List and download files that the robot has uploaded."""
    PUBLISH = "publish"
    CONTROL = "control"
    """Hold control of the robot."""
    CALL = "call"
    PROVIDE = "provide"
    """Advertise a service or an action in the robot's graph."""
    SUPPRESS = "suppress"
    """Suppress: command a topic in place of the holder of control, for milliseconds."""
    INHIBIT = "inhibit"
    """Inhibit a topic: the robot sends nothing of it to the relay for a time."""
    RUN = "run"
    """Have a function run on the relay's workers, for this robot."""
    MANAGE = "manage"
    """Change rights on this robot."""

    def __str__(self) -> str:
        return self.value


_RANK = {Level.VIEWER: 0, Level.OPERATOR: 1, Level.OWNER: 2}

_REQUIRED = {
    Operation.SUBSCRIBE: Level.VIEWER,
    Operation.VIEW: Level.VIEWER,
    Operation.RECORD: Level.OPERATOR,
    Operation.DOWNLOAD: Level.VIEWER,
    Operation.PUBLISH: Level.OPERATOR,
    Operation.CONTROL: Level.OPERATOR,
    Operation.CALL: Level.OPERATOR,
    Operation.PROVIDE: Level.OPERATOR,
    Operation.RUN: Level.OPERATOR,
    Operation.SUPPRESS: Level.OWNER,
    Operation.INHIBIT: Level.OWNER,
    Operation.MANAGE: Level.OWNER,
}


def required_level(operation: Operation) -> Level:
    """The lowest level that includes an operation without patterns."""
    return _REQUIRED[operation]


def includes(level: Level, other: Level) -> bool:
    """Whether a level includes another."""
    return _RANK[level] >= _RANK[other]


_ALL = "*"

_ACTION_INFIX = "/_action/"
"""Part of the names of an action's topics and services (design.ros2.org, actions)."""

_ACTION_OPERATION = {Operation.PUBLISH: Operation.PROVIDE}
"""Operation required on the action for an operation on its topics and services, where they differ."""

_SERVICE_EVENT = "/_service_event"
"""Suffix of the topic that carries all requests and responses of a service (REP 2012)."""


class Grant(NamedTuple):
    """One right in the database, or one item of a token's scope.

    :param level: ``None`` when there are only patterns
    :param allow: patterns ``operation:resource``, e.g. ``call:/reset`` or ``*:/arm/*`` (shell wildcards)
    :param deny: patterns of the same form
    :param source: who has the right, for the reason: ``user ann`` or ``group lab``
    """

    level: Level | None
    allow: tuple[str, ...] = ()
    deny: tuple[str, ...] = ()
    source: str = ""


class Decision(NamedTuple):
    """Whether an operation is allowed, and the reason for the caller."""

    allowed: bool
    reason: str


def parse_level(text: str) -> Level:
    """:raises Invalid: not one of viewer, operator, owner"""
    try:
        return Level(text)
    except ValueError:
        raise Invalid(f"'{text}' is not a level; write viewer, operator or owner") from None


def parse_pattern(text: str) -> str:
    """Check one allow or deny pattern and return it normalised.

    :raises Invalid: not ``operation:resource`` with a known operation (or ``*``) and an absolute name (for ``manage``
        also the name of a module or ``processes``), or a pattern that
        :func:`relay_protocol.wildcards.check_pattern` rejects
    """
    operation, colon, resource = text.partition(":")
    if not colon or operation not in {_ALL, *(str(each) for each in Operation)}:
        known = ", ".join(str(each) for each in Operation)
        raise Invalid(f"'{text}' is not a pattern; write operation:resource with one of {known} or *")
    names_module = operation == Operation.MANAGE and resource
    if not (names_module or resource.startswith(("/", "*"))):
        raise Invalid(f"'{text}': the resource must begin with / (as in publish:/cmd_vel) or be a wildcard")
    check_pattern(resource)
    return text


class Rules:
    """All rights of one principal on one robot, compiled.

    Without grants :attr:`level` is ``None`` and every operation is denied.

    :param scope: scope of the token in use on this robot; ``None`` for all rights of its user
    """

    def __init__(self, grants: Iterable[Grant] = (), scope: Iterable[Grant] | None = None) -> None:
        self.grants = tuple(grants)
        self.scope = None if scope is None else tuple(scope)
        self._scope_rules = None if self.scope is None else Rules(self.scope)
        self._level = _highest(self.grants)
        self.level: Level | None = _effective_level(self._level, self.scope)
        self._decisions: dict[tuple[Operation, str], Decision] = {}

    # Rules exist for every robot a user has a right on, but only few of them are used.
    @cached_property
    def _allow(self) -> list[_Pattern]:
        return [_compile(text) for grant in self.grants for text in grant.allow]

    @cached_property
    def _deny(self) -> list[_Pattern]:
        return [_compile(text) for grant in self.grants for text in grant.deny]

    def __bool__(self) -> bool:
        return self.level is not None

    @property
    def key(self) -> tuple[object, ...]:
        """Equal for rules with equal decisions and reasons."""
        return (self.grants, self.scope)

    @cached_property
    def source_free_key(self) -> tuple[object, ...]:
        """Equal for rules with equal decisions, whatever the source of the rights."""
        return tuple(each and tuple(grant[:3] for grant in each) for each in (self.grants, self.scope))

    def decide(self, operation: Operation, resource: str) -> Decision:
        """Whether the operation on the resource is allowed. Decisions are cached, because names recur."""
        key = (operation, resource)
        decision = self._decisions.get(key)
        if decision is None:
            decision = self._decide(operation, resource)
            if len(self._decisions) < _MAX_DECISIONS:
                self._decisions[key] = decision
        return decision

    def may_allow(self, operation: Operation) -> bool:
        """Whether a level or a pattern allows an operation, on whatever resource; patterns that deny are not regarded.

        :param operation: not ``view``, which the right to subscribe includes too
        """
        return all(
            _may_allow(grants, operation) for grants in (self.grants, self.scope) if grants is not None
        )

    def _decide(self, operation: Operation, resource: str) -> Decision:
        decision = self._decide_by_grants(operation, resource)
        if (
            decision.allowed
            and self._scope_rules is not None
            and not self._scope_rules.decide(operation, resource).allowed
        ):
            return Decision(False, f"{operation} on {resource} is outside the scope of your token")
        return decision

    def _decide_by_grants(self, operation: Operation, resource: str) -> Decision:
        if self._level is None and not self._allow:
            return Decision(False, "you have no right on this robot")
        service = resource.removesuffix(_SERVICE_EVENT)
        if service != resource:
            # The topic shows all requests, so subscribing needs the right to call the service.
            of_service = Operation.PROVIDE if operation is Operation.PUBLISH else Operation.CALL
            whole = self._decide_by_grants(of_service, service)
            if not whole.allowed:
                return whole
        action, part, _ = resource.partition(_ACTION_INFIX)
        if part:
            whole = self._decide_by_grants(_ACTION_OPERATION.get(operation, operation), action)
            if not whole.allowed:
                return whole
        for pattern in self._deny:
            if pattern.matches(operation, resource):
                return Decision(False, f"{operation} on {resource} is denied to you by '{pattern.text}'")
        for pattern in self._allow:
            if pattern.matches(operation, resource):
                return Decision(True, f"allowed by '{pattern.text}'")
        if operation is Operation.VIEW:
            return self._decide_by_grants(Operation.SUBSCRIBE, resource)
        required = _REQUIRED[operation]
        if self._level is not None and _RANK[self._level] >= _RANK[required]:
            return Decision(True, f"allowed to {self._level}")
        return Decision(
            False,
            f"{operation} on {resource} needs the level {required}; you are {self._level} on this robot",
        )


_MAX_DECISIONS = 4096

_MAX_PATTERNS = 4096


def _highest(grants: tuple[Grant, ...]) -> Level | None:
    levels = [grant.level for grant in grants if grant.level is not None]
    return max(levels, key=_RANK.__getitem__, default=None)


def _may_allow(grants: tuple[Grant, ...], operation: Operation) -> bool:
    level = _highest(grants)
    return (level is not None and includes(level, _REQUIRED[operation])) or any(
        text.partition(":")[0] in (_ALL, operation.value) for grant in grants for text in grant.allow
    )


def _effective_level(own: Level | None, scope: tuple[Grant, ...] | None) -> Level | None:
    """The effective level; a scope of only patterns limits it to viewer."""
    if own is None or scope is None:
        return own
    if not scope:
        return None
    return min(own, _highest(scope) or Level.VIEWER, key=_RANK.__getitem__)


class _Pattern(NamedTuple):
    operation: str
    resource: re.Pattern[str]
    text: str

    def matches(self, operation: Operation, resource: str) -> bool:
        return self.operation in (_ALL, operation.value) and self.resource.match(resource) is not None


@lru_cache(_MAX_PATTERNS)
def _compile(text: str) -> _Pattern:
    operation, _, resource = text.partition(":")
    return _Pattern(operation, re.compile(fnmatch.translate(resource)), text)
