"""The recordings of a relay as files: each is a ``.mcap`` with a ``.json`` that describes it."""

from __future__ import annotations

import contextlib
import enum
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
from twisted.logger import Logger

from relay_protocol.errors import Invalid, NotFound, Unavailable
from relay_protocol.realms import DEFAULT_REALM, full_name
from relay_protocol.rights import Operation
from relay_server.access import Permit
from relay_server.files.object_storage import ObjectStorage
from relay_server.files.storage import FileStorage, LocalContent, StoredContent

KEPT = 10_000
ROBOT_KEPT = 1000
"""Most recordings in all, and of one robot, whatever their size."""

SMALLEST = 10**6
"""Bytes that every recording may have."""

NO_ROOM_NOW = "there is no room for such a recording on this relay now"
"""The answer where recordings of other realms take the room."""

UNKNOWN = "there is no such recording, or it contains topics or cameras that you have no right to"


class RecordingState(enum.Enum):
    """How far a recording has come."""

    RECORDING = "recording"
    FINISHING = "finishing"
    """It takes no more samples; the queued ones are being written."""
    COMPLETE = "complete"
    INCOMPLETE = "incomplete"
    """It broke off, and the file cannot be read yet."""
    RECOVERED = "recovered"
    """It broke off; the part on the disk can be read."""


READABLE = frozenset({RecordingState.COMPLETE, RecordingState.RECOVERED})
RUNNING = frozenset({RecordingState.RECORDING, RecordingState.FINISHING})


class RecordingEntry(msgspec.Struct):
    """One recording.

    :param robot_id: numbers of robots are never used again
    :param pictures: the topics that may carry camera images
    :param begun: Unix seconds
    :param ended: Unix seconds
    :param reason: why it ended
    :param limit: largest size of the file in bytes
    :param seconds: longest duration
    :param bytes: size of the file
    :param drops: messages that came and are not in the file
    :param problems: parts that could not be recorded as requested, in words
    :param realm: of the user; the recording belongs to it and counts for it
    :param home: the robot's own realm, if that is another one
    """

    id: str
    robot_id: int
    robot: str
    user_id: int
    user: str
    topics: tuple[str, ...]
    cameras: tuple[str, ...]
    begun: float
    limit: int
    seconds: float
    pictures: tuple[str, ...] = ()
    state: RecordingState = RecordingState.RECORDING
    ended: float | None = None
    reason: str = ""
    bytes: int = 0
    messages: int = 0
    drops: int = 0
    problems: list[str] = []
    realm: str = DEFAULT_REALM
    home: str = ""

    @property
    def robot_full(self) -> str:
        return full_name(self.robot, self.home or self.realm)


FOLDER = "recordings"
"""Their folder in the relay's data folder."""

_decoder = msgspec.json.Decoder(RecordingEntry)


def entries_in(folder: Path) -> Iterator[tuple[str, RecordingEntry | None]]:
    """Read the recordings of a folder: the name of each ``.json`` and its contents.

    :raises OSError: it cannot be read
    """
    for path in folder.glob("*.json"):
        try:
            yield path.name, _decoder.decode(path.read_bytes())
        except (msgspec.MsgspecError, UnicodeDecodeError):
            yield path.name, None
        except FileNotFoundError:
            # A running relay has deleted it meanwhile.
            continue


def kept_of(folder: Path, robot_id: int) -> tuple[int, int]:
    """How many recordings of a robot a folder has, and the bytes of their files.

    :raises OSError: it cannot be read
    """
    count = size = 0
    for _, entry in entries_in(folder):
        if entry is not None and entry.robot_id == robot_id:
            count += 1
            try:
                size += _file(folder, entry.id).stat().st_size
            except FileNotFoundError:
                # It is in the storage, or was never written.
                size += entry.bytes if entry.state in READABLE else 0
    return count, size


def _file(folder: Path, id: str) -> Path:
    return folder / _file_name(id)


def _file_name(id: str) -> str:
    return f"{id}.mcap"


def open_storage(url: str) -> FileStorage | None:
    """The storage of finished recordings: a folder in that of files. ``None``: they stay on the relay's disk.

    :param url: of the S3-compatible storage of files, or empty
    :raises Invalid: the URL can't be used
    """
    return ObjectStorage(f"{url.rstrip('/')}/{FOLDER}", _file_name) if url else None


