"""Pipes, which carry messages of one robot to another."""

from __future__ import annotations

from typing import NamedTuple

from sqlalchemy import delete, func, insert, or_, select, update
from sqlalchemy.orm import Session

from relay_db.models import Pipe, Realm, User
from relay_db.names import sanitise
from relay_db.queries.records import PipeRecord, UserRecord, record_of
from relay_db.queries.sharing import linked_account_in
from relay_db.queries.users import get_user
from relay_protocol.errors import Invalid, NotFound, Refused
from relay_protocol.realms import full_name

MAX_PIPES = 1000
"""Most pipes of one realm."""

MAX_PIPES_OF_USER = 750


class NewPipeRow(NamedTuple):
    """A pipe to add; see :class:`PipeRecord`."""

    name: str
    owner_id: int
    source_robot_id: int
    source_account_id: int
    target_robot_id: int
    target_account_id: int
    settings: str
    enabled: bool


def add_pipe(s: Session, new: NewPipeRow) -> PipeRecord:
    """Add a pipe to the realm of its owner.

    :raises NotFound: the owner was removed
    :raises Invalid: the realm has a pipe of this name
    :raises Refused: the realm or the owner has too many
    """
    realm_id = s.scalar(select(User.realm_id).where(User.id == new.owner_id).with_for_update())
    if realm_id is None:
        raise NotFound("there is no such user")
    if s.scalar(select(Pipe.id).where(Pipe.realm_id == realm_id, Pipe.name == new.name)) is not None:
        raise Invalid(f"there is a pipe '{new.name}' already; choose another name")
    count = s.scalar(select(func.count()).select_from(Pipe).where(Pipe.realm_id == realm_id)) or 0
    if count >= MAX_PIPES:
        raise Refused(f"the realm has {MAX_PIPES} pipes, the most it may have; remove one")
    own = s.scalar(select(func.count()).select_from(Pipe).where(Pipe.owner_id == new.owner_id)) or 0
    if own >= MAX_PIPES_OF_USER:
        raise Refused(f"{MAX_PIPES_OF_USER} pipes are the most that one user may have; remove one")
    s.execute(insert(Pipe).values(realm_id=realm_id, moves=False, reason="", **new._asdict()))
    (added,) = [each for each in list_pipes(s) if each.name == new.name and each.owner_id == new.owner_id]
    return added


def list_pipes(s: Session) -> list[PipeRecord]:
    """All pipes of all realms, by name."""
    columns = (
        Pipe.id,
        Pipe.name,
        Realm.name.label("realm"),
        Pipe.owner_id,
        User.name.label("owner"),
        Pipe.source_robot_id,
        Pipe.source_account_id,
        Pipe.target_robot_id,
        Pipe.target_account_id,
        Pipe.settings,
        Pipe.enabled,
        Pipe.moves,
        Pipe.reason,
    )
    query = (
        select(*columns)
        .join(Realm, Realm.id == Pipe.realm_id)
        .join(User, User.id == Pipe.owner_id)
        .order_by(Pipe.name, Pipe.id)
    )
    rows = s.execute(query)
    return [record_of(PipeRecord, row, owner=full_name(row.owner, row.realm)) for row in rows]


def enable_pipe(
    s: Session, pipe_id: int, enabled: bool, *, reason: str = "", moves: bool | None = None
) -> bool | None:
    """Store whether a pipe is to run; whether that is new, or ``None`` if there is none of this number.

    :param reason: why it ended, if the relay ended it
    :param moves: whether it moves a robot; ``None``: as before
    """
    values = {"enabled": enabled, "reason": sanitise(reason)}
    if moves is not None:
        values["moves"] = moves
    old = [getattr(Pipe, name) != value for name, value in values.items()]
    changed = update(Pipe).where(Pipe.id == pipe_id, or_(*old)).values(**values).returning(Pipe.id)
    if s.scalar(changed) is not None:
        return True
    return None if s.scalar(select(Pipe.id).where(Pipe.id == pipe_id)) is None else False


def remove_pipe(s: Session, pipe_id: int) -> bool:
    """Remove a pipe; false if there is none of this number."""
    return s.scalar(delete(Pipe).where(Pipe.id == pipe_id).returning(Pipe.id)) is not None


def pipe_accounts(s: Session, owner_id: int, realms: tuple[str | None, str | None]) -> list[UserRecord]:
    """The accounts by which a user reaches robots in these realms, in the same order.

    :param realms: ``None`` for the realm of the user
    :raises NotFound: the user has no account in a realm
    """
    found = []
    for realm in realms:
        account = get_user(s, owner_id) if realm is None else linked_account_in(s, owner_id, realm)
        if account is None:
            raise NotFound(f"there is no such robot, or you have no account in the realm '{realm}'")
        found.append(account)
    return found
