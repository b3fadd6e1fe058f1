"""Which relay of a cluster each robot is connected to.

Each connection of a robot has a number, its epoch. The connection with the highest epoch counts, and the relays of all
others close theirs.
"""

from __future__ import annotations

from sqlalchemy import insert, select, update
from sqlalchemy.orm import Session

from relay_db.models import HomeRelay, Robot
from relay_db.queries.records import HomeRelayRecord, fetch_all
from relay_protocol.errors import NotFound


def claim_home_relay(s: Session, robot_id: int, relay: str) -> int:
    """Record that a robot connects to a relay.

    :param relay: the relay's id
    :returns: the epoch of the connection
    :raises NotFound: no such robot
    """
    if s.scalar(select(Robot.id).where(Robot.id == robot_id).with_for_update()) is None:
        raise NotFound("there is no such robot")
    next_epoch = HomeRelay.epoch + 1
    changed = (
        update(HomeRelay)
        .where(HomeRelay.robot_id == robot_id)
        .values(relay=relay, epoch=next_epoch)
        .returning(HomeRelay.epoch)
    )
    epoch = s.scalar(changed)
    if epoch is None:
        epoch = 1
        s.execute(insert(HomeRelay).values(robot_id=robot_id, relay=relay, epoch=epoch))
    return epoch


def reclaim_home_relay(s: Session, robot_id: int, relay: str, epoch: int) -> int | None:
    """Record a relay as the home of a robot that has none.

    :param epoch: of the robot's latest connection, which has ended
    :returns: the new epoch; ``None`` if the robot has a newer connection, or a home
    """
    given_up = (HomeRelay.robot_id == robot_id) & (HomeRelay.relay == "") & (HomeRelay.epoch == epoch)
    changed = (
        update(HomeRelay).where(given_up).values(relay=relay, epoch=epoch + 1).returning(HomeRelay.epoch)
    )
    return s.scalar(changed)


def release_home_relay(s: Session, robot_id: int, relay: str, epoch: int) -> None:
    """Record that a connection of a robot has ended; nothing changes if the robot has a newer one."""
    mine = (HomeRelay.robot_id == robot_id) & (HomeRelay.relay == relay) & (HomeRelay.epoch == epoch)
    s.execute(update(HomeRelay).where(mine).values(relay=""))


def home_relay(s: Session, robot_id: int) -> str:
    """The id of the relay that a robot has connected to last; empty if that connection has ended, or there was none."""
    return s.scalar(select(HomeRelay.relay).where(HomeRelay.robot_id == robot_id)) or ""


def home_relays(s: Session) -> list[HomeRelayRecord]:
    """All robots that have ever been connected to a relay of a cluster."""
    return fetch_all(s, HomeRelayRecord, select(HomeRelay.robot_id, HomeRelay.relay, HomeRelay.epoch))
