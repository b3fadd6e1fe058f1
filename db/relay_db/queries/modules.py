"""The modules of robots as last reported, and orders to modules of robots that are offline.

Both are stored, so that they outlast the relay.
"""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy import delete, func, insert, select, update
from sqlalchemy.orm import Session

from relay_db.models import ModuleOrder, ModuleReport, Robot
from relay_db.names import sanitise
from relay_db.queries.records import ModuleOrderRecord, ModuleReportRecord, fetch_all, fetch_one
from relay_protocol.errors import NotFound, Unavailable

MAX_ORDERS = 64
"""Most stored orders of one robot; each module has one."""

LATE_SECONDS = 3600.0
"""A stored report newer by more than this came from a wrong clock, and is replaced."""


def store_module_order(
    s: Session, robot_id: int, module: str, *, start: bool, user_id: int | None, by: str, at: float
) -> ModuleOrderRecord:
    """Store an order. It replaces a stored one for the same module.

    :param start: true to start the module, false to stop it
    :param user_id: ``None`` for the command line on the relay's machine
    :param by: the user as shown at the robot; of the operating system for the command line
    :param at: Unix seconds
    :raises NotFound: no such robot
    :raises Unavailable: too many orders are stored for the robot
    """
    if s.scalar(select(Robot.id).where(Robot.id == robot_id).with_for_update()) is None:
        raise NotFound("there is no such robot")
    remove_module_order(s, robot_id, module)
    pending = select(func.count()).where(ModuleOrder.robot_id == robot_id, ModuleOrder.refused_at.is_(None))
    count = s.scalar(pending)
    if (count or 0) >= MAX_ORDERS:
        raise Unavailable(
            f"{MAX_ORDERS} orders to modules of this robot are stored already; wait until it is online"
        )
    order = ModuleOrderRecord(robot_id, module, start, user_id, sanitise(by), float(at))
    s.execute(insert(ModuleOrder).values(**order._asdict()))
    return order


def remove_module_order(s: Session, robot_id: int, module: str, at: float | None = None) -> None:
    """Remove a stored order, if there is one.

    :param at: only the order of this time, Unix seconds; ``None`` for any
    """
    order = delete(ModuleOrder).where(ModuleOrder.robot_id == robot_id, ModuleOrder.module == module)
    if at is not None:
        order = order.where(ModuleOrder.at == at)
    s.execute(order)


def is_module_order_pending(s: Session, order: ModuleOrderRecord) -> bool:
    """Whether an order is still stored as it is: not carried out, refused or replaced by a later one."""
    return order.refused_at is None and order in module_orders(s, order.robot_id)


def refuse_module_order(s: Session, order: ModuleOrderRecord, now: float, why: str) -> None:
    """Keep a stored order as refused, so that users see it. Another one for the same module is left alone.

    :param now: Unix seconds
    :param why: in words
    """
    s.execute(
        update(ModuleOrder)
        .where(
            ModuleOrder.robot_id == order.robot_id,
            ModuleOrder.module == order.module,
            ModuleOrder.at == order.at,
        )
        .values(refused_at=now, refusal=sanitise(why))
    )


def remove_refused_module_orders(s: Session, robot_id: int, before: float) -> None:
    """Remove orders of a robot that were refused before a time, Unix seconds."""
    s.execute(delete(ModuleOrder).where(ModuleOrder.robot_id == robot_id, ModuleOrder.refused_at < before))


def module_orders(s: Session, robot_id: int) -> list[ModuleOrderRecord]:
    """The stored orders of a robot, pending and refused, the oldest first."""
    query = (
        select(
            ModuleOrder.robot_id,
            ModuleOrder.module,
            ModuleOrder.start,
            ModuleOrder.user_id,
            ModuleOrder.by,
            ModuleOrder.at,
            ModuleOrder.refused_at,
            ModuleOrder.refusal,
        )
        .where(ModuleOrder.robot_id == robot_id)
        .order_by(ModuleOrder.at, ModuleOrder.module)
    )
    return fetch_all(s, ModuleOrderRecord, query)


def store_module_reports(s: Session, reports: Iterable[ModuleReportRecord]) -> None:
    """Store reports of robots. Robots that were removed, and those with a newer report, are left out.

    One that is newer by more than :data:`LATE_SECONDS` is replaced: a clock was wrong.
    """
    wanted = {each.robot_id: each for each in reports}
    robots = select(Robot.id).where(Robot.id.in_(wanted)).order_by(Robot.id).with_for_update()
    known = set(s.scalars(robots))
    stored = select(ModuleReport.robot_id, ModuleReport.at).where(ModuleReport.robot_id.in_(known))
    newer = {row.robot_id for row in s.execute(stored) if 0 < row.at - wanted[row.robot_id].at < LATE_SECONDS}
    written = known - newer
    if written:
        s.execute(delete(ModuleReport).where(ModuleReport.robot_id.in_(written)))
        s.execute(insert(ModuleReport), [wanted[each]._asdict() for each in sorted(written)])


def module_reports(s: Session) -> list[ModuleReportRecord]:
    """The stored reports of all robots."""
    query = select(ModuleReport.robot_id, ModuleReport.at, ModuleReport.modules)
    return fetch_all(s, ModuleReportRecord, query)


def module_report(s: Session, robot_id: int) -> ModuleReportRecord | None:
    """The stored report of a robot; ``None`` if it has never reported its modules."""
    query = select(ModuleReport.robot_id, ModuleReport.at, ModuleReport.modules)
    return fetch_one(s, ModuleReportRecord, query.where(ModuleReport.robot_id == robot_id))
