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
    """The relay's answer."""
    names = [str(each["robot"]) for each in results] + ["more"] * ((robots or len(results)) - len(results))
    reported = [{"do": "call", "robots": names, "unmatched": list(unmatched)}, *results]
    return 200, b"".join(json.dumps(each).encode() + b"\n" for each in reported)


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
    relay.lines = lines({"robot": "rover", **OK})
    live.ok("robot", *arguments)
    (ordered,) = relay.ordered
    assert ("stop_id" in ordered) is (order["do"] == "stop")
    ordered.pop("stop_id", None)
    assert ordered == {"timeout": 10.0, **order}
    assert relay.asked == ["POST /fleet?realm=default"]


def test_robots_have_a_row(live: Any, relay: Any) -> None:
    answered = {**OK, "values": {"sum": 7}}
    relay.lines = lines({"robot": "tank", **OK, "message": "on my way"}, {"robot": "rover", **answered})
    shown = live.ok("robot", "call", "*", "/add")
    assert [line.strip().split(None, 4) for line in shown.splitlines()[2:4]] == [
        ["rover", "ok", "0.25", "s", '{"sum": 7}'],
        ["tank", "ok", "0.25", "s", "on my way"],
    ]
    assert shown.splitlines()[-1] == "Done on 2 of 2."
    reported = live.json("robot", "call", "*", "/add")
    assert (reported["whole"], reported["unmatched"], len(reported["results"])) == (True, [], 2)


def test_a_stop_that_may_have_missed_robots_is_reported(live: Any, relay: Any) -> None:
    head = {"do": "stop", "robots": ["rover"], "unmatched": [], "missed": "the database has not answered"}
    relay.lines = 200, b"\n".join(json.dumps(each).encode() for each in (head, {"robot": "rover", **OK}))
    result = live("robot", "stop", "*")
    assert result.exit_code == 1
    assert "The order may be meant for more robots: the database has not answered." in result.stdout
    assert json.loads(live("robot", "stop", "*", "--json").stdout)["missed"] == head["missed"]


def test_a_failure_on_any_robot_is_exit_code_1(live: Any, relay: Any) -> None:
    cases = [
        (lines({"robot": "rover", **OK}, {"robot": "tank", **FAILED}), "robot tank is offline"),
        (lines({"robot": "rover", **OK}, unmatched=("claener-*",)), "'claener-*' matches no robot."),
        (lines({"robot": "rover", **OK}, robots=3), "For 2 robots the result is not known"),
        ((200, lines({"robot": "rover", **OK}, robots=2)[1] + b"no json\n"), "sent an unexpected answer"),
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
        (500, [], 3, "sent an unexpected answer (HTTP 500)"),
    ],
)
def test_a_refusal_is_printed(live: Any, relay: Any, status: int, body: Any, code: int, words: str) -> None:
    relay.lines = (status, json.dumps(body).encode())
    assert words in live.fails("robot", "call", "*", "/start", code=code)


def test_invalid_json_is_refused_before_the_order(live: Any, relay: Any) -> None:
    """The error says what is wrong in it."""
    assert "ARGS is not JSON" in live.fails("robot", "call", "*", "/start", "{data: true}")
    assert "MSG is not JSON" in live.fails("robot", "publish", "*", "/mode", "dock")
    assert not relay.asked


def test_without_a_relay_nothing_is_ordered(cli: Any) -> None:
    """The exit code is 3."""
    assert "no relay runs" in cli.fails("robot", "call", "*", "/start", code=3)


def test_output_of_robots_is_escaped(live: Any, relay: Any) -> None:
    evil = "\x1b[2J[red]\u202e"
    relay.lines = lines({"robot": evil, **OK, "message": evil}, unmatched=(evil,))
    shown = live("robot", "call", "*", "/start").stdout
    assert all(line.isprintable() for line in shown.splitlines())
    assert "\\x1b[2J[red]\\u202e" in shown


def test_robots_are_put_into_groups(cli: Any) -> None:
    """The group is made if it is missing; every change is audited."""
    for name in ("cleaner-1", "cleaner-2"):
        cli.ok("robot", "add", name)
    assert cli.ok("robot", "group", "add", "Cleaners", "cleaner-2") == "Group cleaners: cleaner-2.\n"
    reported = cli.json("robot", "group", "add", "cleaners", "cleaner-1")
    assert reported == {"group": "cleaners", "robots": ["cleaner-1", "cleaner-2"]}
    assert cli.json("robot", "group", "list") == [reported]
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
