"""The recordings of a relay as files: each a ``.mcap``, and beside it a ``.json`` that says what it is."""

from __future__ import annotations

import contextlib
import enum
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import msgspec
from twisted.logger import Logger

from relay_protocol.errors import Invalid, NotFound, Unavailable
from relay_protocol.realms import DEFAULT_REALM, full_name

KEPT = 10_000
ROBOT_KEPT = 1000
"""Recordings that may be kept in all, and of one robot, however small they are."""

SMALLEST = 10**6
"""Bytes that every recording may have."""

NO_ROOM_NOW = "there is no room for such a recording on this relay now"
"""All that a realm is told where the recordings of others are in the way."""

UNKNOWN = "there is no such recording, or it holds what you may not record and see"


class RecordingState(enum.Enum):
    """How far a recording has come."""

    RECORDING = "recording"
    FINISHING = "finishing"
    """No more comes; what waits is being written."""
    COMPLETE = "complete"
    INCOMPLETE = "incomplete"
    """It broke off, and the file can't be read yet."""
    RECOVERED = "recovered"
    """It broke off; what was on the disk by then can be read."""


READABLE = frozenset({RecordingState.COMPLETE, RecordingState.RECOVERED})
RUNNING = frozenset({RecordingState.RECORDING, RecordingState.FINISHING})


class RecordingEntry(msgspec.Struct):
    """One recording.

    :param robot_id: numbers of robots are never used again
    :param pictures: those of the topics that may carry what a camera sees
    :param begun: Unix seconds
    :param ended: Unix seconds
    :param reason: why it ended
    :param limit: bytes the file may have
    :param seconds: it may take
    :param bytes: of the file
    :param drops: messages that came and are not in it
    :param problems: what was not recorded as it was wanted, in words
    :param realm: of the user: there it is kept, and takes room
    :param home: the robot's own realm, where that is another
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
        """The robot's name for the whole relay."""
        return full_name(self.robot, self.home or self.realm)


FOLDER = "recordings"
"""Where they are, in the relay's data folder."""

_decoder = msgspec.json.Decoder(RecordingEntry)


def entries_in(folder: Path) -> Iterator[tuple[str, RecordingEntry | None]]:
    """The recordings of a folder, which is only read: the name of each ``.json``, and what it says.

    :raises OSError: it can't be read
    """
    for path in folder.glob("*.json"):
        try:
            yield path.name, _decoder.decode(path.read_bytes())
        except (msgspec.MsgspecError, UnicodeDecodeError):
            yield path.name, None
        except FileNotFoundError:
            # A relay that runs has deleted it meanwhile.
            continue


def kept_of(folder: Path, robot_id: int) -> tuple[int, int]:
    """How many recordings of a robot a folder has, and the bytes of their files.

    :raises OSError: it can't be read
    """
    count = size = 0
    for _, entry in entries_in(folder):
        if entry is not None and entry.robot_id == robot_id:
            count += 1
            with contextlib.suppress(FileNotFoundError):
                size += _file(folder, entry.id).stat().st_size
    return count, size


def _file(folder: Path, id: str) -> Path:
    return folder / f"{id}.mcap"


