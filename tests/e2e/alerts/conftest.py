"""One relay with a receiver of its alerts, without rules and news at the beginning of each test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from switchboard_hook import Hook
from switchboard_processes import running
from switchboard_relay import Relay

from tests.e2e.alerts.house import House


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    """One relay for all."""
    hook = Hook()
    relay = Relay(
        tmp_path_factory.mktemp("alerts"),
        "--webhook-networks",
        "127.0.0.0/8",
        "--apprise-schemes",
        "mailto",
    )
    with running(hook, relay):
        yield House(relay, hook, relay.user("boss", admin=True), relay.user("viewer"), {})


@pytest.fixture(autouse=True)
def clean(house: House) -> Iterator[None]:
    """No rules and nothing heard before; no robot's words after."""
    house.hook.got.clear()
    house.hook.status = 204
    yield
    for rule in house.ask("GET", "/rules")["rules"]:
        house.ask("DELETE", f"/rules/{rule['id']}")
    assert "Traceback" not in house.relay.log
