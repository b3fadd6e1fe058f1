"""``switchboard serve``: what its options may be."""

from __future__ import annotations

from typing import Any

import pytest

from relay_server import logs
from relay_server import run as running
from relay_server.config import Settings


@pytest.fixture
def began(monkeypatch: pytest.MonkeyPatch) -> list[Settings]:
    """The settings of the relays that were begun."""
    found: list[Settings] = []
    monkeypatch.setattr(running, "run", lambda settings, ready: found.append(settings))
    monkeypatch.setattr(logs, "begin", lambda *how: None)
    return found


def test_a_request_for_control_lapses_after_the_grace_time(cli: Any, began: list[Settings]) -> None:
    """Or no owner could ever take over."""
    cli.ok("serve")
    cli.ok("serve", "--control-grace", "5", "--control-request", "10")
    assert [(each.control_grace, each.control_request) for each in began] == [(30, 60), (5, 10)]
    for options in (("--control-grace", "60"), ("--control-request", "30"), ("--control-request", "90000")):
        assert "in between owners take over" in cli.fails("serve", *options)
    assert len(began) == 2
