"""``switchboard status``."""

from __future__ import annotations

import json
import re
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from relay_protocol.errors import Unavailable
from relay_protocol.text import escape_unprintable
from relay_server.cli import admin_socket_client
from relay_server.cli.output import format_duration, format_time
from tests.worlds.terminal import Terminal
from tests.worlds.waiting import wait_for


def _answer(**robot: Any) -> dict[str, Any]:
    return {"relay": "switchboard 0.1.0", "uptime_s": 3725.5, "robots": [robot] if robot else []}


LINK = {"rtt_ms": 1.25, "p95_ms": 3.0, "jitter_ms": 0.1, "lost": 2, "quality": "good"}


def _rover() -> dict[str, Any]:
    client = {"user": "ann", "address": "192.0.2.7", "since": time.time() - 7300, "link": LINK, "drops": 3}
    client["robot_rtt_ms"] = 2.5
    viewer = {"user": "bob", "address": "192.0.2.8", "since": time.time() - 10950, "camera": "/eye"}
    robot = {"name": "rover", "state": "in use", "link": LINK, "drops": 12, "battery": 0.756}
    robot |= {"holder": {"user": "ann"}, "stopped": {"by": "bob"}}
    return _answer(**robot, clients=[client, {**client, "robot_rtt_ms": 31.25}], viewers=[viewer])


def _words(line: str) -> list[str]:
    """The cells of a table's row."""
    return [each.strip() for each in re.split(r"\s{2,}", line.strip())]


def test_status_shows_robots_and_their_users(live: Any, relay: Any) -> None:
    """One row per robot; programs get the relay's answer unchanged."""
    answer = _rover()
    relay.answer = (200, json.dumps(answer).encode())
    head, columns, _, row = live.ok("status").splitlines()
    assert head == "Relay switchboard 0.1.0, up 1 h 2 min"
    assert dict(zip(_words(columns), _words(row), strict=True)) == {
        "robot": "rover",
        "state": "in use",
        "control": "ann",
        "stopped": "bob",
        "people": "ann (2), bob",
        "round trip": "1.2 ms",
        "from clients": "2.5–31.2 ms",
        "link": "good, 2 lost",
        "drops": "12",
        "battery": "76%",
    }
    assert live.json("status") == answer
    assert relay.asked == ["GET /status", "GET /status"]


def test_status_shows_suppressed_and_inhibited_topics(live: Any, relay: Any) -> None:
    hands = {
        "suppressed": [{"resource": "/cmd_vel", "by": "runaway", "hold": False}],
        "inhibited": [
            {"resource": "/scan", "by": "olga", "hold": True},
            {"resource": "/odom", "by": "otto", "hold": False},
        ],
    }
    for holder, words in ({"user": "ann"}, "ann"), (None, "–"):
        relay.answer = (200, json.dumps(_answer(name="rover", holder=holder, **hands)).encode())
        _, columns, _, row = live.ok("status").splitlines()
        reported = dict(zip(_words(columns), _words(row), strict=True))["control"]
        assert reported == f"{words}; runaway commands /cmd_vel; olga holds /scan; otto inhibits /odom"


def test_status_shows_unconfirmed_stops_as_being_stopped(live: Any, relay: Any) -> None:
    """The robot may still move until it confirms."""
    for reported, words in ((False, "being stopped by bob"), (True, "bob")):
        answer = _answer(name="rover", stopped={"by": "bob", "why": "", "since": 7.0, "confirmed": reported})
        relay.answer = (200, json.dumps(answer).encode())
        _, columns, _, row = live.ok("status").splitlines()
        assert dict(zip(_words(columns), _words(row), strict=True))["stopped"] == words


def test_status_shows_a_repeated_stop(live: Any, relay: Any) -> None:
    again = {"by": "eve", "why": "", "since": 9.0}
    answer = _answer(
        name="rover", stopped={"by": "bob", "why": "", "since": 7.0, "confirmed": True, "again": again}
    )
    relay.answer = (200, json.dumps(answer).encode())
    _, columns, _, row = live.ok("status").splitlines()
    assert dict(zip(_words(columns), _words(row), strict=True))["stopped"] == "bob, again by eve"


def test_status_of_one_robot_lists_its_clients(live: Any, relay: Any) -> None:
    """Each connection and each camera viewer; other robots are not shown."""
    answer = _rover()
    answer["robots"].append({"name": "tank", "clients": [{"user": "eve"}]})
    relay.answer = (200, json.dumps(answer).encode())
    lines = [_words(each) for each in live.ok("status", "rover").splitlines()]
    assert ["user", "from", "for", "watches", "round trip", "to the robot", "link", "drops"] in lines
    assert ["ann", "192.0.2.7", "2 h 1 min", "–", "1.2 ms", "2.5 ms", "good, 2 lost", "3"] in lines
    assert ["bob", "192.0.2.8", "3 h 2 min", "/eye", "–", "–", "–", "–"] in lines
    assert not any("tank" in each or "eve" in each for each in lines)
    assert [each["name"] for each in live.json("status", "rover")["robots"]] == ["rover"]
    assert "does not know a robot 'moon'" in live.fails("status", "moon")
    relay.answer = (200, json.dumps(_answer(name="tank")).encode())
    assert "No clients." in live.ok("status", "tank")


def test_status_is_printed_once_without_a_terminal(live: Any, relay: Any) -> None:
    """A pipe gets one table or one line of JSON."""
    relay.answer = (200, json.dumps(_rover()).encode())
    assert live.ok("status", "--watch").count("rover") == 1
    assert live.json("status", "--watch")["robots"][0]["name"] == "rover"


