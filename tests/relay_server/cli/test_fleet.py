"""``switchboard robot call|publish|set`` and ``switchboard robot group``."""

from __future__ import annotations

import json
from typing import Any

import pytest

OK = {"ok": True, "message": "", "values": None, "pending": False, "seconds": 0.25}
FAILED = {**OK, "ok": False, "message": "robot tank is offline"}


def lines(
    *results: dict[str, Any], robots: int | None = None, unmatched: tuple[str, ...] = ()
) -> tuple[int, bytes]:
    """What the relay answers."""
    names = [str(each["robot"]) for each in results] + ["more"] * ((robots or len(results)) - len(results))
    told = [{"do": "call", "robots": names, "unmatched": list(unmatched)}, *results]
    return 200, b"".join(json.dumps(each).encode() + b"\n" for each in told)


@pytest.mark.parametrize(
    ("arguments", "order"),
    [
        (
            ("call", "cleaner-*", "/start"),
            {"robots": ["cleaner-*"], "do": "call", "service": "/start", "args": {}},
        ),
        (
            (
                "call",
                "a, group:b",
                "/set",
                '{"data": true}',
                "--type",
                "std_srvs/srv/SetBool",
                "--timeout",
                "3",
            ),
            {
                "robots": ["a", "group:b"],
                "do": "call",
                "service": "/set",
                "args": {"data": True},
                "type": "std_srvs/srv/SetBool",
                "timeout": 3.0,
            },
        ),
        (
            ("publish", "*", "/mode", '{"data": "dock"}'),
            {"robots": ["*"], "do": "publish", "topic": "/mode", "msg": {"data": "dock"}},
        ),
        (("stop", "a", "--why", "wet floor"), {"robots": ["a"], "do": "stop", "why": "wet floor"}),
        (("resume", "group:b"), {"robots": ["group:b"], "do": "resume", "why": ""}),
        (("set", "*", "/a:speed", "0.5"), {"robots": ["*"], "do": "set", "name": "/a:speed", "value": 0.5}),
        (
            ("set", "*", "/a:name", "rover"),
            {"robots": ["*"], "do": "set", "name": "/a:name", "value": "rover"},
        ),
        (("set", "*", "/a:name", ""), {"robots": ["*"], "do": "set", "name": "/a:name", "value": ""}),
    ],
)
def test_an_order_goes_to_the_relay(
    live: Any, relay: Any, arguments: tuple[str, ...], order: dict[str, Any]
) -> None:
    """As it was written."""
    relay.lines = lines({"robot": "rover", **OK})
    live.ok("robot", *arguments)
    assert relay.ordered == [{"timeout": 10.0, **order}]
    assert relay.asked == ["POST /fleet?realm=default"]


def test_each_robot_is_told_of(live: Any, relay: Any) -> None:
    """What it answered, or why it failed; programs get the relay's words."""
    answered = {**OK, "values": {"sum": 7}}
    relay.lines = lines({"robot": "tank", **OK, "message": "on my way"}, {"robot": "rover", **answered})
    shown = live.ok("robot", "call", "*", "/add")
    assert [line.strip().split(None, 4) for line in shown.splitlines()[2:4]] == [
        ["rover", "ok", "0.25", "s", '{"sum": 7}'],
        ["tank", "ok", "0.25", "s", "on my way"],
    ]
    assert shown.splitlines()[-1] == "Done on 2 of 2."
    told = live.json("robot", "call", "*", "/add")
    assert (told["whole"], told["unmatched"], len(told["results"])) == (True, [], 2)


def test_a_stop_that_may_have_missed_robots_says_so(live: Any, relay: Any) -> None:
    """And fails, as one that failed on a robot."""
    head = {"do": "stop", "robots": ["rover"], "unmatched": [], "missed": "the database has not answered"}
    relay.lines = 200, b"\n".join(json.dumps(each).encode() for each in (head, {"robot": "rover", **OK}))
    result = live("robot", "stop", "*")
    assert result.exit_code == 1
    assert "There may be more robots that are meant: the database has not answered." in result.stdout
    assert json.loads(live("robot", "stop", "*", "--json").stdout)["missed"] == head["missed"]


