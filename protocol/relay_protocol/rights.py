"""Rights on a robot, compiled once and asked at every message.

A right is a level, with optional patterns that allow or deny more. Deny beats allow, allow beats the
level, and what nothing allows is denied.
"""

from __future__ import annotations

import enum
import fnmatch
import re
from collections.abc import Iterable
from functools import cached_property, lru_cache
from typing import NamedTuple

from relay_protocol.errors import Invalid
from relay_protocol.wildcards import see_cheap


class Level(str, enum.Enum):
    """How far a right goes; each level includes the ones before it."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    OWNER = "owner"

    def __str__(self) -> str:
        return self.value


class Operation(str, enum.Enum):
    """What one may do to a resource of a robot."""

    SUBSCRIBE = "subscribe"
    VIEW = "view"
    """See the pictures of a camera."""
    RECORD = "record"
    """Have the relay keep what a topic or camera says, and get at what was kept."""
    PUBLISH = "publish"
    CONTROL = "control"
    """Be the one who moves the robot."""
    CALL = "call"
    PROVIDE = "provide"
    """Offer a service or an action to the robot's graph."""
    SUPPRESS = "suppress"
    """Command a topic in the place of who holds control, for moments."""
    INHIBIT = "inhibit"
    """Have a topic say nothing, for a time."""
    MANAGE = "manage"
    """Change who may do what on this robot."""

    def __str__(self) -> str:
        return self.value


_RANK = {Level.VIEWER: 0, Level.OPERATOR: 1, Level.OWNER: 2}

_NEEDED = {
    Operation.SUBSCRIBE: Level.VIEWER,
    Operation.VIEW: Level.VIEWER,
    Operation.RECORD: Level.OPERATOR,
    Operation.PUBLISH: Level.OPERATOR,
    Operation.CONTROL: Level.OPERATOR,
    Operation.CALL: Level.OPERATOR,
    Operation.PROVIDE: Level.OPERATOR,
    Operation.SUPPRESS: Level.OWNER,
    Operation.INHIBIT: Level.OWNER,
    Operation.MANAGE: Level.OWNER,
}


def needed(operation: Operation) -> Level:
    """The least level that includes an operation without patterns."""
    return _NEEDED[operation]


def includes(level: Level, other: Level) -> bool:
    """Whether a level goes as far as another."""
    return _RANK[level] >= _RANK[other]


_ALL = "*"

_PARTS = "/_action/"
"""In the names of the topics and services that an action is made of (ROS 2 design, actions)."""

_OF_ACTION = {Operation.PUBLISH: Operation.PROVIDE}
"""What one needs for the action to do something to its parts, where that is not the same."""

_EVENTS = "/_service_event"
"""How the name of the topic ends on which a service tells of its calls, with all that is in them (REP 2012)."""


class Grant(NamedTuple):
    """One right as it stands in the database, or as a token's scope names it.

    :param level: ``None`` where there is nothing but patterns, as in a scope
    :param allow: patterns ``operation:resource``, e.g. ``call:/reset`` or ``*:/arm/*`` (shell wildcards)
    :param deny: patterns of the same form
    :param source: whom the right was given to, for the reason: ``user ann`` or ``group lab``
    """

    level: Level | None
    allow: tuple[str, ...] = ()
    deny: tuple[str, ...] = ()
    source: str = ""


class Verdict(NamedTuple):
    """Yes or no, and why, in words for the one who asked."""

    allowed: bool
    reason: str


def parse_level(text: str) -> Level:
    """:raises Invalid: not one of viewer, operator, owner"""
    try:
        return Level(text)
    except ValueError:
        raise Invalid(f"'{text}' is no level; it is viewer, operator or owner") from None


def parse_pattern(text: str) -> str:
    """Check one allow or deny pattern and return it normalised.

    :raises Invalid: not ``operation:resource`` with a known operation (or ``*``) and an absolute name, or a pattern
        that :func:`relay_protocol.wildcards.see_cheap` refuses
    """
    operation, colon, resource = text.partition(":")
    if not colon or operation not in {_ALL, *(str(each) for each in Operation)}:
        known = ", ".join(str(each) for each in Operation)
        raise Invalid(f"'{text}' is no pattern; write operation:resource with one of {known} or *")
    if not resource.startswith(("/", "*")):
        raise Invalid(f"'{text}': the resource must begin with / (as in publish:/cmd_vel) or be a wildcard")
    see_cheap(resource)
    return text


