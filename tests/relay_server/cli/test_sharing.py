"""Robots and users of several realms on the command line."""

from __future__ import annotations

from typing import Any

import pytest

from tests.relay_server.cli.conftest import PASSWORD


@pytest.fixture
def labs(cli: Any) -> Any:
    """lab1 with a robot ``mobile`` and a user ``toad``, and lab2 with a user ``ann``."""
    for realm in ("lab1", "lab2"):
        cli.ok("realm", "add", realm)
    cli.ok("robot", "add", "mobile@lab1")
    cli.user("toad@lab1")
    cli.user("ann@lab2")
    return cli


def test_a_robot_is_shared_and_taken_out_again(labs: Any) -> None:
    """Rights may name it either way; each step is audited."""
    assert labs.json("robot", "share", "mobile@lab1", "Lab2") == {
        "robot": "mobile@lab1",
        "realm": "lab2",
        "shared": True,
    }
    for name in ("mobile@lab1", "mobile@lab2"):
        assert labs.json("right", "grant", "ann@lab2", name, "viewer")["robot"] == "mobile@lab1"
    (right,) = labs.json("right", "list")
    assert (right["holder"], right["robot"]) == ("ann@lab2", "mobile@lab1")
    (listed,) = labs.json("robot", "list", "--realm", "lab2")
    assert (listed["robot"], listed["shared"]) == ("mobile@lab1", ["lab2"])
    assert [each["robots"] for each in labs.json("realm", "list")] == [0, 1, 1]
    assert "no longer belongs to the realm lab2" in labs.ok(
        "robot", "unshare", "mobile@lab1", "lab2", "--yes"
    )
    assert labs.json("right", "list") == []
    done = [
        (each["action"], each["target"], each["data"].get("realm")) for each in labs.json("audit", "list")
    ]
    assert ("robot.share", "mobile@lab1", "lab2") in done
    assert ("robot.unshare", "mobile@lab1", "lab2") in done


def test_a_shared_robot_is_removed_by_its_own_name(labs: Any) -> None:
    labs.ok("robot", "share", "mobile@lab1", "lab2")
    assert "robot unshare" in labs.fails("robot", "remove", "mobile@lab2", "--yes")
    labs.ok("robot", "remove", "mobile@LAB1", "--yes")
    assert labs.json("robot", "list") == []


def test_sharing_has_clear_errors(labs: Any) -> None:
    """These are an unknown realm, a name in use, and a robot that is not shared."""
    assert "realm list" in labs.fails("robot", "share", "mobile@lab1", "lab3")
    assert "not belong to the realm" in labs.fails("robot", "unshare", "mobile@lab1", "lab2", "--yes")
    labs.ok("robot", "add", "mobile@lab2")
    assert "another robot" in labs.fails("robot", "share", "mobile@lab1", "lab2")


def test_a_user_joins_another_realm_with_one_password(labs: Any) -> None:
    """It is the password of the first account and changed there; the joined account is removed like any
    other.
    """
    joined = labs.json("user", "join", "toad@lab1", "lab2")
    assert (joined["user"], joined["guest_of"], joined["password"]) == ("toad@lab2", "toad@lab1", True)
    assert "that of toad@lab1" in labs.ok("user", "list", "--realm", "lab2")
    said = labs.fails("user", "passwd", "toad@lab2", "--password-stdin", stdin=f"{PASSWORD}2\n")
    assert "is that of toad@lab1" in said
    assert "already" in labs.fails("user", "join", "toad@lab1", "lab2")
    labs.ok("user", "remove", "toad@lab2", "--yes")
    assert [each["user"] for each in labs.json("user", "list")] == ["toad@lab1", "ann@lab2"]


def test_a_robot_gets_a_new_description(labs: Any) -> None:
    """It is one line, shown in the list, and audited."""
    assert "on the bench" in labs.ok("robot", "describe", "mobile@lab1", "on the bench")
    (listed,) = labs.json("robot", "list")
    assert listed["description"] == "on the bench"
    assert "one printable line" in labs.fails("robot", "describe", "mobile@lab1", "two\nlines")
    assert [each["target"] for each in labs.json("audit", "list") if each["action"] == "robot.describe"] == [
        "mobile@lab1"
    ]
