"""Rights: levels, allow and deny."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol import rights
from relay_protocol.errors import Invalid
from relay_protocol.rights import Grant, Level, Operation, Rules, parse_level, parse_pattern

RESOURCES = ["/cmd_vel", "/arm/joint", "/arm", "/reset", "/a\nb"]
PATTERNS = [
    f"{operation}:{name}"
    for operation in ["*", *map(str, Operation)]
    for name in ["*", "/*", "/arm*", "/cmd_vel", "/[ar]*"]
]
GRANTS = st.builds(
    Grant,
    st.sampled_from(Level),
    st.lists(st.sampled_from(PATTERNS), max_size=2).map(tuple),
    st.lists(st.sampled_from(PATTERNS), max_size=2).map(tuple),
)
RANK = [Level.VIEWER, Level.OPERATOR, Level.OWNER]
LEAST = {
    Operation.SUBSCRIBE: Level.VIEWER,
    Operation.DOWNLOAD: Level.VIEWER,
    **dict.fromkeys([Operation.MANAGE, Operation.SUPPRESS, Operation.INHIBIT], Level.OWNER),
}


def hits(patterns: list[str], operation: Operation, resource: str) -> bool:
    """Whether one pattern matches this."""
    pairs = [pattern.split(":", 1) for pattern in patterns]
    return any(op in ("*", str(operation)) and fnmatchcase(resource, name) for op, name in pairs)


def expected(grants: list[Grant], operation: Operation, resource: str) -> bool:
    """The decision by the contract's sentences."""
    if not grants or hits([text for grant in grants for text in grant.deny], operation, resource):
        return False
    if hits([text for grant in grants for text in grant.allow], operation, resource):
        return True
    if operation is Operation.VIEW:
        return expected(grants, Operation.SUBSCRIBE, resource)
    highest = max(RANK.index(grant.level) for grant in grants)
    return highest >= RANK.index(LEAST.get(operation, Level.OPERATOR))


@given(st.lists(GRANTS, max_size=3), st.sampled_from(Operation), st.sampled_from(RESOURCES))
def test_deny_beats_allow_beats_level(grants: list[Grant], operation: Operation, resource: str) -> None:
    """Any set of rights gives the decision of the contract, also when repeated."""
    rules = Rules(grants)
    assert rules.decide(operation, resource).allowed is expected(grants, operation, resource)
    assert rules.decide(operation, resource) == rules.decide(operation, resource)


@given(st.lists(GRANTS, max_size=3), st.none() | st.lists(GRANTS, max_size=2), st.sampled_from(Operation))
def test_what_is_allowed_somewhere_may_be_allowed(
    grants: list[Grant], scope: list[Grant] | None, operation: Operation
) -> None:
    rules = Rules(grants, scope)
    if operation is not Operation.VIEW and any(rules.decide(operation, each).allowed for each in RESOURCES):
        assert rules.may_allow(operation)


@pytest.mark.parametrize(
    ("grant", "scope", "operation", "may"),
    [
        (Grant(Level.VIEWER, ("view:/front", "call:/reset")), None, Operation.PUBLISH, False),
        (Grant(Level.VIEWER, ("view:/front", "call:/reset")), None, Operation.CALL, True),
        (Grant(Level.VIEWER, ("*:/arm/*",)), None, Operation.PUBLISH, True),
        (Grant(Level.OWNER), [Grant(None, ("subscribe:/scan",))], Operation.PUBLISH, False),
        (Grant(Level.OWNER), [Grant(None, ("publish:/goal",))], Operation.PUBLISH, True),
        (Grant(Level.OWNER), [], Operation.SUBSCRIBE, False),
        (Grant(Level.VIEWER), [Grant(Level.OWNER)], Operation.PUBLISH, False),
        (Grant(Level.OPERATOR), None, Operation.MANAGE, False),
    ],
)
def test_rights_and_scope_must_both_allow_an_operation_somewhere(
    grant: Grant, scope: list[Grant] | None, operation: Operation, may: bool
) -> None:
    assert Rules([grant], scope).may_allow(operation) is may


@pytest.mark.parametrize(
    ("operation", "part", "deny"),
    [
        (Operation.CALL, "send_goal", "call:/arm"),
        (Operation.SUBSCRIBE, "feedback", "subscribe:/arm"),
        (Operation.SUBSCRIBE, "status", "*:/arm"),
        (Operation.PUBLISH, "feedback", "provide:/arm"),
        (Operation.PUBLISH, "status", "*:/arm"),
    ],
)
def test_the_parts_of_an_action_need_a_right_on_the_action(
    operation: Operation, part: str, deny: str
) -> None:
    """Otherwise goals, feedback and status would circumvent a denial."""
    name = f"/arm/_action/{part}"
    assert Rules([Grant(Level.OPERATOR)]).decide(operation, name).allowed
    decision = Rules([Grant(Level.OWNER, deny=(deny,))]).decide(operation, name)
    assert not decision.allowed
    assert decision.reason.endswith(f"on /arm is denied to you by '{deny}'")
    assert not Rules([Grant(Level.OPERATOR, deny=(f"*:{name}",))]).decide(operation, name).allowed


