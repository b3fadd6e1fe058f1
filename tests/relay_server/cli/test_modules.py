"""``switchboard module`` and ``switchboard top``, with answers of a relay."""

from __future__ import annotations

import json
import time
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from relay_server.cli import modules
from relay_server.cli.app import App
from relay_server.modules.http import ProcessQuery
from relay_server.modules.schemas import ProcessList, ProcessStatus
from tests.relay_server.cli.conftest import Cli, FakeRelay

BASE = {
    "name": "base", "kind": "command", "state": "running", "wanted": True, "since": 1.0, "pid": 4711, "restarts": 0,
    "last_exit": "", "after": [], "why": "", "pending": None, "refused": None,
}  # fmt: skip


def answer(relay: FakeRelay, body: Any, status: int = 200) -> None:
    relay.motion = (status, json.dumps(body).encode())


def listed(relay: FakeRelay, cli: Cli, *rows: dict[str, Any], **more: Any) -> str:
    facts = {"robot": "rover", "online": True, "current": True, "reported_at": time.time() - 300.0, **more}
    answer(relay, {**facts, "modules": list(rows)})
    return cli.ok("module", "list", "rover")


def test_states_of_now_are_listed_without_words(relay: FakeRelay, live: Cli) -> None:
    shown = listed(relay, live, BASE)
    assert shown.startswith("module")
    assert "4711" in shown


def test_last_states_of_a_robot_that_is_offline_have_their_age(relay: FakeRelay, live: Cli) -> None:
    shown = listed(relay, live, BASE, online=False, current=False)
    assert shown.startswith("Robot rover is offline; last reported 5 min")
    assert "running" in shown
    # Its process is not known now, and for how long it has been running neither.
    assert "4711" not in shown


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (
            {"online": False, "current": False, "reported_at": None},
            "offline, and has never reported its modules",
        ),
        ({"current": False, "reported_at": None}, "online, and has never reported its modules"),
        ({"current": False}, "online, and has not reported its modules yet; last reported 5 min"),
        ({}, "Robot rover has no modules"),
        ({"online": False, "current": False}, "Robot rover had no modules"),
    ],
)
def test_a_list_without_modules_says_why(relay: FakeRelay, live: Cli, more: Any, words: str) -> None:
    shown = listed(relay, live, **more)
    assert words in shown
    if more.get("reported_at", 1) is None:
        assert "not known" in shown
        assert "no modules" not in shown


def test_an_order_that_was_refused_is_shown_with_its_reason(relay: FakeRelay, live: Cli) -> None:
    refused = {"action": "start", "by": "ann", "at": 1.0, "why": "robot rover: it is locked"}
    shown = listed(relay, live, {**BASE, "refused": refused})
    assert "start: refused" in shown
    assert "A pending order was refused: start base, by ann: robot rover: it is locked" in shown


@pytest.mark.parametrize(("every", "accepted"), [(0.09, False), (0.1, True), (10.0, True), (10.1, False)])
def test_interval_of_measurements_has_the_same_bounds_by_command_and_by_http(
    relay: FakeRelay, live: Cli, monkeypatch: pytest.MonkeyPatch, every: float, accepted: bool
) -> None:
    pauses: list[float] = []
    monkeypatch.setattr(modules, "time", SimpleNamespace(sleep=pauses.append))
    answer(relay, {"at": 1.0, "processes": [], "more": 0})
    shown = live("top", "rover", "--every", str(every))
    assert (shown.exit_code == 0, pauses) == (accepted, [every] * accepted)
    try:
        query = msgspec.convert({"every": every}, ProcessQuery)
    except msgspec.ValidationError:
        query = None
    assert (query is not None) == accepted


def test_processes_of_a_robot_that_went_offline_are_stale(
    relay: FakeRelay, live: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They stay in sight, under a line with their age and the reason."""
    row = ProcessStatus(pid=7, parent=1, name="python3", part="base", state="running", memory=1)
    found = msgspec.to_builtins(ProcessList(at=1.0, processes=[row], more=0))
    turns = modules._turns(App(live.data, None), "rover", "cpu")
    now = [1000.0]
    clock = SimpleNamespace(monotonic=lambda: now[0], gmtime=time.gmtime, strftime=time.strftime)
    monkeypatch.setattr(modules, "time", clock)
    offline = {"code": "unavailable", "detail": "robot rover is offline", "status": 503, "title": "x"}
    answer(relay, offline, 503)
    assert [each.title for each in next(turns)] == ["robot rover is offline"]
    answer(relay, found)
    title, *fresh = next(turns)
    assert title.title.startswith("rover: 1 processes")
    now[0] += 65.0
    answer(relay, offline, 503)
    stale = next(turns)
    assert stale[0].title == "STALE, 1 min 5 s old: robot rover is offline"
    assert stale[1:] == [title, *fresh]
    answer(relay, found)
    assert "STALE" not in next(turns)[0].title
