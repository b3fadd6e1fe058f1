"""Orders to stop, stored until the robot has confirmed them, also while no relay runs."""

from __future__ import annotations

from sqlalchemy import delete, insert, select
from sqlalchemy.orm import Session

from relay_db.models import HomeRelay, Robot, StopOrder
from relay_db.names import sanitise
from relay_db.queries.records import StopRecord, fetch_all
from relay_db.queries.revision import bump
from relay_protocol.errors import NotFound
from relay_protocol.limits import REASON_LENGTH, STOP_ID_LENGTH


class RobotMoved(Exception):
    """A robot is connected to another relay than was thought."""


def store_stop(
    s: Session,
    robot_id: int,
    by: str,
    why: str,
    at: float,
    stop_id: str = "",
    *,
    announce: bool = False,
    home: str = "",
) -> StopRecord:
    """Store an order to stop. It replaces one that the robot has not confirmed yet.

    :param by: name of the user, for display
    :param why: the reason, cut to :data:`relay_protocol.limits.REASON_LENGTH`
    :param at: Unix seconds
    :param stop_id: see :class:`StopRecord`
    :param announce: whether to count up the revision, so that other relays read it at once
    :param home: id of the relay that the robot is connected to; empty: that does not matter
    :raises NotFound: no such robot
    :raises RobotMoved: the robot is connected to another relay than ``home``; nothing is stored
    """
    if announce:
        # First, as in every change: other transactions lock in this order.
        bump(s)
    if s.scalar(select(Robot.id).where(Robot.id == robot_id).with_for_update()) is None:
        raise NotFound("there is no such robot")
    if home and s.scalar(select(HomeRelay.relay).where(HomeRelay.robot_id == robot_id)) not in (
        None,
        "",
        home,
    ):
        raise RobotMoved
    s.execute(delete(StopOrder).where(StopOrder.robot_id == robot_id))
    reason, stop_id = sanitise(why, REASON_LENGTH), sanitise(stop_id, STOP_ID_LENGTH)
    order = StopRecord(robot_id, sanitise(by), reason, float(at), stop_id)
    s.execute(insert(StopOrder).values(**order._asdict()))
    return order


def store_stop_once(s: Session, robot_id: int, by: str, why: str, at: float, stop_id: str) -> bool:
    """Store an order to stop for a relay that runs, or for the next one that does.

    It counts up the revision, so that a running relay sends the order at once. Parameters and errors are those of
    :func:`store_stop`.

    :returns: false if the order is stored already: the relay has received it by another path
    """
    stored = pending_stop(s, robot_id)
    if stored is not None and stop_id and (stored.by, stored.stop_id) == (by, stop_id):
        return False
    store_stop(s, robot_id, by, why, at, stop_id, announce=True)
    return True


def delete_stop(s: Session, robot_id: int, at: float | None = None, *, announce: bool = False) -> bool:
    """Remove an order to stop; false if there was none.

    :param at: only the order of this time, Unix seconds; ``None`` for any order
    :param announce: as of :func:`store_stop`
    """
    if announce:
        bump(s)
    order = delete(StopOrder).where(StopOrder.robot_id == robot_id)
    if at is not None:
        order = order.where(StopOrder.at == at)
    return s.scalar(order.returning(StopOrder.robot_id)) is not None


def pending_stop(s: Session, robot_id: int) -> StopRecord | None:
    """The order that a robot has not confirmed yet."""
    return next(iter(_orders(s, robot_id)), None)


def pending_stops(s: Session) -> list[StopRecord]:
    """All orders that robots have not confirmed yet."""
    return _orders(s)


def _orders(s: Session, robot_id: int | None = None) -> list[StopRecord]:
    query = select(StopOrder.robot_id, StopOrder.by, StopOrder.why, StopOrder.at, StopOrder.stop_id).order_by(
        StopOrder.robot_id
    )
    if robot_id is not None:
        query = query.where(StopOrder.robot_id == robot_id)
    return fetch_all(s, StopRecord, query)
