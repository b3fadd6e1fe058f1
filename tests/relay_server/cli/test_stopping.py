"""``switchboard stop`` and ``switchboard resume``."""

from __future__ import annotations

import json
from typing import Any

import pytest

from relay_db import queries
from relay_db.engine import Database
from relay_protocol.clocks import now_ns
from relay_server.cli import admin_socket_client, stop
from relay_server.cli.app import os_user


def pending(cli: Any) -> list[tuple[int, str, str]]:
    """Robots with a stored stop."""
    database = Database(f"sqlite:///{cli.data}/switchboard.db")
    try:
        with database.reading() as s:
            return [(each.robot_id, each.by, each.why) for each in queries.pending_stops(s)]
    finally:
        database.close()


def test_without_a_relay_the_order_is_stored(cli: Any) -> None:
    cli.ok("robot", "add", "rover")
    cli.ok("robot", "add", "mule")
    said = cli.ok("stop", "rover", "--why", "smoke")
    assert said == "Robot rover will be stopped as soon as it can be reached.\n"
    assert pending(cli) == [(1, os_user(), "smoke")]
    assert cli.json("stop", "--all") == {
        "robots": [{"robot": "mule", "done": False}, {"robot": "rover", "done": False}]
    }
    assert len(pending(cli)) == 2
    assert [each["action"] for each in cli.json("audit", "list")][-3:] == ["robot.stopped"] * 3


def test_an_order_that_was_not_sent_is_cancelled(cli: Any) -> None:
    """After that only the robot knows of the stop, and must be online to resume."""
    cli.ok("robot", "add", "rover")
    cli.ok("stop", "rover")
    assert cli.ok("resume", "rover", "--why", "all clear") == "Robot rover may move again.\n"
    assert pending(cli) == []
    assert "no stop of this robot is waiting to be sent" in cli.fails("resume", "rover", code=3)


def test_robot_argument_or_all(cli: Any) -> None:
    cli.ok("robot", "add", "rover")
    assert "name a robot, or give --all" in cli("stop").stderr
    assert cli("stop").exit_code == 2
    assert cli("stop", "rover", "--all").exit_code == 2
    assert "there is no robot 'mule'" in cli.fails("stop", "mule")
    assert "there is no robot 'mule'" in cli.fails("resume", "mule")
    assert pending(cli) == []


def test_a_relay_that_runs_is_asked(live: Any, relay: Any) -> None:
    """It reports the result for each robot; a failure makes the command fail."""
    relay.motion = (
        200,
        json.dumps(
            {
                "robots": [
                    {"robot": "a", "done": True},
                    {"robot": "b", "done": False},
                    {"robot": "c", "done": False, "reason": "the database is locked\x1b[2J"},
                    {
                        "robot": "d",
                        "done": False,
                        "reason": "robot d is stopped, but …",
                        "stopped": {"by": "root"},
                    },
                ]
            }
        ).encode(),
    )
    result = live("stop", "--all", "--why", "smoke")
    assert result.exit_code == 1
    first, second, third, fourth = result.stdout.splitlines()
    assert first == "Robot a is stopped."
    assert "b will be stopped as soon as it can be reached" in second
    assert third.startswith("Robot c: the database is locked")
    assert fourth == "Robot d is stopped, but …"
    assert "\x1b" not in third
    (order,) = relay.ordered
    assert len(order.pop("stop_id")) == 32
    assert order == {"robot": None, "why": "smoke", "by": os_user()}
    relay.motion = (200, b"{}")
    assert live.ok("resume", "a") == "Robot a may move again.\n"
    assert relay.asked == ["POST /stop", "POST /resume"]


def test_an_order_has_its_time(live: Any, relay: Any) -> None:
    before = now_ns()
    live.ok("resume", "rover")
    live("robot", "call", "rover", "/reset")
    assert relay.asked == ["POST /resume", "POST /fleet?realm=default"]
    first, second = relay.sent
    assert before < first < second < now_ns()


def test_a_refusal_by_the_relay_is_printed(live: Any, relay: Any) -> None:
    """The exit code fits the refusal."""
    for status, code in ((404, 1), (409, 1), (412, 1), (503, 3)):
        relay.motion = (status, json.dumps({"detail": "in its own words"}).encode())
        assert live.fails("resume", "rover", code=code) == "Error: in its own words\n"
    relay.motion = (200, b"<html>")
    assert "sent an unexpected answer" in live.fails("stop", "rover", code=3)


