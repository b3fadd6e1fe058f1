"""``switchboard status``."""

from __future__ import annotations

import fcntl
import json
import os
import re
import signal
import socket
import struct
import subprocess
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from switchboard_processes import BIN
from switchboard_waiting import wait_for

from relay_protocol.errors import Unavailable
from relay_protocol.text import inert
from relay_server.cli import control_socket
from relay_server.cli.output import duration, moment


def _answer(**robot: Any) -> dict[str, Any]:
    return {"relay": "switchboard 0.1.0", "uptime_s": 3725.5, "robots": [robot] if robot else []}


LINK = {"rtt_ms": 1.25, "p95_ms": 3.0, "jitter_ms": 0.1, "lost": 2, "quality": "good"}


def _rover() -> dict[str, Any]:
    client = {"user": "ann", "address": "192.0.2.7", "since": time.time() - 7300, "link": LINK, "drops": 3}
    client["robot_rtt_ms"] = 2.5
    onlooker = {"user": "bob", "address": "192.0.2.8", "since": time.time() - 10950, "camera": "/eye"}
    robot = {"name": "rover", "state": "in use", "link": LINK, "drops": 12, "battery": 0.756}
    robot |= {"holder": {"user": "ann"}, "stopped": {"by": "bob"}}
    return _answer(**robot, clients=[client, {**client, "robot_rtt_ms": 31.25}], onlookers=[onlooker])


def _words(line: str) -> list[str]:
    """The cells of a table's row."""
    return [each.strip() for each in re.split(r"\s{2,}", line.strip())]


def test_status_shows_who_is_online_and_with_whom(live: Any, relay: Any) -> None:
    """One row a robot, for programs the relay's answer as it is."""
    answer = _rover()
    relay.answer = (200, json.dumps(answer).encode())
    head, columns, _, row = live.ok("status").splitlines()
    assert head == "Relay switchboard 0.1.0, up 1 h 2 m"
    assert dict(zip(_words(columns), _words(row), strict=True)) == {
        "robot": "rover",
        "state": "in use",
        "control": "ann",
        "stopped": "bob",
        "people": "ann (2), bob",
        "round trip": "1.2 ms",
        "from people": "2.5–31.2 ms",
        "link": "good, 2 lost",
        "drops": "12",
        "battery": "76%",
    }
    assert live.json("status") == answer
    assert relay.asked == ["GET /status", "GET /status"]


def test_status_tells_who_has_a_hand_on_topics(live: Any, relay: Any) -> None:
    """Beside who has control, also where nobody has."""
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
        told = dict(zip(_words(columns), _words(row), strict=True))["control"]
        assert told == f"{words}; runaway commands /cmd_vel; olga holds /scan; otto inhibits /odom"


def test_status_does_not_say_stopped_of_a_robot_that_has_not_heard_of_it(live: Any, relay: Any) -> None:
    """It may go on moving until it has."""
    for told, words in ((False, "being stopped by bob"), (True, "bob")):
        answer = _answer(name="rover", stopped={"by": "bob", "why": "", "since": 7.0, "told": told})
        relay.answer = (200, json.dumps(answer).encode())
        _, columns, _, row = live.ok("status").splitlines()
        assert dict(zip(_words(columns), _words(row), strict=True))["stopped"] == words


def test_status_tells_who_stopped_a_stopped_robot_once_more(live: Any, relay: Any) -> None:
    """Beside who did so first."""
    again = {"by": "eve", "why": "", "since": 9.0}
    answer = _answer(
        name="rover", stopped={"by": "bob", "why": "", "since": 7.0, "told": True, "again": again}
    )
    relay.answer = (200, json.dumps(answer).encode())
    _, columns, _, row = live.ok("status").splitlines()
    assert dict(zip(_words(columns), _words(row), strict=True))["stopped"] == "bob, again by eve"


def test_status_of_one_robot_tells_who_exactly(live: Any, relay: Any) -> None:
    """Each connection, and each camera that is watched; of others nothing."""
    answer = _rover()
    answer["robots"].append({"name": "tank", "clients": [{"user": "eve"}]})
    relay.answer = (200, json.dumps(answer).encode())
    lines = [_words(each) for each in live.ok("status", "rover").splitlines()]
    assert ["user", "from", "for", "watches", "round trip", "to the robot", "link", "drops"] in lines
    assert ["ann", "192.0.2.7", "2 h 1 m", "–", "1.2 ms", "2.5 ms", "good, 2 lost", "3"] in lines
    assert ["bob", "192.0.2.8", "3 h 2 m", "/eye", "–", "–", "–", "–"] in lines
    assert not any("tank" in each or "eve" in each for each in lines)
    assert [each["name"] for each in live.json("status", "rover")["robots"]] == ["rover"]
    assert "has not seen a robot 'moon'" in live.fails("status", "moon")
    relay.answer = (200, json.dumps(_answer(name="tank")).encode())
    assert "Nobody is there." in live.ok("status", "tank")


def test_status_is_told_once_where_nobody_watches(live: Any, relay: Any) -> None:
    """Into a pipe one table goes, or one line of JSON."""
    relay.answer = (200, json.dumps(_rover()).encode())
    assert live.ok("status", "--watch").count("rover") == 1
    assert live.json("status", "--watch")["robots"][0]["name"] == "rover"


