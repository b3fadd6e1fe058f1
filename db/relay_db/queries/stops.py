"""Orders to stop, kept until the robot has confirmed them: they outlive the relay."""

from __future__ import annotations

from sqlalchemy import delete, insert, select
from sqlalchemy.orm import Session

from relay_db.models import Robot, StopOrder
from relay_db.names import sanitise
from relay_db.queries.records import StopRecord
from relay_db.queries.state import bump
from relay_protocol.errors import NotFound
from relay_protocol.limits import WORDS


def order_stop(s: Session, robot_id: int, by: str, why: str, at: float, *, tell: bool = False) -> StopRecord:
    """The robot is to stop; an order that it has not confirmed yet is replaced.

    :param by: who orders it, for people
    :param at: Unix seconds
    :param tell: a relay that runs is to look at once
    :raises NotFound: no such robot
    """
    if tell:
        bump(s)
    if s.scalar(select(Robot.id).where(Robot.id == robot_id).with_for_update()) is None:
        raise NotFound("there is no such robot")
    s.execute(delete(StopOrder).where(StopOrder.robot_id == robot_id))
    order = StopRecord(robot_id, sanitise(by), sanitise(why, WORDS), float(at))
    s.execute(insert(StopOrder).values(**order._asdict()))
    return order


def stop_told(s: Session, robot_id: int, at: float | None = None) -> bool:
    """The order given at this moment is not to be told any more; whether it still was.

    :param at: Unix seconds, as it was ordered; ``None`` for whatever order there is
    """
    order = delete(StopOrder).where(StopOrder.robot_id == robot_id)
    if at is not None:
        order = order.where(StopOrder.at == at)
    return s.scalar(order.returning(StopOrder.robot_id)) is not None


def pending_stop(s: Session, robot_id: int) -> StopRecord | None:
    """What the robot is still to be told."""
    return next(iter(_orders(s, robot_id)), None)


def pending_stops(s: Session) -> list[StopRecord]:
    """What robots are still to be told."""
    return _orders(s)


def _orders(s: Session, robot_id: int | None = None) -> list[StopRecord]:
    query = select(StopOrder.robot_id, StopOrder.by, StopOrder.why, StopOrder.at).order_by(StopOrder.robot_id)
    if robot_id is not None:
        query = query.where(StopOrder.robot_id == robot_id)
    return [StopRecord(*row) for row in s.execute(query)]