def test_help_shows_examples(cli: Any) -> None:
    for command in ("stop", "resume"):
        said = cli.ok(command, "--help")
        assert "Examples:" in said
        assert "Exit codes:" in said


def test_a_reason_that_is_no_text_does_not_hold_up_a_stop(live: Any, relay: Any) -> None:
    """Bytes that are not UTF-8 become question marks, so that the relay can read the order."""
    relay.motion = (200, b'{"robots": [{"robot": "rover", "done": true}]}')
    assert live.ok("stop", "rover", "--why", b"sm\xffke".decode("utf-8", "surrogateescape"))
    assert [order["why"] for order in relay.ordered] == ["sm?ke"]


def test_a_stop_that_a_relay_does_not_confirm_is_stored(
    live: Any, relay: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(admin_socket_client, "_UNSURE_SECONDS", 0.05)
    monkeypatch.setattr(admin_socket_client, "_ORDER_SECONDS", 0.3)
    live.ok("robot", "add", "rover")
    relay.may_answer.clear()
    result = live("stop", "--all", "--why", "smoke")
    assert result.exit_code == 3
    assert "has not answered for 0.05 s. The order is stored" in result.stderr
    assert "Robot rover: not confirmed: the relay on this data folder does not answer" in result.stdout
    assert pending(live) == [(1, os_user(), "smoke")]


def test_a_stop_that_the_relay_has_stored_is_not_stored_and_audited_again(
    live: Any, relay: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The relay has audited it already. Both cut a long reason alike."""
    live.ok("robot", "add", "rover")
    send_order = stop.send_order

    def store_first(folder: Any, what: str, order: dict[str, Any], *rest: Any) -> dict[str, Any]:
        database = Database(f"sqlite:///{live.data}/switchboard.db")
        with database.begin() as s:
            queries.store_stop(s, 1, order["by"], order["why"], 5.0, order["stop_id"])
        database.close()
        return send_order(folder, what, order, *rest)

    relay.motion = (0, b"")
    assert live("stop", "rover", "--why", "x" * 600).exit_code == 3
    assert pending(live) == [(1, os_user(), "x" * 500)]
    monkeypatch.setattr(stop, "send_order", store_first)
    assert live("stop", "rover", "--why", "x" * 600).exit_code == 3
    assert pending(live) == [(1, os_user(), "x" * 500)]
    stopped = [each for each in live.json("audit", "list") if each["action"] == "robot.stopped"]
    assert [each["data"]["why"] for each in stopped] == ["x" * 500]


def test_a_late_answer_is_printed(live: Any, relay: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(admin_socket_client, "_UNSURE_SECONDS", 0.05)
    live.ok("robot", "add", "rover")
    relay.motion = (200, b'{"robots": [{"robot": "rover", "done": true}]}')
    relay.may_answer.clear()
    said: list[str] = []

    def tell(sentence: str) -> None:
        said.append(sentence)
        relay.may_answer.set()

    monkeypatch.setattr(stop, "print_note", tell)
    assert live.ok("stop", "rover") == "Robot rover is stopped.\n"
    assert "The order is stored" in said[0]
    assert [robot for robot, *_ in pending(live)] == [1]


def test_a_stop_is_stored_when_the_relay_disconnects_or_fails(live: Any, relay: Any) -> None:
    """The order may have made it crash, or its database may be away."""
    live.ok("robot", "add", "rover")
    for number, motion in enumerate([(0, b""), (503, b'{"detail": "in its own words"}'), (200, b"<html>")]):
        relay.motion = motion
        result = live("stop", "rover", "--why", f"the {number}")
        assert (result.exit_code, "The order is stored" in result.stdout) == (3, True), result.output
        assert pending(live) == [(1, os_user(), f"the {number}")]


def test_stops_of_robots_the_relay_could_not_look_up_are_stored(live: Any, relay: Any) -> None:
    live.ok("robot", "add", "rover")
    live.ok("robot", "add", "mule")
    relay.motion = (200, b'{"robots": [{"robot": "rover", "done": true}], "missed": "it did not answer"}')
    result = live("stop", "--all")
    assert result.exit_code == 0, result.output
    assert "Not all robots have the order yet: it did not answer" in result.stderr
    assert result.stdout.startswith(
        "Robot rover is stopped.\nRobot mule will be stopped as soon as it can be reached"
    )
    assert [robot for robot, *_ in pending(live)] == [2]
