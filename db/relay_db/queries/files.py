"""Files of robots: their names, states and sizes. The contents are in the relay's file storage."""

from __future__ import annotations

import sys
from collections.abc import Collection
from typing import Any, NamedTuple

from sqlalchemy import ColumnElement, and_, delete, func, insert, or_, select, update
from sqlalchemy.orm import Session

from relay_db.models import FileUsage, Realm, Robot, StoredFile
from relay_db.queries.records import FileRecord, FileUsageRecord, fetch_all, fetch_one
from relay_protocol.errors import Invalid, NotFound, Refused

MIN_CHARGED_BYTES = 4096
"""Bytes that count for a file at least, so that the number of small files is bounded too."""

INCOMING, STORED, REMOVING = "incoming", "stored", "removing"

NO_FILE = "there is no such file"


class FileQuotaExceeded(Refused):
    """The files of a robot or realm may take no more space."""

    code = "quota"


class NewFile(NamedTuple):
    """A file to add; see :class:`FileRecord`."""

    name: str
    sha256: str
    size: int
    origin: str
    modified: float


class FileQuotas(NamedTuple):
    """Most bytes of all files of a robot, of a realm, and of the relay."""

    robot: int
    realm: int
    relay: int


_COLUMNS = (
    StoredFile.id,
    StoredFile.robot_id,
    StoredFile.name,
    StoredFile.sha256,
    StoredFile.size,
    StoredFile.state,
    StoredFile.origin,
    StoredFile.modified,
    StoredFile.state_since,
)


def charged_bytes(size: int) -> int:
    """Bytes that count for a file of this size."""
    return max(size, MIN_CHARGED_BYTES)


def add_file(s: Session, robot_id: int, new: NewFile, quotas: FileQuotas, now: float) -> FileRecord:
    """Add a file that is about to be uploaded, or return the one of this name and content that exists.

    :raises NotFound: the robot was removed
    :raises FileQuotaExceeded: a quota is used up; names it
    :raises Invalid: the file that exists has another size
    """
    realm_id = s.scalar(select(Robot.realm_id).where(Robot.id == robot_id))
    if realm_id is None:
        raise NotFound("the robot was removed")
    usage = _locked_usage(s, robot_id, realm_id)
    same = and_(StoredFile.robot_id == robot_id, StoredFile.name == new.name, StoredFile.sha256 == new.sha256)
    found = fetch_one(s, FileRecord, select(*_COLUMNS).where(same))
    if found is not None:
        if found.size != new.size:
            raise Invalid(f"the file of this name and SHA-256 has {found.size} bytes, not {new.size}")
        touch_file(s, found.id, now)
        return found
    # Files of other robots count as well, so they are added one after another.
    s.execute(select(Realm.id).order_by(Realm.id).limit(1).with_for_update())
    _check_quotas(s, realm_id, usage, charged_bytes(new.size), quotas)
    values = {"robot_id": robot_id, "state": INCOMING, "state_since": now, **new._asdict()}
    s.execute(insert(StoredFile).values(**values))
    _count(s, robot_id, 1, charged_bytes(new.size))
    added = fetch_one(s, FileRecord, select(*_COLUMNS).where(same))
    assert added is not None
    return added


def _locked_usage(s: Session, robot_id: int, realm_id: int) -> int:
    """Bytes of a robot's files. Other changes of them wait for this transaction."""
    query = select(FileUsage.bytes).where(FileUsage.robot_id == robot_id).with_for_update()
    used = s.scalar(query)
    if used is None:
        s.execute(insert(FileUsage).values(robot_id=robot_id, realm_id=realm_id, files=0, bytes=0))
    return used or 0


def _check_quotas(s: Session, realm_id: int, used: int, more: int, quotas: FileQuotas) -> None:
    if used + more > quotas.robot:
        raise FileQuotaExceeded(_quota_message("this robot", used, more, quotas.robot))
    in_realm = usage_of_realm(s, realm_id).bytes
    if in_realm + more > quotas.realm:
        raise FileQuotaExceeded(_quota_message("this realm", in_realm, more, quotas.realm))
    if _usage(s, select(func.sum(FileUsage.files), func.sum(FileUsage.bytes))).bytes + more > quotas.relay:
        raise FileQuotaExceeded("the relay's space for files is used up; its administrator can extend it")


def _quota_message(owner: str, used: int, more: int, quota: int) -> str:
    return (
        f"files of {owner} may take {quota / 1e6:,.1f} MB, of which {max(0, quota - used) / 1e6:,.1f} MB are left, "
        f"and this one needs {more / 1e6:,.1f} MB; delete files that are not needed"
    )


def file_stored(s: Session, file_id: int, now: float) -> bool:
    """The contents of a file are stored durably; false if it was removed meanwhile."""
    return _set_state(s, file_id, (INCOMING, STORED), STORED, now)


def file_lost(s: Session, file_id: int, now: float) -> bool:
    """The contents of a stored file are lost, so it is to be uploaded again; false if it was removed meanwhile."""
    return _set_state(s, file_id, (STORED,), INCOMING, now)


def begin_file_removal(s: Session, file_id: int, now: float) -> bool:
    """The contents of a file are about to be deleted; false if there is no such file."""
    return _set_state(s, file_id, (INCOMING, STORED, REMOVING), REMOVING, now)


def begin_purge(s: Session, file_id: int, incoming_before: float, now: float) -> bool:
    """The contents of a file are about to be deleted; false if it is none of :func:`files_to_delete` any more."""
    changed = (
        update(StoredFile)
        .where(StoredFile.id == file_id, _to_delete(incoming_before))
        .values(state=REMOVING, state_since=now)
        .returning(StoredFile.id)
    )
    return s.scalar(changed) is not None