def test_what_failed_anywhere_is_exit_code_1(live: Any, relay: Any) -> None:
    """And so is a pattern that means nothing, and an answer that is not whole."""
    cases = [
        (lines({"robot": "rover", **OK}, {"robot": "tank", **FAILED}), "robot tank is offline"),
        (lines({"robot": "rover", **OK}, unmatched=("claener-*",)), "No robot is meant by 'claener-*'."),
        (lines({"robot": "rover", **OK}, robots=3), "Of 2 nothing is known"),
        ((200, lines({"robot": "rover", **OK}, robots=2)[1] + b"no json\n"), "answered something else"),
    ]
    for answer, words in cases:
        relay.lines = answer
        result = live("robot", "call", "*", "/start")
        assert result.exit_code == 1
        assert words in " ".join(result.stdout.split())
        assert json.loads(live("robot", "call", "*", "/start", "--json").stdout)["results"]


@pytest.mark.parametrize(
    ("status", "body", "code", "words"),
    [
        (404, {"detail": "the order means no robot"}, 1, "the order means no robot"),
        (400, {"detail": "'call' needs 'service'"}, 1, "'call' needs 'service'"),
        (503, {"detail": "too many orders"}, 3, "too many orders"),
        (500, [], 3, "answered something else (HTTP 500)"),
    ],
)
def test_a_refusal_is_told(live: Any, relay: Any, status: int, body: Any, code: int, words: str) -> None:
    """In the relay's words."""
    relay.lines = (status, json.dumps(body).encode())
    assert words in live.fails("robot", "call", "*", "/start", code=code)


def test_what_is_no_json_is_told_before_anything_is_ordered(live: Any, relay: Any) -> None:
    """With what is wrong in it."""
    assert "ARGS is no JSON" in live.fails("robot", "call", "*", "/start", "{data: true}")
    assert "MSG is no JSON" in live.fails("robot", "publish", "*", "/mode", "dock")
    assert not relay.asked


def test_without_a_relay_nothing_is_ordered(cli: Any) -> None:
    """Exit code 3."""
    assert "no relay runs" in cli.fails("robot", "call", "*", "/start", code=3)


def test_what_robots_say_is_inert(live: Any, relay: Any) -> None:
    """Escapes are shown, not obeyed."""
    evil = "\x1b[2J[red]\u202e"
    relay.lines = lines({"robot": evil, **OK, "message": evil}, unmatched=(evil,))
    shown = live("robot", "call", "*", "/start").stdout
    assert all(line.isprintable() for line in shown.splitlines())
    assert "\\x1b[2J[red]\\u202e" in shown


def test_robots_are_put_into_groups(cli: Any) -> None:
    """The group is made when there is none; every change is in the audit log."""
    for name in ("cleaner-1", "cleaner-2"):
        cli.ok("robot", "add", name)
    assert cli.ok("robot", "group", "add", "Cleaners", "cleaner-2") == "Group cleaners: cleaner-2.\n"
    told = cli.json("robot", "group", "add", "cleaners", "cleaner-1")
    assert told == {"group": "cleaners", "robots": ["cleaner-1", "cleaner-2"]}
    assert cli.json("robot", "group", "list") == [told]
    assert "cleaner-1, cleaner-2" in cli.ok("robot", "group", "list")
    assert cli.ok("robot", "group", "remove", "cleaners", "cleaner-1") == "Group cleaners: cleaner-2.\n"
    assert "is not in group" in cli.fails("robot", "group", "remove", "cleaners", "cleaner-1")
    assert "no robot 'tank'" in cli.fails("robot", "group", "add", "cleaners", "tank")
    assert "no group of robots 'mine'" in cli.fails("robot", "group", "remove", "mine", "--yes")
    assert cli("robot", "group", "remove", "cleaners", stdin="n\n").exit_code == 1
    assert cli.json("robot", "group", "remove", "cleaners", "--yes") == {"group": "cleaners", "removed": True}
    assert cli.json("robot", "group", "list") == []
    actions = [each["action"] for each in cli.json("audit", "list")]
    assert actions.count("robot.group.add") == actions.count("robot.group.remove") == 2
