"""What is put on record about control, in a real database."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest_twisted
from twisted.internet.task import Clock

from relay_db import queries
from relay_db.queries import StopRecord
from relay_server.audit_log import AuditLog
from relay_server.common.database import AsyncDatabase
from relay_server.control.audit import Actor, DatabaseAuditSink
from relay_server.events.bus import BURST, EventBus
from relay_server.robots.registry import RobotState
from tests.relay_server.memory import Time

ANN = Actor("ann", "user:ann", None, "192.0.2.7", 3)


async def made(store: AsyncDatabase, time: Time) -> tuple[DatabaseAuditSink, RobotState]:
    """A record, and a robot the database knows."""
    robot = await store.write(queries.add_robot, "rover")
    journal = EventBus(store, time)
    folder = Path(store.database.url.removeprefix("sqlite:///")).parent
    audit = AuditLog(Clock(), store, folder, journal.tell)
    return DatabaseAuditSink(store, journal, audit, time), RobotState(robot.id, robot.name, robot.realm)


async def written(store: AsyncDatabase) -> tuple[list[Any], list[Any]]:
    """Events and audit entries, oldest first, once all is written that waits now."""
    for _ in range(5):
        await store.write(queries.revision)
    return (await store.read(queries.list_events))[::-1], (await store.read(queries.list_audit))[::-1]


@pytest_twisted.ensureDeferred
async def test_a_change_is_an_event_and_an_audit_entry(store: AsyncDatabase, time: Time) -> None:
    """Both say who, which robot, why, and by which connection."""
    record, robot = await made(store, time)
    record.note("control.lost", robot, ANN, "the connection has ended", moving=True)
    events, audit = await written(store)
    (event,) = events
    assert (event.kind, event.source, event.robot_id) == ("control.lost", "user:ann", robot.robot_id)
    assert event.data == {
        "robot": "rover",
        "user": "ann",
        "connection": 3,
        "address": "192.0.2.7",
        "why": "the connection has ended",
        "moving": True,
    }
    (entry,) = audit
    assert (entry.actor, entry.action, entry.target, entry.origin) == (
        "user:ann",
        "control.lost",
        "rover",
        "192.0.2.7",
    )
    assert entry.data == {"connection": 3, "why": "the connection has ended", "moving": True}


@pytest_twisted.ensureDeferred
async def test_who_causes_much_is_on_record_with_all_of_it(store: AsyncDatabase, time: Time) -> None:
    """Suppressing needs no audit entry; a flood of changes leaves few events, and an entry for each change."""
    record, robot = await made(store, time)
    record.note("robot.suppressed", robot, ANN, audit=False, resource="/cmd_vel")
    for _ in range(3 * BURST):
        record.note("control.taken", robot, ANN)
    events, audit = await written(store)
    assert len(events) == BURST
    assert len(audit) == 3 * BURST


@pytest_twisted.ensureDeferred
async def test_an_order_to_stop_is_kept_with_its_entry(store: AsyncDatabase, time: Time) -> None:
    """Until it is told, and however many there are."""
    record, robot = await made(store, time)
    order = StopRecord(robot.robot_id, "ann", "smoke", 1000.5)
    await record.ordered(robot, order, ANN)
    assert await record.pending(robot) == order
    assert not await record.told(robot, 999.0)
    assert await record.told(robot, 1000.5)
    assert await record.pending(robot) is None
    for number in range(2 * BURST):
        await record.ordered(robot, order._replace(at=2000.0 + number), ANN)
    await record.ordered(robot, order._replace(at=3000.0), ANN, audit=False)
    assert await record.told(robot, 3000.0)
    events, audit = await written(store)
    assert {each.kind for each in events} == {"robot.stopped"}
    assert len(audit) == 2 * BURST + 1
    assert audit[0].data == {"connection": 3, "why": "smoke"}
