"""Scopes of tokens."""

from __future__ import annotations

import pytest

from relay_protocol.errors import Invalid
from relay_protocol.rights import Grant, Level, Operation, Rules
from relay_protocol.scopes import ITEMS, Scope

OWNER = [Grant(Level.OWNER)]


def allowed(scope: str, operation: Operation, resource: str, robot: str = "rover") -> bool:
    """Whether an owner with a token of this scope may do this."""
    return Rules(OWNER, Scope(scope).on(robot)).decide(operation, resource).allowed


@pytest.mark.parametrize(
    ("scope", "operation", "resource", "yes"),
    [
        ("viewer", Operation.SUBSCRIBE, "/odom", True),
        ("viewer", Operation.PUBLISH, "/cmd_vel", False),
        ("operator", Operation.PUBLISH, "/cmd_vel", True),
        ("operator", Operation.SUPPRESS, "/cmd_vel", False),
        ("publish:/cmd_vel", Operation.PUBLISH, "/cmd_vel", True),
        ("publish:/cmd_vel", Operation.PUBLISH, "/lights", False),
        ("publish:/cmd_vel", Operation.SUBSCRIBE, "/odom", False),
        ("subscribe:/camera/*", Operation.VIEW, "/camera/front", True),
        ("viewer publish:/lights", Operation.PUBLISH, "/lights", True),
        ("*:/arm/*", Operation.CALL, "/arm/home", True),
        ("call:/dock@rover", Operation.CALL, "/dock", True),
        ("operator@rov*", Operation.CALL, "/dock", True),
        ("operator@arm", Operation.CALL, "/dock", False),
        ("admin", Operation.SUBSCRIBE, "/odom", False),
        ("provide:/count*", Operation.PROVIDE, "/count/_action/feedback", True),
        ("subscribe:/count", Operation.SUBSCRIBE, "/count/_action/feedback", False),
        ("subscribe:/count*", Operation.SUBSCRIBE, "/count/_action/feedback", True),
    ],
)
def test_scope_covers(scope: str, operation: Operation, resource: str, yes: bool) -> None:
    """An owner's token allows what its scope names, and nothing else."""
    assert allowed(scope, operation, resource) is yes


def test_a_scope_gives_no_right() -> None:
    """A viewer with a token for everything stays a viewer."""
    rules = Rules([Grant(Level.VIEWER, deny=("subscribe:/secret",))], Scope("owner").on("rover"))
    assert not rules.decide(Operation.PUBLISH, "/cmd_vel").allowed
    assert not rules.decide(Operation.SUBSCRIBE, "/secret").allowed
    assert rules.level is Level.VIEWER


@pytest.mark.parametrize(
    ("scope", "level"),
    [
        ("operator", Level.OPERATOR),
        ("viewer owner@other", Level.VIEWER),
        ("publish:/cmd_vel", Level.VIEWER),
        ("owner@other", None),
        ("admin", None),
    ],
)
def test_the_level_one_acts_with(scope: str, level: Level | None) -> None:
    """It is the lower of the user's and the scope's; a robot outside the scope has no right."""
    rules = Rules(OWNER, Scope(scope).on("rover"))
    assert rules.level is level
    assert bool(rules) is (level is not None)


def test_the_reason_names_the_scope() -> None:
    """The error says that the token's scope is the reason."""
    decision = Rules(OWNER, Scope("viewer").on("rover")).decide(Operation.CALL, "/dock")
    assert decision.reason == "call on /dock is outside the scope of your token"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "one item or more"),
        ("viewer  operator", "one item or more"),
        (" viewer", "one item or more"),
        ("king", "'king' is not a scope"),
        ("viewer@", "names no robot"),
        ("fly:/away", "is not a pattern"),
        ("publish:cmd_vel", "must begin with /"),
        ('viewer@"rover"', "printable ASCII"),
        ("viewer@röver", "printable ASCII"),
        ("viewer@" + "r" * 300, "printable ASCII"),
        (" ".join(f"viewer@r{n}" for n in range(ITEMS + 1)), "at most"),
    ],
)
def test_invalid_scopes(text: str, words: str) -> None:
    """The error has the reason."""
    with pytest.raises(Invalid, match=words.replace("(", r"\(")):
        Scope(text)


@pytest.mark.parametrize(
    ("narrow", "wide", "yes"),
    [
        ("operator@rover", "viewer operator@rover", True),
        ("operator", "viewer operator@rover", False),
        ("viewer", "operator", True),
        ("owner", "operator", False),
        ("viewer@rover", "operator@rov*", True),
        ("viewer@rov*", "operator@rover", False),
        ("viewer@rov*", "viewer@r*", False),
        ("publish:/cmd_vel", "operator", True),
        ("suppress:/cmd_vel", "operator", False),
        ("*:/cmd_vel", "owner", False),
        ("publish:/cmd_vel", "*:/cmd*", True),
        ("publish:/cmd_vel", "publish:/lights", False),
        ("viewer", "subscribe:*", False),
        ("admin", "owner", False),
        ("admin viewer", "admin operator", True),
        ("viewer", "admin", False),
    ],
)
def test_a_narrower_scope(narrow: str, wide: str, yes: bool) -> None:
    """A scope that may be requested in exchange for a wider one is always covered by it."""
    assert Scope(narrow).within(Scope(wide)) is yes


def test_a_repeated_item_counts_once() -> None:
    """A scope is returned as it is used."""
    assert str(Scope("viewer viewer operator@rover")) == "viewer operator@rover"


def test_rules_that_judge_alike_are_known_by_their_key() -> None:
    """Caches for a set of rights are not shared with a token of fewer rights."""
    assert Rules(OWNER).key == Rules(OWNER).key
    assert Rules(OWNER).key != Rules(OWNER, Scope("viewer").on("rover")).key