def _to_delete(incoming_before: float) -> ColumnElement[bool]:
    orphan = ~select(Robot.id).where(Robot.id == StoredFile.robot_id).exists()
    stale = and_(StoredFile.state == INCOMING, StoredFile.state_since < incoming_before)
    return or_(StoredFile.state == REMOVING, stale, orphan)


def _set_state(s: Session, file_id: int, before: Collection[str], state: str, now: float) -> bool:
    changed = (
        update(StoredFile)
        .where(StoredFile.id == file_id, StoredFile.state.in_(before))
        .values(state=state, state_since=now)
        .returning(StoredFile.id)
    )
    return s.scalar(changed) is not None


def remove_file(s: Session, file_id: int) -> bool:
    """Remove a file whose contents are deleted; false if it was removed before."""
    removed = s.execute(
        delete(StoredFile).where(StoredFile.id == file_id).returning(StoredFile.robot_id, StoredFile.size)
    ).first()
    if removed is None:
        return False
    _count(s, removed.robot_id, -1, -charged_bytes(removed.size))
    return True


def _count(s: Session, robot_id: int, files: int, size: int) -> None:
    s.execute(
        update(FileUsage)
        .where(FileUsage.robot_id == robot_id)
        .values(files=FileUsage.files + files, bytes=FileUsage.bytes + size)
    )


def find_file(s: Session, robot_id: int, name: str, sha256: str | None = None) -> FileRecord:
    """The newest stored file of this name, or the one with this content.

    :raises NotFound: there is none
    """
    query = select(*_COLUMNS).where(_stored(robot_id), StoredFile.name == name)
    if sha256 is not None:
        query = query.where(StoredFile.sha256 == sha256)
    found = fetch_one(
        s, FileRecord, query.order_by(StoredFile.state_since.desc(), StoredFile.id.desc()).limit(1)
    )
    if found is None:
        raise NotFound(NO_FILE)
    return found


def file_exists(s: Session, file_id: int) -> bool:
    """Whether there is a file of this id, in any state."""
    return s.scalar(select(StoredFile.id).where(StoredFile.id == file_id)) is not None


def files_named(s: Session, robot_id: int, name: str) -> list[FileRecord]:
    """All files of this name, one for each content, the newest first, with those that are being uploaded."""
    existing = and_(StoredFile.robot_id == robot_id, StoredFile.state != REMOVING)
    query = select(*_COLUMNS).where(existing, StoredFile.name == name)
    return fetch_all(s, FileRecord, query.order_by(StoredFile.state_since.desc(), StoredFile.id.desc()))


def list_files(
    s: Session, robot_id: int, prefix: str, after: tuple[str, int] | None, limit: int
) -> list[FileRecord]:
    """Stored files by name, in the order of its bytes.

    :param prefix: of their names
    :param after: name and number of the file before the first
    """
    query = select(*_COLUMNS).where(_stored(robot_id))
    if prefix:
        query = query.where(StoredFile.name >= prefix)
        stop = _behind_prefix(prefix)
        if stop:
            query = query.where(StoredFile.name < stop)
    if after is not None:
        name, number = after
        behind = and_(StoredFile.name == name, StoredFile.id > number)
        # The first condition is for the index: neither database derives it from the second.
        query = query.where(StoredFile.name >= name, or_(StoredFile.name > name, behind))
    return fetch_all(s, FileRecord, query.order_by(StoredFile.name, StoredFile.id).limit(limit))


def _behind_prefix(prefix: str) -> str:
    """The first text behind all that begin with ``prefix``, in the order of code points, which is that of UTF-8's
    bytes; empty if there is none."""
    stem = prefix.rstrip(chr(sys.maxunicode))
    if not stem:
        return ""
    last = ord(stem[-1]) + 1
    # Surrogates have no UTF-8.
    return stem[:-1] + chr(0xE000 if 0xD800 <= last < 0xE000 else last)


def files_to_delete(s: Session, incoming_before: float, after: int, limit: int) -> list[FileRecord]:
    """Files whose contents are to be deleted: their removal has begun, their robot was removed, or their upload has not
    continued since ``incoming_before``, Unix seconds.

    :param after: id of the file before the first
    """
    query = select(*_COLUMNS).where(_to_delete(incoming_before), StoredFile.id > after)
    return fetch_all(s, FileRecord, query.order_by(StoredFile.id).limit(limit))


def touch_file(s: Session, file_id: int, now: float) -> None:
    """Note that the upload of a file continues."""
    s.execute(
        update(StoredFile)
        .where(StoredFile.id == file_id, StoredFile.state == INCOMING)
        .values(state_since=now)
    )


def usage_of_robot(s: Session, robot_id: int) -> FileUsageRecord:
    """Number and charged size of a robot's files."""
    return _usage(s, select(FileUsage.files, FileUsage.bytes).where(FileUsage.robot_id == robot_id))


def usage_of_realm(s: Session, realm_id: int) -> FileUsageRecord:
    """Number and charged size of the files of all robots of a realm."""
    summed = select(func.sum(FileUsage.files), func.sum(FileUsage.bytes))
    return _usage(s, summed.where(FileUsage.realm_id == realm_id))


def _usage(s: Session, query: Any) -> FileUsageRecord:
    row = s.execute(query).first()
    return FileUsageRecord(0, 0) if row is None else FileUsageRecord(int(row[0] or 0), int(row[1] or 0))


def _stored(robot_id: int) -> ColumnElement[bool]:
    return and_(StoredFile.robot_id == robot_id, StoredFile.state == STORED)