class Rules:
    """All rights of one principal on one robot, compiled.

    No grants at all means no channel: :attr:`level` is ``None`` and every question is answered with no.

    :param scope: what the token in use may be used for on this robot; ``None`` for all that its user may
    """

    def __init__(self, grants: Iterable[Grant] = (), scope: Iterable[Grant] | None = None) -> None:
        self.grants = tuple(grants)
        self.scope = None if scope is None else tuple(scope)
        self._within = None if self.scope is None else Rules(self.scope)
        self._own = _highest(self.grants)
        self.level: Level | None = _lower(self._own, self.scope)
        self._verdicts: dict[tuple[Operation, str], Verdict] = {}

    # Rules are made of all robots that somebody has a right on, and asked about few.
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
        """Equal for rules that judge alike."""
        return (self.grants, self.scope)

    @cached_property
    def alike(self) -> tuple[object, ...]:
        """Equal for rules that judge alike, wherever the rights are from."""
        return tuple(each and tuple(grant[:3] for grant in each) for each in (self.grants, self.scope))

    def judge(self, operation: Operation, resource: str) -> Verdict:
        """May the principal do this to that resource of the robot? Answers are kept: names recur."""
        key = (operation, resource)
        verdict = self._verdicts.get(key)
        if verdict is None:
            verdict = self._decide(operation, resource)
            if len(self._verdicts) < _VERDICTS_KEPT:
                self._verdicts[key] = verdict
        return verdict

    def _decide(self, operation: Operation, resource: str) -> Verdict:
        verdict = self._decide_own(operation, resource)
        if (
            verdict.allowed
            and self._within is not None
            and not self._within.judge(operation, resource).allowed
        ):
            return Verdict(False, f"{operation} on {resource} is outside the scope of your token")
        return verdict

    def _decide_own(self, operation: Operation, resource: str) -> Verdict:
        if self._own is None and not self._allow:
            return Verdict(False, "you have no right on this robot")
        service = resource.removesuffix(_EVENTS)
        if service != resource:
            # To hear all that is asked of a service takes what it takes to ask it.
            of_service = Operation.PROVIDE if operation is Operation.PUBLISH else Operation.CALL
            whole = self._decide_own(of_service, service)
            if not whole.allowed:
                return whole
        action, part, _ = resource.partition(_PARTS)
        if part:
            whole = self._decide_own(_OF_ACTION.get(operation, operation), action)
            if not whole.allowed:
                return whole
        for pattern in self._deny:
            if pattern.matches(operation, resource):
                return Verdict(False, f"{operation} on {resource} is denied to you by '{pattern.text}'")
        for pattern in self._allow:
            if pattern.matches(operation, resource):
                return Verdict(True, f"allowed by '{pattern.text}'")
        if operation is Operation.VIEW:
            return self._decide_own(Operation.SUBSCRIBE, resource)
        needed = _NEEDED[operation]
        if self._own is not None and _RANK[self._own] >= _RANK[needed]:
            return Verdict(True, f"allowed to {self._own}")
        return Verdict(
            False, f"{operation} on {resource} needs the level {needed}; you are {self._own} on this robot"
        )


_VERDICTS_KEPT = 4096

_PATTERNS_KEPT = 4096


def _highest(grants: tuple[Grant, ...]) -> Level | None:
    levels = [grant.level for grant in grants if grant.level is not None]
    return max(levels, key=_RANK.__getitem__, default=None)


def _lower(own: Level | None, scope: tuple[Grant, ...] | None) -> Level | None:
    """The level one acts with: what a scope of mere patterns opens, it opens to a viewer."""
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


@lru_cache(_PATTERNS_KEPT)
def _compile(text: str) -> _Pattern:
    operation, _, resource = text.partition(":")
    return _Pattern(operation, re.compile(fnmatch.translate(resource)), text)
