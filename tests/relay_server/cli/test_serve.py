"""``switchboard serve``: what its options may be."""

from __future__ import annotations

from typing import Any

import pytest

from relay_server import logs
from relay_server import run as running
from relay_server.config import RelaySettings


@pytest.fixture
def began(monkeypatch: pytest.MonkeyPatch) -> list[RelaySettings]:
    """The settings of the relays that were begun."""
    found: list[RelaySettings] = []
    monkeypatch.setattr(running, "run", lambda settings, ready: found.append(settings))
    monkeypatch.setattr(logs, "begin", lambda *how, **later: None)
    return found


def test_a_request_for_control_lapses_after_the_grace_time(cli: Any, began: list[RelaySettings]) -> None:
    """Or no owner could ever take over."""
    cli.ok("serve")
    cli.ok("serve", "--control-grace", "5", "--control-request", "10")
    assert [(each.control_grace, each.control_request) for each in began] == [(30, 60), (5, 10)]
    for options in (("--control-grace", "60"), ("--control-request", "30"), ("--control-request", "90000")):
        assert "in between owners take over" in cli.fails("serve", *options)
    assert len(began) == 2


def test_the_room_of_recordings_is_not_less_than_nothing(cli: Any, began: list[RelaySettings]) -> None:
    """Neither what they may take nor what they leave free of the disk."""
    cli.ok("serve")
    cli.ok("serve", "--recordings-gb", "0.5", "--recordings-reserve-gb", "2.5")
    found = [(each.recordings, each.recordings_reserve) for each in began]
    assert found == [(10 * 10**9, 10**9), (500_000_000, 2_500_000_000)]
    for option in ("--recordings-gb", "--recordings-reserve-gb"):
        assert "must be from 0 to" in cli.fails("serve", option, "-1")
    assert len(began) == 2


def test_requests_are_limited_unless_they_are_not(cli: Any, began: list[RelaySettings]) -> None:
    """By so many a second; 0 is for no limit, less is none."""
    cli.ok("serve")
    cli.ok("serve", "--requests-per-second", "0")
    assert [each.requests for each in began] == [500, 0]
    cli.ok("serve", "--streams-per-user", "0")
    assert [each.streams for each in began] == [128, 128, 0]
    assert "--requests-per-second must be from 0" in cli.fails("serve", "--requests-per-second", "-1")
