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
    **dict.fromkeys([Operation.MANAGE, Operation.SUPPRESS, Operation.INHIBIT], Level.OWNER),
}


def hits(patterns: list[str], operation: Operation, resource: str) -> bool:
    """Whether one pattern covers this."""
    pairs = [pattern.split(":", 1) for pattern in patterns]
    return any(op in ("*", str(operation)) and fnmatchcase(resource, name) for op, name in pairs)


def expected(grants: list[Grant], operation: Operation, resource: str) -> bool:
    """What the contract's sentences say."""
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
    """Any set of rights is judged as the sentence in the contract says, and the same when asked again."""
    rules = Rules(grants)
    assert rules.judge(operation, resource).allowed is expected(grants, operation, resource)
    assert rules.judge(operation, resource) == rules.judge(operation, resource)


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
    """Or its goals, its feedback and its status would be a way around what is denied."""
    name = f"/arm/_action/{part}"
    assert Rules([Grant(Level.OPERATOR)]).judge(operation, name).allowed
    verdict = Rules([Grant(Level.OWNER, deny=(deny,))]).judge(operation, name)
    assert not verdict.allowed
    assert verdict.reason.endswith(f"on /arm is denied to you by '{deny}'")
    assert not Rules([Grant(Level.OPERATOR, deny=(f"*:{name}",))]).judge(operation, name).allowed


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
def test_what_a_service_tells_of_its_calls_is_for_its_callers(
    grant: Grant, operation: Operation, allowed: bool
) -> None:
    """Requests and responses are in it: a right to hear all topics does not open them."""
    assert Rules([grant]).judge(operation, "/arm/home/_service_event").allowed is allowed


def test_nobody_has_no_channel() -> None:
    """Without any right there is no level, and the reason says so."""
    rules = Rules()
    assert not rules
    assert rules.judge(Operation.SUBSCRIBE, "/scan").reason == "you have no right on this robot"


def test_a_refusal_says_what_is_needed() -> None:
    """The one who asks learns which level would do and which he has."""
    verdict = Rules([Grant(Level.VIEWER)]).judge(Operation.PUBLISH, "/cmd_vel")
    assert verdict.reason == "publish on /cmd_vel needs the level operator; you are viewer on this robot"


def test_a_denial_names_the_pattern() -> None:
    """The one who asks learns which pattern stands in the way."""
    verdict = Rules([Grant(Level.OWNER, deny=("call:/reset",))]).judge(Operation.CALL, "/reset")
    assert verdict.reason == "call on /reset is denied to you by 'call:/reset'"


def test_patterns_match_whole_names_and_case() -> None:
    """A pattern is no prefix, and names differ by case."""
    rules = Rules([Grant(Level.VIEWER, allow=("publish:/cmd",))])
    assert rules.judge(Operation.PUBLISH, "/cmd").allowed
    assert not rules.judge(Operation.PUBLISH, "/cmd_vel").allowed
    assert not rules.judge(Operation.PUBLISH, "/CMD").allowed
    assert not rules.judge(Operation.PUBLISH, "/cmd\n").allowed


def test_answers_are_not_kept_without_end() -> None:
    """Ever new names are judged rightly, also when no more answers are kept."""
    rules = Rules([Grant(Level.VIEWER, deny=("*:/secret/*",))])
    for number in range(5000):
        assert rules.judge(Operation.SUBSCRIBE, f"/t{number}").allowed
    assert not rules.judge(Operation.SUBSCRIBE, "/secret/x").allowed
    assert len(rules._verdicts) <= 4096


@pytest.mark.parametrize("text", ["publish:/a", "*:/a/*", "manage:*", "call:/a b"])
def test_good_patterns_pass(text: str) -> None:
    """A checked pattern is returned as it is."""
    assert parse_pattern(text) == text


@pytest.mark.parametrize("text", ["", "publish", "drive:/a", "publish:a", "publish:", ":/a", "Publish:/a"])
def test_bad_patterns_are_refused(text: str) -> None:
    """What could never match, or would match by mistake, is refused."""
    with pytest.raises(Invalid, match=r"is no pattern|must begin with"):
        parse_pattern(text)


def test_levels_are_three() -> None:
    """Another word is refused with those that are right."""
    assert [parse_level(text) for text in ("viewer", "operator", "owner")] == RANK
    with pytest.raises(Invalid, match="it is viewer, operator or owner"):
        parse_level("admin")


def test_patterns_are_compiled_when_somebody_is_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rules are made for all robots of a list: what a realm has in patterns must not hold up the others."""
    compile_, compiled = rights._compile, list[str]()

    def noted(text: str) -> Any:
        compiled.append(text)
        return compile_(text)

    monkeypatch.setattr(rights, "_compile", noted)
    rules = Rules([Grant(Level.VIEWER, allow=("call:/a*",), deny=("call:/b*",))], [Grant(Level.OPERATOR)])
    assert rules and rules.level is Level.VIEWER
    assert compiled == []
    assert rules.judge(Operation.CALL, "/a1").allowed and not rules.judge(Operation.CALL, "/b1").allowed
    rules.judge(Operation.CALL, "/c")
    assert compiled == ["call:/b*", "call:/a*"]
