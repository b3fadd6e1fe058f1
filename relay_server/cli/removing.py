"""How users, groups and robots are removed: found, asked about, taken out with an audit entry, told."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from sqlalchemy.orm import Session

from relay_db import queries
from relay_db.queries import GroupRecord, RobotRecord, UserRecord
from relay_server.cli.app import App, group_of, robot_of, sure, user_of
from relay_server.cli.output import tell


class _Kind(NamedTuple):
    """:param along: what goes with it, for the question"""

    find: Callable[[Session, str], UserRecord | GroupRecord | RobotRecord]
    delete: Callable[[Session, int], None]
    along: str


_KINDS = {
    "user": _Kind(user_of, queries.remove_user, "all rights and tokens"),
    "group": _Kind(group_of, queries.remove_group, "its rights"),
    "robot": _Kind(robot_of, queries.remove_robot, "its keys and all rights on it"),
}


def remove_named(app: App, what: str, name: str, yes: bool, as_json: bool) -> None:
    """Remove what has this name, once somebody has said that it may be.

    :param what: ``user``, ``group`` or ``robot``
    :param yes: don't ask
    :raises NotFound: there is none of this name
    """
    kind = _KINDS[what]
    with app.reading() as session:
        found = kind.find(session, name)
    sure(f"Remove {what} {found.name} with {kind.along}?", yes)
    with app.change() as change:
        found = kind.find(change.session, name)
        kind.delete(change.session, found.id)
        change.audit(f"{what}.remove", found.name)
    tell(as_json, {what: found.name, "removed": True}, f"Removed {what} {found.name}.")