class Library:
    """The folder of recordings. What is in it is read once, by :meth:`open`.

    Each realm has all the room there is, as far as others leave it, and is told of nobody's recordings but its own.

    :param quota: bytes all recordings together may have
    :param reserve: bytes of the disk that stay free; other things of the relay are on it too
    :ivar copied: the recording that takes its room twice, while its file is mended
    """

    log = Logger()

    def __init__(self, folder: Path, quota: int, reserve: int = 0) -> None:
        self._folder = folder
        self.quota = quota
        self.reserve = reserve
        self.copied: RecordingEntry | None = None
        self._entries: dict[str, RecordingEntry] = {}
        self._robots: dict[int, dict[str, RecordingEntry]] = {}

    def open(self) -> None:
        """Find out what is there.

        :raises Invalid: the folder can't be used
        """
        try:
            self._folder.mkdir(mode=0o700, exist_ok=True)
            for left in [*self._folder.glob("*.part"), *self._folder.glob("*.new")]:
                left.unlink()
            for name, entry in entries_in(self._folder):
                self._read(name, entry)
        except OSError as error:
            raise Invalid(f"the folder of recordings can't be used: {error.strerror}") from None

    def _read(self, name: str, entry: RecordingEntry | None) -> None:
        if entry is None:
            self.log.error("{file} in the folder of recordings is not understood", file=name)
            return
        if entry.state in RUNNING:
            entry.state = RecordingState.INCOMPLETE
            entry.reason = "the relay ended without warning"
        if entry.state is RecordingState.INCOMPLETE:
            # Nobody came to write down how large it became.
            entry.bytes = self.size(entry)
        self._keep(entry)

    # --- what is there ------------------------------------------------------------------------------------

    def __iter__(self) -> Iterator[RecordingEntry]:
        return iter(list(self._entries.values()))

    def of(self, robot_id: int) -> list[RecordingEntry]:
        """A robot's recordings, the latest first: in the order of :func:`place`, backwards."""
        return sorted(self._robots.get(robot_id, {}).values(), key=place, reverse=True)

    def find(self, robot_id: int, id: str) -> RecordingEntry:
        """One recording of a robot.

        :raises NotFound: there is none
        """
        entry = self._entries.get(id)
        if entry is None or entry.robot_id != robot_id:
            raise NotFound(UNKNOWN)
        return entry

    def has(self, entry: RecordingEntry) -> bool:
        """Whether it is still there."""
        return entry.id in self._entries

    def incomplete(self) -> list[RecordingEntry]:
        """Those whose file can't be read yet."""
        return [entry for entry in self._entries.values() if entry.state is RecordingState.INCOMPLETE]

    @property
    def used(self) -> int:
        """Bytes that are taken, with all that is being recorded may still become."""
        return self._taken()

    def left(self, realm: str) -> int:
        """Bytes that one more of a realm may take, if only those of its own are counted."""
        return max(0, self.quota - self._taken(realm))

    def _taken(self, realm: str | None = None) -> int:
        """By one realm, or by all."""
        copied = () if self.copied is None else (self.copied,)
        return sum(
            entry.limit if entry.state in RUNNING else entry.bytes
            for entry in (*self._entries.values(), *copied)
            if realm in (None, entry.realm)
        )

    def full(self, robot_id: int, realm: str) -> str:
        """Why there can't be one more of a robot of this realm, however small; empty when there can."""
        if sum(each.realm == realm for each in self._robots.get(robot_id, {}).values()) >= ROBOT_KEPT:
            return (
                f"{ROBOT_KEPT} recordings of this robot are kept, the most there may be: delete some of them"
            )
        if sum(entry.realm == realm for entry in self._entries.values()) >= KEPT:
            return f"{KEPT} recordings are kept, the most there may be in all: delete some, of any robot"
        if len(self._entries) >= KEPT or self.left(realm) >= SMALLEST > self.quota - self.used:
            return NO_ROOM_NOW
        return ""

    def path(self, entry: RecordingEntry) -> Path:
        """The file."""
        return _file(self._folder, entry.id)

    # --- changes; the reactor's thread --------------------------------------------------------------------

    def add(self, entry: RecordingEntry) -> None:
        """One more.

        :raises Unavailable: it would be one too many, or could become more than there may be
        """
        full = self.full(entry.robot_id, entry.realm)
        if full:
            raise Unavailable(full)
        left = self.left(entry.realm)
        if entry.limit > left:
            raise Unavailable(
                f"recordings may have {self.quota // 10**6} MB in all, of which {left // 10**6} MB "
                f"are left: delete some, or record at most that much"
            )
        if entry.limit > self.quota - self.used:
            raise Unavailable(NO_ROOM_NOW)
        self._keep(entry)

    def forget(self, entry: RecordingEntry) -> None:
        """It is there no more."""
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

        :raises OSError: it can't be looked at
        """
        try:
            return self.path(entry).stat().st_size
        except FileNotFoundError:
            return 0

    def spare(self) -> int:
        """Bytes of the disk that are free beyond the reserve; less than 0 when it is nearly full.

        :raises OSError: it can't be looked at
        """
        return shutil.disk_usage(self._folder).free - self.reserve

    def nearly_full(self) -> bool:
        """Whether less of the disk is free than shall stay so.

        :raises OSError: it can't be looked at
        """
        return self.spare() < 0

    def save(self, id: str, text: bytes) -> None:
        """Put on the disk what a recording is.

        :param text: by :func:`text_of`
        :raises OSError: it can't be written
        """
        path = self._folder / f"{id}.json"
        fresh = path.with_suffix(".new")
        with fresh.open("wb") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
        fresh.replace(path)

    def delete(self, id: str) -> None:
        """Take a recording off the disk: the file first, so that none is left that nobody knows of.

        :raises OSError: it can't be deleted
        """
        for suffix in (".mcap", ".json"):
            with contextlib.suppress(FileNotFoundError):
                (self._folder / f"{id}{suffix}").unlink()


def place(entry: RecordingEntry) -> tuple[float, str]:
    """Where a recording stands among others: when it was begun, in Unix seconds, and its id."""
    return entry.begun, entry.id


def text_of(entry: RecordingEntry) -> bytes:
    """What :meth:`Library.save` writes."""
    return msgspec.json.encode(entry)
