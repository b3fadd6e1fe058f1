"""Files of a group on the disk: found, opened and deleted without following a symbolic link out of their folder.

All functions block, and run in threads.
"""

from __future__ import annotations

import contextlib
import fnmatch
import hashlib
import os
import stat
from collections.abc import Iterator
from typing import NamedTuple

from relay_protocol.limits import FILE_NAME, MIB

HASHED_AT_ONCE = 16 * MIB
"""Bytes that are hashed before a thread does other work, so that a large file does not hold up small ones."""

MAX_DEPTH = 32
"""Levels of folders below a group's folder that are searched."""


class FileState(NamedTuple):
    """Properties that change when a file is written or replaced.

    :param modified: nanoseconds
    """

    size: int
    modified: int
    inode: int

    @classmethod
    def of(cls, found: os.stat_result) -> FileState:
        return cls(found.st_size, found.st_mtime_ns, found.st_ino)


class FoundFile(NamedTuple):
    """A file of a group.

    :param path: below the folder of the group
    """

    path: str
    state: FileState


class UnusableName(OSError):
    """The name of a file can't be sent."""


def find_files(folder: str, patterns: list[str]) -> Iterator[FoundFile]:
    """The regular files below a folder whose names match, in no order. Links are not followed.

    Folders are read one entry at a time, so memory does not grow with the number of files.

    :raises OSError: the folder itself can't be read
    """
    yield from _find(folder, "", patterns, 0)


def _find(folder: str, prefix: str, patterns: list[str], depth: int) -> Iterator[FoundFile]:
    with os.scandir(f"{folder}/{prefix}") as entries:
        for entry in entries:
            path = f"{prefix}{entry.name}"
            try:
                if entry.is_dir(follow_symlinks=False):
                    if depth < MAX_DEPTH:
                        with contextlib.suppress(OSError):
                            yield from _find(folder, path + "/", patterns, depth + 1)
                elif matches(path, patterns) and entry.is_file(follow_symlinks=False):
                    yield FoundFile(path, FileState.of(entry.stat(follow_symlinks=False)))
            except FileNotFoundError:
                continue


def matches(path: str, patterns: list[str]) -> bool:
    """Whether a path below the folder of a group matches one of its patterns."""
    name = path.rpartition("/")[2]
    return any(fnmatch.fnmatchcase(path if "/" in each else name, each) for each in patterns)


def check_name(name: str) -> None:
    """:raises UnusableName: the relay would not accept the name"""
    try:
        encoded = name.encode()
    except UnicodeEncodeError:
        raise UnusableName("its name is not UTF-8; rename it") from None
    if len(encoded) > FILE_NAME or any(ord(each) < 32 or ord(each) in (127, 0xFFFD) for each in name):
        raise UnusableName(
            f"its name is longer than {FILE_NAME} bytes or has control characters or U+FFFD; rename it"
        )


class OpenFile:
    """A file that is read.

    :ivar state: when it was opened
    """

    def __init__(self, folder: str, path: str) -> None:
        """:raises OSError: it is not a regular file below the folder, or can't be read"""
        with _parent(folder, path) as (parent, name):
            self._descriptor = os.open(
                name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=parent
            )
        found = os.fstat(self._descriptor)
        if not stat.S_ISREG(found.st_mode):
            os.close(self._descriptor)
            raise OSError("it is not a regular file")
        self.state = FileState.of(found)
        self._digest = hashlib.sha256()
        self._hashed = 0

    def hash_part(self) -> bool:
        """Hash up to :data:`HASHED_AT_ONCE` further bytes; whether there may be more.

        :raises OSError: it can't be read
        """
        end = self._hashed + HASHED_AT_ONCE
        while self._hashed < end:
            part = os.pread(self._descriptor, MIB, self._hashed)
            if not part:
                return False
            self._digest.update(part)
            self._hashed += len(part)
        return True

    @property
    def sha256(self) -> str:
        """The hash of what was hashed, hexadecimal."""
        return self._digest.hexdigest()

    def read(self, offset: int, size: int) -> bytes:
        """:raises OSError: it can't be read"""
        return os.pread(self._descriptor, size, offset)

    def changed(self) -> bool:
        """Whether the file was written since it was opened."""
        return FileState.of(os.fstat(self._descriptor)) != self.state

    def close(self) -> None:
        """End reading."""
        os.close(self._descriptor)


def delete_unchanged(folder: str, path: str, state: FileState) -> bool:
    """Delete a file if it is as it was; false if it has changed or is gone.

    :raises OSError: it can't be deleted
    """
    try:
        with _parent(folder, path) as (parent, name):
            found = os.stat(name, dir_fd=parent, follow_symlinks=False)
            if FileState.of(found) != state or not stat.S_ISREG(found.st_mode):
                return False
            os.unlink(name, dir_fd=parent)
    except FileNotFoundError:
        return False
    return True


@contextlib.contextmanager
def _parent(folder: str, path: str) -> Iterator[tuple[int, str]]:
    """The folder that holds a file, opened one step after the other so that no link is followed, and its name."""
    *folders, name = path.split("/")
    current = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        for each in folders:
            inner = os.open(each, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=current)
            os.close(current)
            current = inner
        yield current, name
    finally:
        os.close(current)