def test_status_is_refreshed_in_a_terminal(relay: Any, short_folder: Path) -> None:
    relay.answer = (200, json.dumps(_rover()).encode())
    with Terminal("--data", str(short_folder), "status", "--watch") as terminal:
        wait_for("the robot is shown", lambda: "rover" in terminal.shown())
        relay.answer = (200, json.dumps(_answer(name="tank")).encode())
        wait_for("another is shown", lambda: "tank" in terminal.shown())
        relay.answer = (500, b"")
        wait_for("what is wrong is shown", lambda: "sent an unexpected answer" in terminal.shown())
        terminal.type("\x03")
        assert terminal.process.wait(60) == 0


def test_status_without_robots_gives_advice(live: Any, relay: Any) -> None:
    relay.answer = (200, json.dumps(_answer()).encode())
    assert "switchboard robot list" in live.ok("status")


def test_hostile_text_is_inert(live: Any, relay: Any) -> None:
    """Escapes, markup, direction marks and line breaks from robots and users are printed as text."""
    evil = "\x1b[2J\x9b31m\u202e[red]:boom:\nnext\x07"
    client = {"user": evil, "address": evil, "since": "yesterday"}
    viewer = {"user": evil, "address": evil, "camera": evil}
    answer = _answer(name=evil, state=evil, clients=[client], viewers=[viewer], rtt_ms="fast")
    relay.answer = (200, json.dumps({**answer, "relay": evil}).encode())
    shown = live.ok("status")
    for line in shown.splitlines():
        assert line.isprintable()
    assert "\\x1b[2J\\x9b31m\\u202e[red]:boom:\\nnext\\x07" in shown
    assert live.ok("status", "--json").isascii()


@pytest.mark.parametrize(
    "answer",
    [
        (200, b"no json"),
        (200, b"[]"),
        (500, b"{}"),
        (404, b"not here"),
    ],
)
def test_an_invalid_answer_is_reported(live: Any, relay: Any, answer: tuple[int, bytes]) -> None:
    """The exit code is 3."""
    relay.answer = answer
    assert "sent an unexpected answer" in live.fails("status", code=3)


@pytest.mark.parametrize(
    "body", [{}, {"robots": None}, {"robots": [7, {}]}, {"robots": [{"clients": [None], "viewers": [7]}]}]
)
def test_gaps_in_the_answer_are_shown_as_such(live: Any, relay: Any, body: dict[str, Any]) -> None:
    """A relay of another version must not make the command fail."""
    relay.answer = (200, json.dumps(body).encode())
    assert live.ok("status").startswith("Relay ?")


def test_no_relay_is_exit_code_3(new_cli: Any, short_folder: Path) -> None:
    assert "no relay runs" in new_cli.fails("status", code=3)
    assert not new_cli.data.exists()
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(short_folder / "relay.sock"))
    assert "no relay runs" in new_cli.fails("--data", str(short_folder), "status", code=3)


@pytest.mark.parametrize(
    ("waits", "ask"),
    [
        ("_STATUS_SECONDS", lambda folder: admin_socket_client.ask_status(folder)),
        ("_ORDER_SECONDS", lambda folder: admin_socket_client.send_order(folder, "stop", {})),
        ("_LINE_SECONDS", lambda folder: list(admin_socket_client.send_fleet_order(folder, {}, "default"))),
    ],
)
def test_a_relay_that_does_not_answer_is_reported_with_the_time(
    short_folder: Path, monkeypatch: pytest.MonkeyPatch, waits: str, ask: Callable[[Path], Any]
) -> None:
    """Each request has its own timeout."""
    monkeypatch.setattr(admin_socket_client, waits, 0.125)
    with socket.socket(socket.AF_UNIX) as mute:
        mute.bind(str(short_folder / "relay.sock"))
        mute.listen()
        with pytest.raises(Unavailable, match=r"does not answer \(no answer within 0\.125 s\)"):
            ask(short_folder)


def test_a_folder_with_a_long_path_works(
    cli: Any, tmp_path: Path, short_folder: Path, start_relay: Callable[[Path], Any]
) -> None:
    """It is longer than the path of a socket may be."""
    long = tmp_path / ("x" * 120)
    long.mkdir()
    link = short_folder / "link"
    link.symlink_to(long)
    start_relay(link).answer = (200, b'{"relay": "here"}')
    assert cli.json("--data", str(long), "status") == {"relay": "here"}


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0 s"),
        (0.9, "0 s"),
        (59, "59 s"),
        (60, "1 min"),
        (3725, "1 h 2 min"),
        (90_000, "1 d 1 h"),
        (1209600, "14 d"),
    ],
)
def test_spans_are_read_in_two_units(seconds: float, text: str) -> None:
    """They are the largest that apply."""
    assert format_duration(seconds) == text


def test_moments_are_utc() -> None:
    """They are rounded to seconds; a missing time is a dash."""
    assert format_time(1_700_000_000.7) == "2023-11-14 22:13:20Z"
    assert format_time(None) == "–"


def test_escaped_text_stays_readable() -> None:
    """Letters of all scripts are kept."""
    assert escape_unprintable("Zoë 机器人 [b]") == "Zoë 机器人 [b]"
    assert escape_unprintable("\x00\x7f\u2028\ud800") == "\\x00\\x7f\\u2028\\ud800"
