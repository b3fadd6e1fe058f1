"""How users, groups and robots are removed, and tokens and programs revoked: found, asked about, on record, told."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from sqlalchemy.orm import Session

from relay_db.names import full_name_of
from relay_db.queries import GroupRecord, RobotRecord, UserRecord
from relay_protocol.errors import Invalid, NotFound, Unavailable
from relay_server.cli.app import App, LocalChange, group_of, robot_of, sure, user_of
from relay_server.cli.output import file_size, tell


class _Kind(NamedTuple):
    """:param along: what goes with it, for the question"""

    find: Callable[[Session, str], UserRecord | GroupRecord | RobotRecord]
    along: str


_KINDS = {
    "user": _Kind(user_of, "all rights and tokens"),
    "group": _Kind(group_of, "its rights"),
    "robot": _Kind(robot_of, "its keys and all rights on it"),
}


def remove_named(app: App, what: str, name: str, yes: bool, as_json: bool) -> None:
    """Remove what has this name, once somebody has said that it may be.

    :param what: ``user``, ``group`` or ``robot``
    :param yes: don't ask
    :raises NotFound: there is none of this name
    :raises Unavailable: what is recorded of a robot can't be told
    """
    kind = _KINDS[what]
    with app.reading() as session:
        found = kind.find(session, name)
    if isinstance(found, RobotRecord) and full_name_of(name) != found.full:
        raise Invalid(
            f"'{name}' is {found.full}, which is shared: 'switchboard robot unshare' takes it out of the realm, "
            f"'switchboard robot remove {found.full}' removes it"
        )
    recordings = _recordings(app, found.id) if what == "robot" else None
    also = f", and {recordings.words}" if recordings else ""
    sure(f"Remove {what} {found.full} with {kind.along}{also}?", yes)
    with app.change() as change:
        found = kind.find(change.session, name)
        if isinstance(found, UserRecord):
            change.remove_user(found)
        elif isinstance(found, GroupRecord):
            change.remove_group(found)
        else:
            change.remove_robot(found, recordings.number if recordings else 0)
    answer: dict[str, Any] = {what: found.full, "removed": True}
    sentences = [f"Removed {what} {found.full}."]
    if recordings:
        answer["recordings"] = recordings.number
        sentences.append(f"The relay deletes {recordings.words}: now if it runs, else when it starts.")
    tell(as_json, answer, *sentences)


def revoke_numbered(
    app: App, what: str, number: int, revoke: Callable[[LocalChange, int], bool], as_json: bool
) -> None:
    """Make worthless what has this number, with an audit entry.

    :param what: ``token`` or ``program``
    :param revoke: false when there is none
    :raises NotFound: there is none of this number
    """
    with app.change() as change:
        if not revoke(change, number):
            raise NotFound(f"there is no {what} {number}; see 'switchboard {what} list'")
    tell(as_json, {"id": number, "revoked": True}, f"Revoked {what} {number}.")


class _StoredRecordings(NamedTuple):
    """What is recorded of a robot."""

    number: int
    words: str


def _recordings(app: App, robot_id: int) -> _StoredRecordings | None:
    # Late: what recordings need is more than other commands do.
    from relay_server.recordings.library import FOLDER, kept_of

    try:
        count, size = kept_of(app.data / FOLDER, robot_id)
    except OSError as error:
        raise Unavailable(f"the folder of recordings can't be read: {error.strerror}") from None
    if not count:
        return None
    return _StoredRecordings(count, f"its {count} recording{'s' if count > 1 else ''} ({file_size(size)})")
