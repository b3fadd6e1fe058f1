"""``switchboard stop`` and ``switchboard resume``."""

from __future__ import annotations

import json
from typing import Any

import pytest

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.clocks import now_ns
from relay_server.cli import control_socket, stop
from relay_server.cli.app import os_user


def pending(cli: Any) -> list[tuple[int, str, str]]:
    """What robots are still to be told."""
    database = Database(f"sqlite:///{cli.data}/switchboard.db")
    try:
        with database.reading() as s:
            return [(each.robot_id, each.by, each.why) for each in queries.pending_stops(s)]
    finally:
        database.close()


def test_without_a_relay_the_order_is_kept(cli: Any) -> None:
    """For the next that runs; it is in the audit log."""
    cli.ok("robot", "add", "rover")
    cli.ok("robot", "add", "mule")
    said = cli.ok("stop", "rover", "--why", "smoke")
    assert (
        said == "Robot rover can't be reached now; it will be stopped before anything else when it is back.\n"
    )
    assert pending(cli) == [(1, os_user(), "smoke")]
    assert cli.json("stop", "--all") == {
        "robots": [{"robot": "mule", "done": False}, {"robot": "rover", "done": False}]
    }
    assert len(pending(cli)) == 2
    assert [each["action"] for each in cli.json("audit", "list")][-3:] == ["robot.stopped"] * 3


def test_an_order_that_was_not_told_is_taken_back(cli: Any) -> None:
    """Once; then only the robot itself knows, which must be online for that."""
    cli.ok("robot", "add", "rover")
    cli.ok("stop", "rover")
    assert cli.ok("resume", "rover", "--why", "all clear") == "Robot rover may move again.\n"
    assert pending(cli) == []
    assert "no stop of this robot waits to be told" in cli.fails("resume", "rover", code=3)


def test_one_robot_or_all(cli: Any) -> None:
    """Neither and both are wrong usage; what does not exist is told."""
    cli.ok("robot", "add", "rover")
    assert "name a robot, or say --all" in cli("stop").stderr
    assert cli("stop").exit_code == 2
    assert cli("stop", "rover", "--all").exit_code == 2
    assert "there is no robot 'mule'" in cli.fails("stop", "mule")
    assert "there is no robot 'mule'" in cli.fails("resume", "mule")
    assert pending(cli) == []


def test_a_relay_that_runs_is_asked(live: Any, relay: Any) -> None:
    """It says what became of each; what failed makes the command fail."""
    relay.motion = (
        200,
        json.dumps(
            {
                "robots": [
                    {"robot": "a", "done": True},
                    {"robot": "b", "done": False},
                    {"robot": "c", "done": False, "reason": "the contactor does not answer\x1b[2J"},
                ]
            }
        ).encode(),
    )
    result = live("stop", "--all", "--why", "smoke")
    assert result.exit_code == 1
    first, second, third = result.stdout.splitlines()
    assert first == "Robot a is stopped."
    assert "b can't be reached now" in second
    assert "the contactor does not answer" in third
    assert "\x1b" not in third
    assert relay.ordered == [{"robot": None, "why": "smoke", "by": os_user()}]
    relay.motion = (200, b"{}")
    assert live.ok("resume", "a") == "Robot a may move again.\n"
    assert relay.asked == ["POST /stop", "POST /resume"]


def test_an_order_says_when_it_was_given(live: Any, relay: Any) -> None:
    """By the machine's clock, which the relay reads too: one that was frozen does not do later what was meant now."""
    before = now_ns()
    live.ok("resume", "rover")
    live("robot", "call", "rover", "/reset")
    assert relay.asked == ["POST /resume", "POST /fleet?realm=default"]
    first, second = relay.sent
    assert before < first < second < now_ns()


def test_what_a_relay_refuses_is_told(live: Any, relay: Any) -> None:
    """With the exit code that fits."""
    for status, code in ((404, 1), (409, 1), (412, 1), (503, 3)):
        relay.motion = (status, json.dumps({"detail": "in its own words"}).encode())
        assert live.fails("resume", "rover", code=code) == "Error: in its own words\n"
    relay.motion = (200, b"<html>")
    assert "answered something else" in live.fails("stop", "rover", code=3)


def test_help_shows_examples(cli: Any) -> None:
    """And what the exit codes mean."""
    for command in ("stop", "resume"):
        said = cli.ok(command, "--help")
        assert "Examples:" in said
        assert "Exit codes:" in said


def test_a_reason_that_is_no_text_does_not_hold_up_a_stop(live: Any, relay: Any) -> None:
    """Bytes that are no UTF-8 come to the relay as question marks, or it could not read the order."""
    relay.motion = (200, b'{"robots": [{"robot": "rover", "done": true}]}')
    assert live.ok("stop", "rover", "--why", b"sm\xffke".decode("utf-8", "surrogateescape"))
    assert [order["why"] for order in relay.ordered] == ["sm?ke"]


def test_a_stop_that_a_relay_does_not_confirm_is_kept(
    live: Any, relay: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And that is told, on each robot: nobody knows whether it stands."""
    monkeypatch.setattr(control_socket, "_SURE_SECONDS", 0.05)
    monkeypatch.setattr(control_socket, "_MOTION_SECONDS", 0.3)
    live.ok("robot", "add", "rover")
    relay.may_answer.clear()
    result = live("stop", "--all", "--why", "smoke")
    assert result.exit_code == 3
    assert "has not answered for 0.05 s. The order is kept" in result.stderr
    assert "Robot rover: not confirmed: the relay on this data folder does not answer" in result.stdout
    assert pending(live) == [(1, os_user(), "smoke")]


def test_an_answer_that_comes_late_is_told_all_the_same(
    live: Any, relay: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The order was kept meanwhile; the relay knows what to do with it."""
    monkeypatch.setattr(control_socket, "_SURE_SECONDS", 0.05)
    live.ok("robot", "add", "rover")
    relay.motion = (200, b'{"robots": [{"robot": "rover", "done": true}]}')
    relay.may_answer.clear()
    said: list[str] = []

    def tell(sentence: str) -> None:
        said.append(sentence)
        relay.may_answer.set()

    monkeypatch.setattr(stop, "say_aside", tell)
    assert live.ok("stop", "rover") == "Robot rover is stopped.\n"
    assert "The order is kept" in said[0]
    assert [robot for robot, *_ in pending(live)] == [1]


def test_a_stop_is_kept_when_the_relay_hangs_up_or_can_not_say(live: Any, relay: Any) -> None:
    """It may have died of the order, or have lost its database."""
    live.ok("robot", "add", "rover")
    for number, motion in enumerate([(0, b""), (503, b'{"detail": "in its own words"}'), (200, b"<html>")]):
        relay.motion = motion
        result = live("stop", "rover", "--why", f"the {number}")
        assert (result.exit_code, "The order is kept" in result.stdout) == (3, True), result.output
        assert pending(live) == [(1, os_user(), f"the {number}")]


def test_robots_that_the_relay_could_not_look_up_are_kept_to_be_stopped(live: Any, relay: Any) -> None:
    """Those it has told are not told again."""
    live.ok("robot", "add", "rover")
    live.ok("robot", "add", "mule")
    relay.motion = (200, b'{"robots": [{"robot": "rover", "done": true}], "missed": "it did not answer"}')
    result = live("stop", "--all")
    assert result.exit_code == 0, result.output
    assert "Not all robots are told yet: it did not answer" in result.stderr
    assert result.stdout.startswith("Robot rover is stopped.\nRobot mule can't be reached now")
    assert [robot for robot, *_ in pending(live)] == [2]
