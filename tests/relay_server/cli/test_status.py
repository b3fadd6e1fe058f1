"""``switchboard status``."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from relay_protocol.text import inert
from relay_server.cli.text import duration, moment


def _answer(**robot: Any) -> dict[str, Any]:
    return {"relay": "switchboard 0.1.0", "uptime_s": 3725.5, "robots": [robot] if robot else []}


def test_status_shows_who_is_online_and_with_whom(live: Any, relay: Any) -> None:
    """One row a robot, for programs the relay's answer as it is."""
    client = {"user": "ann", "address": "192.0.2.7", "since": time.time() - 125}
    answer = _answer(name="rover", state="in use", clients=[client], rtt_ms=1.25)
    relay.answer = (200, json.dumps(answer).encode())
    table = live.ok("status")
    assert "switchboard 0.1.0, up 1 h 2 m" in table
    assert "ann from 192.0.2.7 for 2 m" in table
    assert "1.2 ms" in table
    assert live.json("status") == answer
    assert relay.asked == ["GET /status", "GET /status"]


def test_status_without_robots_says_where_to_look(live: Any, relay: Any) -> None:
    """Rather than an empty table."""
    relay.answer = (200, json.dumps(_answer()).encode())
    assert "switchboard robot list" in live.ok("status")


def test_hostile_text_is_inert(live: Any, relay: Any) -> None:
    """Escapes, markup, direction marks and line breaks from robots and users are shown, not obeyed."""
    evil = "\x1b[2J\x9b31m\u202e[red]:boom:\nnext\x07"
    client = {"user": evil, "address": evil, "since": "yesterday"}
    answer = _answer(name=evil, state=evil, clients=[client], rtt_ms="fast")
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
    "body", [{}, {"robots": None}, {"robots": [7, {}]}, {"robots": [{"clients": [None]}]}]
)
def test_gaps_in_the_answer_are_shown_as_such(live: Any, relay: Any, body: dict[str, Any]) -> None:
    """A relay of another version is no reason to fail."""
    relay.answer = (200, json.dumps(body).encode())
    assert live.ok("status").startswith("Relay ?")


def test_no_relay_is_exit_code_3(cli: Any, short_folder: Path) -> None:
    """No folder, no socket, or a socket nobody listens on any more."""
    import socket

    assert "no relay runs" in cli.fails("status", code=3)
    assert not cli.data.exists()
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(short_folder / "relay.sock"))
    assert "no relay runs" in cli.fails("--data", str(short_folder), "status", code=3)


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
