"""Uploads the files of all groups, and deletes those whose group says so once the relay has confirmed them.

A file is hashed, offered, sent, and confirmed by the relay when its copy is durable. The files on the robot decide
everything: after a crash they are found again, and the relay says how far each has come.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from typing import Any, NamedTuple

from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.protocol import Factory
from twisted.logger import Logger

from relay_protocol import link
from relay_protocol.errors import SwitchboardError, Unavailable
from robot_client.alerts import AlertCondition, OnAlert
from robot_client.files.confirmed import ConfirmedFiles
from robot_client.files.file_link import FileConnection, FileRefused, build_file_link
from robot_client.files.folder import (
    FileState,
    FoundFile,
    OpenFile,
    UnusableName,
    check_name,
    delete_unchanged,
    find_files,
)
from robot_client.files.settings import FileGroupSettings
from robot_client.link.control_connection import Dial
from robot_client.link.tls import explain
from robot_client.link.transport import LinkProtocol

AT_ONCE = 8
"""Files that are uploaded at a time."""

BATCH = 256
"""Files that are remembered for upload at a time, so that memory does not grow with their number."""

SCAN_SECONDS = 5.0
"""Least seconds between two searches for files."""

SCAN_SHARE = 20
"""Searching takes at most one part in so many of the time."""

IDLE_SECONDS = 10.0
"""A link without files to upload is closed after this time."""

LINK_SECONDS = 10.0
"""After this time without a link the relay is asked again."""

MOST_DELAYED = 10_000
"""Files that are remembered because they are to be tried again later."""

MOST_HASHES = 1000
"""Files of which the hash is remembered until they are stored, so that a lost link does not cost it."""

MISMATCHES = 3
"""After this many copies in a row that differ from their file there is an alert."""

FILES = "files"
"""Kind of alerts about files."""


class _Candidate(NamedTuple):
    group: FileGroupSettings
    found: FoundFile

    @property
    def name(self) -> str:
        """The name at the relay."""
        return f"{self.group.name}/{self.found.path}"


class FileUploader:
    """Watches the groups of files while the robot is registered.

    :param in_thread: runs work in a thread
    :param full: whether memory or disk is critical
    :param now: clock of :mod:`relay_protocol.clocks`, nanoseconds
    :param wall: Unix time in seconds
    """

    def __init__(
        self,
        groups: Iterable[FileGroupSettings],
        confirmed: ConfirmedFiles,
        *,
        send: Callable[[link.Message], None],
        dial: Dial,
        clock: Any,
        in_thread: Callable[..., Deferred[Any]],
        full: Callable[[], bool],
        now: Callable[[], int],
        alert: OnAlert,
        wall: Callable[[], float] = time.time,
    ) -> None:
        self._groups = list(groups)
        self._confirmed = confirmed
        self._send = send
        self._dial = dial
        self._clock = clock
        self._in_thread = in_thread
        self._full = full
        self._now = now
        self._wall = wall
        self._log = Logger("files")
        self._problems = {each.name: AlertCondition(alert, FILES, each.name) for each in self._groups}
        self._folders = {
            each.name: AlertCondition(alert, FILES, f"{each.name}: folder") for each in self._groups
        }
        self._registered = False
        self._heartbeat = 1.0
        self._waiting: deque[_Candidate] = deque()
        self._under_way: set[str] = set()
        self._delayed: dict[str, float] = {}
        self._hashes: dict[str, tuple[FileState, str]] = {}
        self._mismatches: Counter[str] = Counter()
        self._connection: FileConnection | None = None
        self._asked_at: float | None = None
        self._attempt: Deferred[Any] | None = None
        self._busy_at = 0.0
        self._scanning = False
        self._next_scan = self._scan_seconds = 0.0
        self._search: Iterator[_Candidate] | None = None
        self._searched: list[FileGroupSettings] = []
        self._unreadable: dict[str, str] = {}
        """Why the folders of groups can't be searched, by group; written in threads."""
        self._stopped = False

    @property
    def remembered(self) -> int:
        """Files that wait or are being uploaded."""
        return len(self._waiting) + len(self._under_way)

    # --- events of the daemon -----------------------------------------------------------------------------

    def registered(self, heartbeat: float) -> None:
        """The control link is open.

        :param heartbeat: seconds
        """
        self._registered = True
        self._heartbeat = heartbeat
        self._asked_at = None
        self._next_scan = 0.0

    def link_lost(self, reason: str) -> None:
        """The control link is lost: uploads end, and continue when it is back."""
        self._registered = False
        self._close(reason)

    def stop(self, reason: str) -> None:
        """End everything."""
        self._stopped = True
        self.link_lost(reason)
        self._confirmed.close()

    def open(self, message: link.OpenFileLink) -> None:
        """The relay has given a ticket for a link: dial."""
        self._close("the relay opened it again")
        file_link = build_file_link(message.ticket, self._now, self._heartbeat)

        def build(protocol: LinkProtocol) -> FileConnection:
            return FileConnection(protocol, self._joined, self._lost)

        factory = Factory.forProtocol(lambda: LinkProtocol(file_link, build, self._clock))
        factory.noisy = False
        try:
            attempt = self._attempt = self._dial(message.address).connect(factory)
        except SwitchboardError as error:
            self._log.warn("the file link can't be opened: {reason}", reason=str(error))
            return
        attempt.addErrback(self._dial_failed)

    def check(self) -> None:
        """Find files, ask for a link, start uploads; to be called every second."""
        if not self._groups or not self._registered or self._stopped:
            return
        now = self._clock.seconds()
        if not self._waiting and not self._scanning and now >= self._next_scan:
            self._scan()
        connection = self._connection
        if self._waiting and connection is None:
            if self._asked_at is None or now - self._asked_at >= LINK_SECONDS:
                self._asked_at = now
                self._send(link.RequestFileLink())
        elif connection is not None:
            if self._waiting or self._under_way:
                self._busy_at = now
                self._start_uploads()
            elif now - self._busy_at > IDLE_SECONDS:
                connection.close("no files wait")

    # --- finding files ------------------------------------------------------------------------------------

    def _scan(self) -> None:
        self._scanning = True
        began = self._clock.seconds()
        if self._search is None:
            self._searched = [each for each in self._groups if each.when == "always" or self._full()]
            self._unreadable = {}
            self._search = self._find(self._searched, self._unreadable)

        def done(found: list[_Candidate]) -> None:
            self._scanning = False
            now = self._clock.seconds()
            self._scan_seconds += now - began
            if len(found) < BATCH:
                self._search = None
                self._update_folders()
                self._next_scan = now + max(SCAN_SECONDS, SCAN_SHARE * self._scan_seconds)
                self._scan_seconds = 0.0
                self._delayed = {name: until for name, until in self._delayed.items() if until > now}
            skipped = self._under_way | self._delayed.keys()
            self._waiting.extend(each for each in found if each.name not in skipped)
            self.check()

        search = self._search
        self._in_thread(lambda: list(islice(search, BATCH))).addCallbacks(done, self._scan_failed)

    def _scan_failed(self, failure: Any) -> None:
        self._scanning = False
        self._search = None
        self._next_scan = self._clock.seconds() + 60.0
        self._log.failure("searching for files failed", failure)

    def _update_folders(self) -> None:
        for group in self._searched:
            reason = self._unreadable.get(group.name, "")
            self._folders[group.name].update(
                reason and f"the folder of the file group {group.name} can't be read: {reason}",
                f"the folder of the file group {group.name} can be read again",
            )

    def _find(self, groups: list[FileGroupSettings], unreadable: dict[str, str]) -> Iterator[_Candidate]:
        """The files to upload, group by group. It is continued in threads, one batch after the other.

        :param unreadable: gets the groups whose folder can't be read, with the reason
        """
        for group in groups:
            try:
                yield from self._settled(group)
            except OSError as error:
                unreadable[group.name] = error.strerror or str(error)

    def _settled(self, group: FileGroupSettings) -> Iterator[_Candidate]:
        """Files of a group that are not written any more, and not confirmed yet."""
        for each in find_files(group.folder, group.patterns):
            age = self._wall() - each.state.modified / 1e9
            # A clock that was set back must not keep a file back for ever.
            if abs(age) < group.settle_seconds:
                continue
            if group.after == "delete" or not self._confirmed.has(group.name, each.path, each.state):
                yield _Candidate(group, each)

    # --- uploads ------------------------------------------------------------------------------------------

    def _start_uploads(self) -> None:
        while self._waiting and len(self._under_way) < AT_ONCE and self._connection is not None:
            candidate = self._waiting.popleft()
            self._under_way.add(candidate.name)
            done = Deferred.fromCoroutine(self._upload(candidate, self._connection))
            done.addErrback(self._upload_failed, candidate)
            done.addBoth(self._upload_ended, candidate)

    def _upload_ended(self, _: object, candidate: _Candidate) -> None:
        self._under_way.discard(candidate.name)
        self._clock.callLater(0, self.check)

    async def _upload(self, candidate: _Candidate, connection: FileConnection) -> None:
        """Upload one file, and delete it if its group says so.

        :raises OSError: it can't be read or deleted
        :raises SwitchboardError: the link is lost, or the relay refuses it
        """
        group, found = candidate
        check_name(candidate.name)
        try:
            file: OpenFile = await self._in_thread(OpenFile, group.folder, found.path)
        except FileNotFoundError:
            return
        try:
            sha256 = await self._hash(candidate.name, file)
            if file.changed() or file.state != found.state:
                self._delay(candidate, group.settle_seconds)
                return
            confirmed = await connection.upload(
                lambda number: link.OfferFile(
                    upload=number,
                    group=group.name,
                    name=candidate.name,
                    size=file.state.size,
                    sha256=sha256,
                    modified=max(0.0, file.state.modified / 1e9),
                ),
                lambda offset, size: self._in_thread(file.read, offset, size),
            )
            unchanged = confirmed == sha256 and not file.changed()
        finally:
            file.close()
        if unchanged:
            await self._stored(candidate)
        else:
            self._delay(candidate, group.settle_seconds)

    async def _hash(self, name: str, file: OpenFile) -> str:
        """The hash of a file, hexadecimal.

        :raises OSError: it can't be read
        :raises SwitchboardError: the daemon is shutting down
        """
        state, sha256 = self._hashes.get(name, (None, ""))
        if state == file.state:
            return sha256
        while await self._in_thread(file.hash_part):
            if self._stopped:
                raise Unavailable("the robot's daemon is shutting down")
        if len(self._hashes) >= MOST_HASHES:
            del self._hashes[next(iter(self._hashes))]
        self._hashes[name] = file.state, file.sha256
        return file.sha256

    async def _stored(self, candidate: _Candidate) -> None:
        """The relay has confirmed the file as it is now."""
        group, found = candidate
        self._hashes.pop(candidate.name, None)
        self._mismatches.pop(candidate.name, None)
        self._problems[group.name].update("", f"files of the group {group.name} are uploaded again")
        if group.after == "delete":
            await self._in_thread(delete_unchanged, group.folder, found.path, found.state)
        else:
            await self._in_thread(self._confirmed.add, group.name, found.path, found.state)

    def _upload_failed(self, failure: Any, candidate: _Candidate) -> None:
        error = failure.value
        group = candidate.group.name
        if isinstance(error, FileRefused):
            self._delay(candidate, error.retry_after)
            if error.code == "mismatch" and not self._keeps_differing(candidate.name):
                return
            if error.code in ("quota", "disk_full"):
                # The others of this group would be refused as well.
                self._waiting = deque(each for each in self._waiting if each.group.name != group)
                self._next_scan = self._clock.seconds() + error.retry_after
            self._problem(candidate, str(error))
        elif isinstance(error, UnusableName):
            self._delay(candidate, 3600.0)
            self._problem(candidate, str(error))
        elif isinstance(error, OSError):
            self._delay(candidate, 60.0)
            self._problem(candidate, error.strerror or str(error))
        elif not isinstance(error, (SwitchboardError, CancelledError)):
            self._delay(candidate, 60.0)
            self._log.failure("uploading {name} failed", failure, name=candidate.name)

    def _problem(self, candidate: _Candidate, reason: str) -> None:
        # More users may see alerts than names of files, so the alert has no name.
        group, name = candidate.group.name, candidate.name.encode("utf-8", "replace").decode()
        self._log.warn("{name} can't be uploaded: {reason}", name=name, reason=reason)
        self._problems[group].update(f"a file of the group {group} can't be uploaded: {reason}", "")

    def _keeps_differing(self, name: str) -> bool:
        """Note that the relay's copy differs from what was hashed; whether it has done so several times in a row."""
        # It may have been written without a trace in its state.
        self._hashes.pop(name, None)
        if len(self._mismatches) >= MOST_DELAYED:
            self._mismatches.clear()
        self._mismatches[name] += 1
        return self._mismatches[name] >= MISMATCHES

    def _delay(self, candidate: _Candidate, seconds: float) -> None:
        if len(self._delayed) < MOST_DELAYED:
            self._delayed[candidate.name] = self._clock.seconds() + seconds

    # --- the link -----------------------------------------------------------------------------------------

    def _joined(self, connection: FileConnection) -> None:
        self._attempt = None
        self._asked_at = None
        self._connection = connection
        self._busy_at = self._clock.seconds()
        self.check()

    def _lost(self, connection: FileConnection, reason: str) -> None:
        self._attempt = None
        if self._connection is connection:
            self._connection = None
            self._asked_at = None
            self._log.info("the file link ended: {reason}", reason=reason)

    def _dial_failed(self, failure: Any) -> None:
        self._attempt = None
        if not isinstance(failure.value, CancelledError):
            self._log.warn("the file link can't be opened: {reason}", reason=explain(failure))

    def _close(self, reason: str) -> None:
        attempt, self._attempt = self._attempt, None
        if attempt is not None:
            attempt.cancel()
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close(reason)