class Library:
    """The folder of recordings. Its contents are read once, by :meth:`open`.

    Each realm may use all the space that others leave, and sees only its own recordings.

    :param quota: bytes of all recordings together
    :param reserve: bytes of the disk that stay free, also for other data of the relay
    :param storage: of finished recordings; without one they stay in the folder
    :ivar copied: the recording that takes its space twice while its file is repaired
    """

    log = Logger()

    def __init__(
        self, folder: Path, quota: int, reserve: int = 0, storage: FileStorage | None = None
    ) -> None:
        self._folder = folder
        self.quota = quota
        self.reserve = reserve
        self._storage = storage
        self.copied: RecordingEntry | None = None
        self._entries: dict[str, RecordingEntry] = {}
        self._robots: dict[int, dict[str, RecordingEntry]] = {}

    def open(self) -> None:
        """Read the folder.

        :raises Invalid: it cannot be used
        """
        try:
            self._folder.mkdir(mode=0o700, exist_ok=True)
            for left in [*self._folder.glob("*.part"), *self._folder.glob("*.new")]:
                left.unlink()
            for name, entry in entries_in(self._folder):
                self._read(name, entry)
        except OSError as error:
            raise Invalid(f"the folder of recordings cannot be used: {error.strerror}") from None

    def _read(self, name: str, entry: RecordingEntry | None) -> None:
        if entry is None:
            self.log.error("{file} in the folder of recordings is not valid", file=name)
            return
        if entry.state in RUNNING:
            entry.state = RecordingState.INCOMPLETE
            entry.reason = "the relay ended unexpectedly"
        if entry.state is RecordingState.INCOMPLETE:
            # The relay died before it could store the size.
            entry.bytes = self.size(entry)
        self._keep(entry)

    # --- contents -----------------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[RecordingEntry]:
        return iter(list(self._entries.values()))

    def of(self, robot_id: int) -> list[RecordingEntry]:
        """A robot's recordings, the latest first (:func:`place`, reversed)."""
        return sorted(self._robots.get(robot_id, {}).values(), key=place, reverse=True)

    def find(self, robot_id: int, id: str) -> RecordingEntry:
        entry = self._entries.get(id)
        if entry is None or entry.robot_id != robot_id:
            raise NotFound(UNKNOWN)
        return entry

    def has(self, entry: RecordingEntry) -> bool:
        """Whether the recording still exists."""
        return entry.id in self._entries

    def incomplete(self) -> list[RecordingEntry]:
        """Recordings whose file cannot be read yet."""
        return [entry for entry in self._entries.values() if entry.state is RecordingState.INCOMPLETE]

    @property
    def used(self) -> int:
        """Bytes in use, including all that running recordings may still take."""
        return self._taken()

    def left(self, realm: str) -> int:
        """Bytes that one more recording of a realm may take, counting only those of that realm."""
        return max(0, self.quota - self._taken(realm))

    def _taken(self, realm: str | None = None) -> int:
        """Bytes of one realm, or of all."""
        copied = () if self.copied is None else (self.copied,)
        return sum(
            entry.limit if entry.state in RUNNING else entry.bytes
            for entry in (*self._entries.values(), *copied)
            if realm in (None, entry.realm)
        )

    def full(self, robot_id: int, realm: str) -> str:
        """Why there cannot be one more recording of a robot in this realm, whatever its size; empty if there
        can."""
        if sum(each.realm == realm for each in self._robots.get(robot_id, {}).values()) >= ROBOT_KEPT:
            return f"{ROBOT_KEPT} recordings of this robot are stored, the most there may be: delete some of them"
        if sum(entry.realm == realm for entry in self._entries.values()) >= KEPT:
            return f"{KEPT} recordings are stored, the most there may be in all: delete some, of any robot"
        if len(self._entries) >= KEPT or self.left(realm) >= SMALLEST > self.quota - self.used:
            return NO_ROOM_NOW
        return ""

    def path(self, entry: RecordingEntry) -> Path:
        return _file(self._folder, entry.id)

    # --- changes; the reactor's thread --------------------------------------------------------------------

    def add(self, entry: RecordingEntry) -> None:
        """Add a recording.

        :raises Unavailable: there are too many, or it could become too large
        """
        full = self.full(entry.robot_id, entry.realm)
        if full:
            raise Unavailable(full)
        left = self.left(entry.realm)
        if entry.limit > left:
            raise Unavailable(
                f"recordings may take {self.quota // 10**6} MB in all, of which {left // 10**6} MB "
                f"are left: delete some, or record at most that much"
            )
        if entry.limit > self.quota - self.used:
            raise Unavailable(NO_ROOM_NOW)
        self._keep(entry)

    def forget(self, entry: RecordingEntry) -> None:
        """Remove a recording from the list."""
        self._entries.pop(entry.id, None)
        others = self._robots.get(entry.robot_id, {})
        others.pop(entry.id, None)
        if not others:
            self._robots.pop(entry.robot_id, None)

    def _keep(self, entry: RecordingEntry) -> None:
        self._entries[entry.id] = entry
        self._robots.setdefault(entry.robot_id, {})[entry.id] = entry

    # --- the disk; any thread -----------------------------------------------------------------------------

    def size(self, entry: RecordingEntry) -> int:
        """Bytes of the file, 0 if there is none.

        :raises OSError: it cannot be read
        """
        try:
            return self.path(entry).stat().st_size
        except FileNotFoundError:
            return 0

    @property
    def has_storage(self) -> bool:
        """Whether finished recordings are moved into a storage."""
        return self._storage is not None

    def on_disk(self) -> set[str]:
        """Recordings whose files are on the relay's disk.

        :raises OSError: it cannot be read
        """
        return {path.stem for path in self._folder.glob("*.mcap")}

    def move(self, entry: RecordingEntry, stopping: Callable[[], bool]) -> None:
        """Move a finished recording into the storage, if it is not there yet. Its description must be saved.

        :param stopping: see :meth:`FileStorage.store`
        :raises OSError: it cannot be moved, or that was stopped; the file is still on the disk
        """
        path = self.path(entry)
        if self._storage is not None and path.exists():
            self._storage.store(path, entry.id, stopping)

    def open_content(self, entry: RecordingEntry) -> StoredContent:
        """Open the file of a finished recording for reading, wherever it is.

        :raises OSError: it cannot be opened
        """
        try:
            return LocalContent(self.path(entry))
        except FileNotFoundError:
            if self._storage is None:
                raise
            # It leaves the disk only once it is in the storage.
            return self._storage.open(entry.id)

    def spare(self) -> int:
        """Bytes of the disk that are free beyond the reserve; negative when it is nearly full.

        :raises OSError: it cannot be read
        """
        return shutil.disk_usage(self._folder).free - self.reserve

    def nearly_full(self) -> bool:
        """Whether less than the reserve is free.

        :raises OSError: it cannot be read
        """
        return self.spare() < 0

    def save(self, id: str, text: bytes) -> None:
        """Write the description of a recording to the disk.

        :param text: by :func:`text_of`
        :raises OSError: it cannot be written
        """
        path = self._folder / f"{id}.json"
        fresh = path.with_suffix(".new")
        with fresh.open("wb") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        fresh.replace(path)

    def delete(self, id: str) -> None:
        """Delete a recording: its contents first, so that no unknown file is left behind.

        :raises OSError: it cannot be deleted
        """
        if self._storage is not None:
            self._storage.delete(id)
        self.discard(id)

    def discard(self, id: str) -> None:
        """Delete a recording that is on the disk only.

        :raises OSError: it cannot be deleted
        """
        for suffix in (".mcap", ".json"):
            with contextlib.suppress(FileNotFoundError):
                (self._folder / f"{id}{suffix}").unlink()


def place(entry: RecordingEntry) -> tuple[float, str]:
    """The order of recordings: Unix seconds of the beginning, and the id."""
    return entry.begun, entry.id


def text_of(entry: RecordingEntry) -> bytes:
    """The bytes that :meth:`Library.save` writes."""
    return msgspec.json.encode(entry)


def why_not(permit: Permit, see: Operation, name: str) -> str:
    """Why a topic or camera may not be recorded; empty if it may.

    :param see: the right needed to see it
    """
    for operation in (Operation.RECORD, see):
        decision = permit.decide(operation, name)
        if not decision.allowed:
            return decision.reason
    return ""


def why_denied(permit: Permit, entry: RecordingEntry) -> str:
    """Why a recording may not be read; empty if it may. All that it contains must be allowed."""
    if permit.principal.realm != entry.realm:
        return "it was recorded in another realm"
    asked = [(Operation.SUBSCRIBE, topic) for topic in entry.topics]
    asked += [(Operation.VIEW, each) for each in (*entry.cameras, *entry.pictures)]
    return next((reason for see, name in asked if (reason := why_not(permit, see, name))), "")