def test_status_is_drawn_anew_while_somebody_watches(relay: Any, short_folder: Path) -> None:
    """What has changed is seen a second later, a relay that goes is told, and Ctrl-C ends it well."""
    relay.answer = (200, json.dumps(_rover()).encode())
    with terminal("--data", str(short_folder), "status", "--watch") as (process, shown):
        wait_for("the robot is shown", lambda: "rover" in shown())
        relay.answer = (200, json.dumps(_answer(name="tank")).encode())
        wait_for("another is shown", lambda: "tank" in shown())
        relay.answer = (500, b"")
        wait_for("what is wrong is shown", lambda: "answered something else" in shown())
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0


@contextmanager
def terminal(*arguments: str) -> Iterator[tuple[subprocess.Popen[bytes], Callable[[], str]]]:
    """``switchboard`` in a terminal of its own; the process, and what was shown there so far."""
    mine, its = os.openpty()
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 200, 0, 0))
    os.set_blocking(mine, False)
    command = [str(BIN / "switchboard"), *arguments]
    process = subprocess.Popen(
        command, stdin=its, stdout=its, stderr=its, env={**os.environ, "TERM": "xterm"}
    )
    os.close(its)
    read = bytearray()

    def shown() -> str:
        with suppress(BlockingIOError, OSError):
            while part := os.read(mine, 65536):
                read.extend(part)
        return read.decode(errors="replace")

    try:
        yield process, shown
    finally:
        process.kill()
        process.wait()
        os.close(mine)


def test_status_without_robots_says_where_to_look(live: Any, relay: Any) -> None:
    """Rather than an empty table."""
    relay.answer = (200, json.dumps(_answer()).encode())
    assert "switchboard robot list" in live.ok("status")


def test_hostile_text_is_inert(live: Any, relay: Any) -> None:
    """Escapes, markup, direction marks and line breaks from robots and users are shown, not obeyed."""
    evil = "\x1b[2J\x9b31m\u202e[red]:boom:\nnext\x07"
    client = {"user": evil, "address": evil, "since": "yesterday"}
    onlooker = {"user": evil, "address": evil, "camera": evil}
    answer = _answer(name=evil, state=evil, clients=[client], onlookers=[onlooker], rtt_ms="fast")
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
def test_an_answer_that_is_none_is_told(live: Any, relay: Any, answer: tuple[int, bytes]) -> None:
    """A sentence and exit code 3."""
    relay.answer = answer
    assert "answered something else" in live.fails("status", code=3)


@pytest.mark.parametrize(
    "body", [{}, {"robots": None}, {"robots": [7, {}]}, {"robots": [{"clients": [None], "onlookers": [7]}]}]
)
def test_gaps_in_the_answer_are_shown_as_such(live: Any, relay: Any, body: dict[str, Any]) -> None:
    """A relay of another version is no reason to fail."""
    relay.answer = (200, json.dumps(body).encode())
    assert live.ok("status").startswith("Relay ?")


def test_no_relay_is_exit_code_3(cli: Any, short_folder: Path) -> None:
    """No folder, no socket, or a socket nobody listens on any more."""
    assert "no relay runs" in cli.fails("status", code=3)
    assert not cli.data.exists()
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(short_folder / "relay.sock"))
    assert "no relay runs" in cli.fails("--data", str(short_folder), "status", code=3)


@pytest.mark.parametrize(
    ("waits", "ask"),
    [
        ("_ASK_SECONDS", lambda folder: control_socket.ask_status(folder)),
        ("_MOTION_SECONDS", lambda folder: control_socket.order_motion(folder, "stop", {})),
        ("_LINE_SECONDS", lambda folder: list(control_socket.give_order(folder, {}, "default"))),
    ],
)
def test_a_relay_that_does_not_answer_is_told_with_the_time_that_was_waited(
    short_folder: Path, monkeypatch: pytest.MonkeyPatch, waits: str, ask: Callable[[Path], Any]
) -> None:
    """Each question has a time of its own."""
    monkeypatch.setattr(control_socket, waits, 0.125)
    with socket.socket(socket.AF_UNIX) as mute:
        mute.bind(str(short_folder / "relay.sock"))
        mute.listen()
        with pytest.raises(Unavailable, match=r"does not answer \(nothing came within 0\.125 s\)"):
            ask(short_folder)


def test_a_folder_with_a_long_path_works(
    cli: Any, tmp_path: Path, short_folder: Path, start_relay: Callable[[Path], Any]
) -> None:
    """Longer than the path of a socket may be."""
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
        (60, "1 m"),
        (3725, "1 h 2 m"),
        (90_000, "1 d 1 h"),
        (1209600, "2 w"),
    ],
)
def test_spans_are_read_in_two_units(seconds: float, text: str) -> None:
    """The largest that apply."""
    assert duration(seconds) == text


def test_moments_are_utc() -> None:
    """To the second; none is a dash."""
    assert moment(1_700_000_000.7) == "2023-11-14 22:13:20Z"
    assert moment(None) == "–"


def test_inert_text_keeps_what_can_be_read() -> None:
    """Letters of all scripts stay."""
    assert inert("Zoë 机器人 [b]") == "Zoë 机器人 [b]"
    assert inert("\x00\x7f\u2028\ud800") == "\\x00\\x7f\\u2028\\ud800"
