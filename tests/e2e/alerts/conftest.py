"""One relay with a webhook receiver; each test starts without rules, alerts and messages."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.worlds.alert_relay import AlertWorld
from tests.worlds.processes import running
from tests.worlds.relay_process import Relay
from tests.worlds.webhook_server import WebhookServer


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AlertWorld]:
    """One relay for all tests."""
    webhook_receiver = WebhookServer()
    relay = Relay(
        tmp_path_factory.mktemp("alerts"),
        "--webhook-networks",
        "127.0.0.0/8",
        "--apprise-schemes",
        "mailto",
    )
    with running(webhook_receiver, relay):
        yield AlertWorld(relay, webhook_receiver, relay.user("boss", admin=True), relay.user("viewer"), {})


@pytest.fixture(autouse=True)
def clean(world: AlertWorld) -> Iterator[None]:
    """Removes rules and received messages before a test, and the robot's reports after it."""
    world.webhook_receiver.got.clear()
    world.webhook_receiver.status = 204
    yield
    for rule in world.ask("GET", "/rules")["rules"]:
        world.ask("DELETE", f"/rules/{rule['id']}")
    assert "Traceback" not in world.relay.log
