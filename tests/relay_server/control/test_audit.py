"""Audit entries about control, in a real database."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest_twisted
from twisted.internet.task import Clock

from relay_db import queries
from relay_db.queries import StopRecord
from relay_server.audit_log import AuditLog
from relay_server.common.database import AsyncDatabase
from relay_server.control.actor import Actor
from relay_server.control.records import ControlAuditSink
from relay_server.control.stored_stops import DatabasePendingStops
from relay_server.events.bus import BusEvent, EventBus
from relay_server.robots.registry import RobotState
from tests.worlds.relay import Time

MANY = 60

ANN = Actor("ann", "user:ann", None, "192.0.2.7", 3)


async def made(store: AsyncDatabase, time: Time) -> tuple[ControlAuditSink, RobotState, list[BusEvent]]:
    """An audit sink, and a robot that the database knows."""
    robot = await store.write(queries.add_robot, "rover")
    bus = EventBus()
    published: list[BusEvent] = []
    bus.subscribe(published.append)
    folder = Path(store.database.url.removeprefix("sqlite:///")).parent
    audit = AuditLog(Clock(), store, folder, bus.publish)
    return (
        ControlAuditSink(bus, audit, time),
        RobotState(robot.id, robot.name, robot.realm),
        published,
    )


async def written(store: AsyncDatabase) -> list[Any]:
    """Audit entries, oldest first, after all pending writes."""
    for _ in range(5):
        await store.write(queries.revision)
    return (await store.read(queries.list_audit))[::-1]


@pytest_twisted.ensureDeferred
async def test_a_change_is_an_event_and_an_audit_entry(store: AsyncDatabase, time: Time) -> None:
    """Both have user, robot, reason and connection."""
    record, robot, published = await made(store, time)
    record.note("control.lost", robot, ANN, "the connection has ended", moving=True)
    audit = await written(store)
    (event,) = published
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
async def test_many_changes_have_one_audit_entry_each(store: AsyncDatabase, time: Time) -> None:
    """Suppressing makes none."""
    record, robot, published = await made(store, time)
    record.note("robot.suppressed", robot, ANN, audit=False, resource="/cmd_vel")
    for _ in range(MANY):
        record.note("control.taken", robot, ANN)
    assert len(published) == MANY + 1
    audit = await written(store)
    assert len(audit) == MANY


@pytest_twisted.ensureDeferred
async def test_a_stop_is_stored_with_its_entry(store: AsyncDatabase, time: Time) -> None:
    """The stop stays stored until the robot confirms it; each order has its audit entry."""
    record, robot, published = await made(store, time)
    pending = DatabasePendingStops(store)
    order = StopRecord(robot.robot_id, "ann", "smoke", 1000.5, "press-1")
    record.note("robot.stopped", robot, ANN, "smoke")
    await pending.save_stop(order)
    assert await pending.pending_stop(robot) == order
    assert not await pending.delete_stop(robot, 999.0)
    assert await pending.delete_stop(robot, 1000.5)
    assert await pending.pending_stop(robot) is None
    for _ in range(MANY):
        record.note("robot.stopped", robot, ANN, "smoke")
    record.note("robot.stopped", robot, ANN, "smoke", audit=False)
    audit = await written(store)
    assert {each.kind for each in published} == {"robot.stopped"}
    assert len(audit) == MANY + 1
    assert audit[0].data == {"connection": 3, "why": "smoke"}
