"""The relay's composition root."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import pytest
import pytest_twisted
from twisted.internet import reactor
from twisted.internet.defer import Deferred

from relay_db import queries
from relay_db.queries import NewStoredEvent
from relay_protocol.clocks import now_ns
from relay_server.access import BadCredentials
from relay_server.alerts import alerts
from relay_server.alerts import types as kinds
from relay_server.auth import passwords
from relay_server.config import ListenAddress, RelaySettings
from relay_server.robots.registry import RobotState
from relay_server.service import Relay
from tests.relay_server.directory.test_entries import RECORD
from tests.relay_server.memory import MemoryLink, hangs

GOING = "the relay is going down"


def made(folder: Path) -> Relay:
    """A relay on a database of its own, which listens nowhere yet."""
    nowhere = ListenAddress("127.0.0.1", 0)
    database = f"sqlite:///{folder}/relay.db"
    return Relay(reactor, RelaySettings(data=folder, database=database, http=nowhere, robots=nowhere))


class Link(MemoryLink):
    """The control link of a robot that moves: that it ends is an alert.

    :ivar robot: its robot
    """

    def __init__(self, relay: Relay, robot: RobotState) -> None:
        super().__init__()
        self.robot = robot
        self._relay = relay

    def close(self, reason: str) -> None:
        """The relay hangs up."""
        super().close(reason)
        self._relay._alerts.alerts.tell(self.robot, kinds.CONTROL, "", "error", reason)


async def with_a_robot(relay: Relay) -> Link:
    """Start the relay; a robot that it knows registers."""
    await relay.start()
    record = await relay._store.write(queries.add_robot, "rover")
    robot = relay._registry.presence(record.id, "rover", "default")
    made = Link(relay, robot)
    relay._registry.registered(robot, made)
    return made


@pytest_twisted.ensureDeferred
async def test_all_are_told_that_the_relay_goes_before_the_database_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may hang for longer than the relay has left; then it is not waited for."""
    relay = made(tmp_path)
    robot = await with_a_robot(relay)
    relay._alerts.alerts.tell(robot.robot, kinds.STOP, "", "error", "stopped by ann")
    monkeypatch.setattr(relay._store, "write", hangs)
    monkeypatch.setattr(alerts, "KEEP_SECONDS", 0.05)
    stopping = Deferred.fromCoroutine(relay.stop())
    assert robot.closed == GOING
    assert relay._desk is not None
    assert not relay._desk.accepting
    await stopping


@pytest_twisted.ensureDeferred
async def test_what_the_relays_end_caused_is_kept(tmp_path: Path) -> None:
    """Whoever lost control by it while the robot moved finds that when the next relay runs."""
    relay = made(tmp_path)
    await with_a_robot(relay)
    await relay.stop()
    later = made(tmp_path)
    await later.start()
    assert [(each.kind, each.text) for each in later._alerts.alerts.book] == [(kinds.CONTROL, GOING)]
    await later.stop()


@pytest_twisted.ensureDeferred
async def test_a_token_that_was_revoked_proves_nobody_after_the_relay_has_looked(tmp_path: Path) -> None:
    """As it does when somebody knocks, and by itself; until then it need not ask about who was proved."""
    relay = made(tmp_path)
    await relay.start()
    try:
        user = await relay._store.write(queries.add_user, "ann", None)
        hash = passwords.token_hash("secret")
        token = await relay._store.write(
            queries.create_token, user.id, hash, kind="access", expires=None, now=1.0
        )
        await relay.refresh()
        assert relay._desk is not None
        principal = await relay._desk.token("secret")
        assert (principal.name, principal.token_id) == ("ann", token)
        await relay._store.write(queries.revoke_token, token)
        await relay.refresh()
        with pytest.raises(BadCredentials):
            await relay._desk.token("secret")
    finally:
        await relay.stop()


@pytest_twisted.ensureDeferred
async def test_a_realm_that_is_made_anew_is_empty_while_the_relay_runs(tmp_path: Path) -> None:
    """Its memory and its directory at hand tell nothing of what was in the former."""
    relay = made(tmp_path)
    await relay.start()
    try:
        await relay._store.write(queries.add_realm, "lab")
        await relay.refresh()
        memory, changes = relay._memory, relay._directory._changes
        memory.note(NewStoredEvent("lab", 1.0, "relay", "x", None, None, "{}"))
        await memory._writer.flush()
        changes.tell("registered", RECORD._replace(realm="lab"))
        assert memory._recent.since("lab", 0) and changes.follow("lab", None)[0].number == 1
        await relay._store.write(queries.remove_realm, "lab")
        await relay._store.write(queries.add_realm, "lab")
        await relay.refresh()
        assert memory._recent.since("lab", 0) is None and changes.follow("lab", None)[0].number == 0
        assert memory._quota._sizes["lab"] == 0 and memory._writer.knows("lab")
    finally:
        await relay.stop()


def test_the_relay_dates_commands_by_the_clock_that_goes_on_in_suspends(tmp_path: Path) -> None:
    """What waited in a socket while the relay's machine slept is as old as it is: its links read that clock."""
    relay = made(tmp_path)
    factory = relay._robot_factory(cast(Any, None))
    assert factory.buildProtocol(None).clock_ns is now_ns
