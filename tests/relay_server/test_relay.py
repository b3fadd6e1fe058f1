"""The relay's composition root."""

from __future__ import annotations

from pathlib import Path

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import Deferred

from relay_db import queries
from relay_db.queries import NewStoredEvent
from relay_protocol.clocks import now_ns
from relay_server.access import BadCredentials
from relay_server.alerts import hub
from relay_server.alerts import types as kinds
from relay_server.auth import passwords
from relay_server.config import ListenAddress, RelaySettings
from relay_server.relay import Relay
from relay_server.robots.build import build_robot_factory
from relay_server.robots.registry import RobotState
from tests.relay_server.service_registry.test_entries import RECORD
from tests.worlds.relay import MemoryLink, hangs

GOING = "the relay is going down"


def made(folder: Path) -> Relay:
    """A relay with a new database that does not listen yet."""
    nowhere = ListenAddress("127.0.0.1", 0)
    database = f"sqlite:///{folder}/relay.db"
    return Relay(reactor, RelaySettings(data=folder, database=database, http=nowhere, robots=nowhere))


class Link(MemoryLink):
    """The control link of a moving robot, whose loss raises an alert.

    :ivar robot: its robot
    """

    def __init__(self, relay: Relay, robot: RobotState) -> None:
        super().__init__()
        self.robot = robot
        self._relay = relay

    def close(self, reason: str) -> None:
        """The relay closes the link."""
        super().close(reason)
        self._relay.services.alerts.hub.raise_alert(self.robot, kinds.CONTROL, "", "error", reason)


async def with_a_robot(relay: Relay) -> Link:
    """Starts the relay; a known robot registers."""
    await relay.start()
    record = await relay.services.core.database.write(queries.add_robot, "rover")
    robot = relay.services.core.robots.robot(record.id, "rover", "default")
    made = Link(relay, robot)
    relay.services.core.robots.registered(robot, made)
    return made


@pytest_twisted.ensureDeferred
async def test_shutdown_is_announced_before_the_database_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The database may hang longer than the shutdown may take; then it is not waited for."""
    relay = made(tmp_path)
    robot = await with_a_robot(relay)
    relay.services.alerts.hub.raise_alert(robot.robot, kinds.STOP, "", "error", "stopped by ann")
    monkeypatch.setattr(relay.services.core.database, "write", hangs)
    monkeypatch.setattr(hub, "SAVE_SECONDS", 0.05)
    stopping = Deferred.fromCoroutine(relay.stop())
    assert robot.closed == GOING
    assert not relay.services.sessions.accepting
    await stopping


@pytest_twisted.ensureDeferred
async def test_alerts_caused_by_the_relays_end_are_stored(tmp_path: Path) -> None:
    """A user who lost control of a moving robot by it finds the alert when the next relay runs."""
    relay = made(tmp_path)
    await with_a_robot(relay)
    await relay.stop()
    later = made(tmp_path)
    await later.start()
    assert [(each.kind, each.text) for each in later.services.alerts.hub.store] == [(kinds.CONTROL, GOING)]
    await later.stop()


@pytest_twisted.ensureDeferred
async def test_a_revoked_token_is_refused_once_the_relay_has_read_the_change(tmp_path: Path) -> None:
    """After a notification, and by polling; until then the relay need not read the database for known users."""
    relay = made(tmp_path)
    await relay.start()
    try:
        user = await relay.services.core.database.write(queries.add_user, "ann", None)
        hash = passwords.token_hash("secret")
        token = await relay.services.core.database.write(
            queries.create_token, user.id, hash, kind="access", expires=None, now=1.0
        )
        await relay.refresh()
        principal = await relay.services.auth.token("secret")
        assert (principal.name, principal.token_id) == ("ann", token)
        await relay.services.core.database.write(queries.revoke_token, token)
        await relay.refresh()
        with pytest.raises(BadCredentials):
            await relay.services.auth.token("secret")
    finally:
        await relay.stop()


@pytest_twisted.ensureDeferred
async def test_a_realm_created_again_is_empty_while_the_relay_runs(tmp_path: Path) -> None:
    """Cached events and entries of the former realm are not shown."""
    relay = made(tmp_path)
    await relay.start()
    try:
        await relay.services.core.database.write(queries.add_realm, "lab")
        await relay.refresh()
        memory, changes = relay.services.events, relay.services.service_registry._changes
        memory.record(NewStoredEvent("lab", 1.0, "relay", "x", None, None, "{}"))
        await memory._writer.flush()
        changes.publish("registered", RECORD._replace(realm="lab"))
        assert memory._recent.since("lab", 0) and changes.follow("lab", None)[0].number == 1
        await relay.services.core.database.write(queries.remove_realm, "lab")
        await relay.services.core.database.write(queries.add_realm, "lab")
        await relay.refresh()
        assert memory._recent.since("lab", 0) is None and changes.follow("lab", None)[0].number == 0
        assert memory._quota._sizes["lab"] == 0 and memory._writer.knows_realm("lab")
    finally:
        await relay.stop()


def test_the_relay_dates_commands_by_the_clock_that_goes_on_in_suspends(tmp_path: Path) -> None:
    """Messages that waited in a socket during a suspend have their full age: the relay's links use that
    clock.
    """
    relay = made(tmp_path)
    factory = build_robot_factory(relay.services.core, relay.services.function_links.handler)
    assert factory.buildProtocol(None).clock_ns is now_ns