@pytest.mark.parametrize(
    ("grant", "operation", "allowed"),
    [
        (Grant(Level.OPERATOR), Operation.SUBSCRIBE, True),
        (Grant(Level.VIEWER), Operation.SUBSCRIBE, False),
        (Grant(Level.VIEWER, allow=("subscribe:/arm/*",)), Operation.SUBSCRIBE, False),
        (Grant(Level.VIEWER, allow=("call:/arm/home",)), Operation.SUBSCRIBE, True),
        (Grant(Level.OPERATOR, deny=("call:/arm/home",)), Operation.SUBSCRIBE, False),
        (Grant(Level.OPERATOR, deny=("subscribe:/arm/home/_*",)), Operation.SUBSCRIBE, False),
        (Grant(Level.OPERATOR, deny=("call:/arm/home",)), Operation.RECORD, False),
        (Grant(Level.OPERATOR, deny=("call:/arm/home",)), Operation.VIEW, False),
        (Grant(Level.OPERATOR), Operation.PUBLISH, True),
        (Grant(Level.OPERATOR, deny=("provide:/arm/home",)), Operation.PUBLISH, False),
        (Grant(None, allow=("subscribe:/arm/home",)), Operation.SUBSCRIBE, False),
        (Grant(None, allow=("subscribe:*",)), Operation.SUBSCRIBE, False),
    ],
)  # fmt: skip
def test_service_events_are_for_callers(grant: Grant, operation: Operation, allowed: bool) -> None:
    """They contain requests and responses, so a right to subscribe to all topics is not enough."""
    assert Rules([grant]).decide(operation, "/arm/home/_service_event").allowed is allowed


def test_unused_robot_has_no_channel() -> None:
    """Without any right there is no level, and the reason says so."""
    rules = Rules()
    assert not rules
    assert rules.decide(Operation.SUBSCRIBE, "/scan").reason == "you have no right on this robot"


def test_a_refusal_names_the_needed_level() -> None:
    """The error has the needed level and the caller's."""
    decision = Rules([Grant(Level.VIEWER)]).decide(Operation.PUBLISH, "/cmd_vel")
    assert decision.reason == "publish on /cmd_vel needs the level operator; you are viewer on this robot"


def test_a_denial_names_the_pattern() -> None:
    """The error names the denying pattern."""
    decision = Rules([Grant(Level.OWNER, deny=("call:/reset",))]).decide(Operation.CALL, "/reset")
    assert decision.reason == "call on /reset is denied to you by 'call:/reset'"


def test_patterns_match_whole_names_and_case() -> None:
    """A pattern matches the whole name, and names differ by case."""
    rules = Rules([Grant(Level.VIEWER, allow=("publish:/cmd",))])
    assert rules.decide(Operation.PUBLISH, "/cmd").allowed
    assert not rules.decide(Operation.PUBLISH, "/cmd_vel").allowed
    assert not rules.decide(Operation.PUBLISH, "/CMD").allowed
    assert not rules.decide(Operation.PUBLISH, "/cmd\n").allowed


def test_cached_decisions_are_bounded() -> None:
    """Decisions for new names are right, even when the cache is full."""
    rules = Rules([Grant(Level.VIEWER, deny=("*:/secret/*",))])
    for number in range(5000):
        assert rules.decide(Operation.SUBSCRIBE, f"/t{number}").allowed
    assert not rules.decide(Operation.SUBSCRIBE, "/secret/x").allowed
    assert len(rules._decisions) <= 4096


@pytest.mark.parametrize("text", ["publish:/a", "*:/a/*", "manage:*", "manage:base", "call:/a b"])
def test_good_patterns_pass(text: str) -> None:
    """A checked pattern is returned unchanged."""
    assert parse_pattern(text) == text


@pytest.mark.parametrize("text", ["", "publish", "drive:/a", "publish:a", "publish:", ":/a", "Publish:/a"])
def test_bad_patterns_are_refused(text: str) -> None:
    """Patterns that could never match, or match by mistake, are refused."""
    with pytest.raises(Invalid, match=r"is not a pattern|must begin with"):
        parse_pattern(text)


def test_levels_are_three() -> None:
    """The error for another word lists them."""
    assert [parse_level(text) for text in ("viewer", "operator", "owner")] == RANK
    with pytest.raises(Invalid, match="write viewer, operator or owner"):
        parse_level("admin")


def test_patterns_are_compiled_when_a_right_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rules are made for all robots of a list: patterns of a realm must not delay other realms."""
    compile_, compiled = rights._compile, list[str]()

    def noted(text: str) -> Any:
        compiled.append(text)
        return compile_(text)

    monkeypatch.setattr(rights, "_compile", noted)
    rules = Rules([Grant(Level.VIEWER, allow=("call:/a*",), deny=("call:/b*",))], [Grant(Level.OPERATOR)])
    assert rules and rules.level is Level.VIEWER
    assert compiled == []
    assert rules.decide(Operation.CALL, "/a1").allowed and not rules.decide(Operation.CALL, "/b1").allowed
    rules.decide(Operation.CALL, "/c")
    assert compiled == ["call:/b*", "call:/a*"]
