"""Audit entries of events that have already happened, queued in order while the database cannot be written.

An entry of a change that can still be refused is not written here but in the transaction of the change.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Collection, Iterator
from pathlib import Path

import msgspec
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from sqlalchemy.orm import Session
from twisted.internet.defer import Deferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_db import queries
from relay_protocol.errors import SwitchboardError
from relay_server.common.clock import Clock, Timer
from relay_server.common.concurrency import with_timeout
from relay_server.common.data_dir import private
from relay_server.common.database import AsyncDatabase

WAITING = 4096
"""Entries that wait at most. Later ones are lost, and counted in one entry that stands where they would."""

BATCH = 100
"""Entries of one transaction."""

RETRY_SECONDS = 1.0
"""Pause after a write that failed."""

CLOSE_SECONDS = 1.5
"""Time for the last write when the relay stops."""

FILE = "audit.waiting"
"""File in the data folder for entries that could not be written before the relay stopped, one JSON object a line."""

UNREADABLE = "audit.unreadable"
"""A copy of that file if some lines cannot be read, for an operator to look at."""

LOST = "audit.lost"
"""Action of the entry that stands for lost ones, and kind of the event about each robot concerned."""

WRITTEN = "audit.written"
"""Kind of the event that is published when the entry about lost ones is in the database."""

Notify = Callable[[str, int], None]
"""Is given :data:`LOST` or :data:`WRITTEN`, and the number of a robot."""


class AuditLogEntry(msgspec.Struct):
    """One entry; see :func:`relay_db.queries.audit.append_audit`.

    :param at: Unix seconds at which it happened
    :param robots: numbers of the robots it is about
    """

    at: float
    actor: str
    action: str
    target: str
    origin: str = ""
    data: dict[str, object] = {}
    robots: tuple[int, ...] = ()


class AuditLog(Collector):
    """Writes entries one batch after another, and keeps entries that the database does not accept.

    :param folder: the relay's data folder
    :param notify: called when entries about a robot are lost, and when that is on record
    """

    log = Logger()

    def __init__(self, clock: Clock, store: AsyncDatabase, folder: Path, notify: Notify) -> None:
        self._clock = clock
        self._store = store
        self._path = folder / FILE
        self._notify = notify
        self._entries: deque[AuditLogEntry] = deque()
        self._in_transaction = 0
        """The number of entries, from the first, in the running transaction."""
        self._maybe_written = 0
        """The number of entries, from the first, that may be written already: a commit can succeed and still raise."""
        self._batch = BATCH
        self._writing = False
        self._retry: Timer | None = None
        self._idle: list[Deferred[None]] = []
        self._restored = False
        """Whether the file's entries are not all in the database yet."""
        self._closed = False
        self._delayed = False
        self.lost = 0

    def collect(self) -> Iterator[Metric]:
        """One reading for Prometheus."""
        waiting = len(self._entries)
        yield GaugeMetricFamily("switchboard_audit_waiting", "Audit entries not in the database yet", waiting)
        yield CounterMetricFamily("switchboard_audit_lost", "Audit entries lost", self.lost)

    def append(self, entry: AuditLogEntry) -> None:
        """Write an entry as soon as the database accepts it."""
        if len(self._entries) >= WAITING:
            self._drop(entry)
            return
        self._entries.append(entry)
        self._write()

    def restore(self) -> None:
        """Load the entries that an earlier relay could not write.

        Lines that can't be read are counted as lost, and the file is kept as :data:`UNREADABLE`.
        """
        try:
            lines = self._path.read_bytes().splitlines()
        except FileNotFoundError:
            return
        except OSError as error:
            self.log.error(
                "audit entries of an earlier run stay in {file}: {reason}", file=FILE, reason=error.strerror
            )
            return
        unreadable = 0
        for line in lines[: WAITING + 1]:
            try:
                self._entries.append(msgspec.json.decode(line, type=AuditLogEntry))
            except (msgspec.MsgspecError, UnicodeDecodeError):
                unreadable += 1
        if unreadable or len(lines) > WAITING + 1:
            self._copy_unreadable(lines, unreadable)
        self._restored = True
        self._maybe_written = len(self._entries)
        self._write()

    def _copy_unreadable(self, lines: list[bytes], unreadable: int) -> None:
        lost = unreadable + max(0, len(lines) - WAITING - 1)
        self.lost += lost
        self.log.error(
            "{count} audit entries in {file} can't be read or are too many; a copy of the file is {copy}",
            count=lost,
            file=FILE,
            copy=UNREADABLE,
        )
        try:
            with private(self._path.with_name(UNREADABLE)) as stream:
                stream.writelines(line + b"\n" for line in lines)
        except OSError as error:
            self.log.error("{copy} can't be written: {reason}", copy=UNREADABLE, reason=error.strerror)

    async def close(self) -> None:
        """Write the queue into the database, or else into a file that the next relay reads."""
        late = f"the database has not taken them within {CLOSE_SECONDS:g} s"
        try:
            await with_timeout(self._clock, CLOSE_SECONDS, self.flush(), late)
        except SwitchboardError as error:
            reason = str(error)
        else:
            return
        self._closed = True
        try:
            self._save()
            self.log.warn(
                "{count} audit entries wait in {file} for the next start: {reason}",
                count=len(self._entries),
                file=FILE,
                reason=reason,
            )
        except OSError as error:
            for entry in self._entries:
                self.log.critical("not on record, {reason}: {entry}", reason=error.strerror, entry=entry)

    def _save(self) -> None:
        fresh = self._path.with_suffix(".new")
        with private(fresh) as stream:
            stream.writelines(msgspec.json.encode(entry) + b"\n" for entry in self._entries)
            stream.flush()
            os.fsync(stream.fileno())
        fresh.replace(self._path)

    async def flush(self) -> None:
        """Wait until all is written; a pause after a failure ends at once."""
        if self._entries:
            idle: Deferred[None] = Deferred()
            self._idle.append(idle)
            if self._retry is not None:
                self._retry.cancel()
                self._retry_write()
            await idle

    # --- writing ------------------------------------------------------------------------------------------

    def _drop(self, entry: AuditLogEntry) -> None:
        """An entry finds no room."""
        self.log.error(
            "'{action}' of {target} by {actor} is not on record: the database does not keep up",
            action=entry.action,
            target=entry.target,
            actor=entry.actor,
        )
        self._count(entry)

    def _count(self, entry: AuditLogEntry) -> None:
        """Count a lost entry, in the entry about lost ones at the end."""
        self.lost += 1
        last = self._entries[-1] if self._entries else None
        if last is None or last.action != LOST or len(self._entries) == self._in_transaction:
            last = AuditLogEntry(entry.at, "relay", LOST, "audit log", data={"count": 0})
            self._entries.append(last)
        self._entries[-1] = msgspec.structs.replace(
            last,
            data={"count": int(str(last.data["count"])) + 1, "until": entry.at},
            robots=tuple({*last.robots, *entry.robots}),
        )
        for robot in entry.robots:
            self._notify(LOST, robot)

    def _write(self) -> None:
        if self._writing or self._closed or self._retry is not None or not self._entries:
            return
        self._in_transaction = min(self._batch, len(self._entries))
        batch = [self._entries[index] for index in range(self._in_transaction)]
        self._writing = True
        writing = Deferred.fromCoroutine(self._store.write(_append, batch, self._maybe_written))
        writing.addCallbacks(self._done, self._failed, callbackArgs=(batch,), errbackArgs=(batch,))
        writing.addErrback(lambda failure: self.log.failure("writing the audit log failed", failure))
        writing.addBoth(lambda _: self._go_on())

    def _done(self, _: object, batch: Collection[AuditLogEntry]) -> None:
        self._remove_first(len(batch))
        self._batch = BATCH
        if self._delayed and not self._entries:
            self._delayed = False
            self.log.info("all audit entries are in the database again")
        for entry in batch:
            for robot in entry.robots if entry.action == LOST else ():
                self._notify(WRITTEN, robot)

    def _failed(self, failure: Failure, batch: list[AuditLogEntry]) -> None:
        self._maybe_written = max(self._maybe_written, len(batch))
        if failure.check(SwitchboardError):
            if not self._delayed:
                self._delayed = True
                self.log.warn("audit entries wait for the database: {reason}", reason=failure.value)
            self._retry = self._clock.callLater(RETRY_SECONDS, self._retry_write)
        elif len(batch) > 1:
            # One of them can't be written at all. The others must not wait behind it.
            self._batch = 1
        else:
            self.log.failure("not on record: {entry}", failure, entry=batch[0])
            self._remove_first(1)
            if batch[0].action == LOST:
                # Nothing follows it that could fail in the same way again, without end.
                self.lost += 1
            else:
                self._count(batch[0])

    def _remove_first(self, count: int) -> None:
        for _ in range(count):
            self._entries.popleft()
        self._in_transaction = 0
        self._maybe_written = max(0, self._maybe_written - count)

    def _retry_write(self) -> None:
        self._retry = None
        self._write()

    def _go_on(self) -> None:
        self._writing = False
        self._in_transaction = 0
        if self._restored and not self._maybe_written and not self._closed:
            self._restored = False
            self._path.unlink(missing_ok=True)
        self._write()
        if not self._entries:
            idle, self._idle = self._idle, []
            for each in idle:
                if not each.called:
                    each.callback(None)


def _append(s: Session, batch: list[AuditLogEntry], maybe_written: int) -> None:
    """:param maybe_written: entries, from the first, that may be in the database already"""
    written = queries.recent_audit_keys(s, min(entry.at for entry in batch)) if maybe_written else frozenset()
    for number, entry in enumerate(batch):
        if (
            number < maybe_written
            and queries.audit_key(entry.at, entry.actor, entry.action, entry.target) in written
        ):
            continue
        queries.append_audit(
            s,
            at=entry.at,
            actor=entry.actor,
            action=entry.action,
            target=entry.target,
            origin=entry.origin,
            data=entry.data,
        )
