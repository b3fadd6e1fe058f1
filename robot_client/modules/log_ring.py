"""The log of one module on disk: lines in a bounded number of bytes, the oldest dropped first.

A log is a folder of segments. A segment's name is the offset of its first byte in everything that was ever written, so
an offset names a line for good. There are at most two segments: when the newer has half of the allowed size, a third
begins and the oldest is removed.
"""

from __future__ import annotations

import errno
import json
import os
import re
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from relay_protocol.limits import LOG_BYTES

LINE_BYTES = 16 * 1024
"""Longest text of a line; the rest is cut off."""

STREAMS = ("out", "err", "runner")
"""Where a line was written; ``runner``: by the process that keeps the output."""

LEVELS = ("debug", "info", "warn", "error", "fatal")
"""Levels of lines, the most severe last."""

SCAN_BYTES = 1024 * 1024
"""One page is made of at most so many bytes of the log, however few of its lines have the wanted level."""

_SEGMENT = re.compile(r"log\.(\d+)\Z")


@dataclass(frozen=True)
class ModuleLogLine:
    """One line.

    :param at: Unix time in seconds
    :param stream: one of :data:`STREAMS`
    :param level: one of :data:`LEVELS`, see :mod:`robot_client.modules.line_levels`
    """

    at: float
    stream: str
    level: str
    text: str


class LogRing:
    """Writes and reads a module's log. Only one process writes; any number read.

    :param folder: holds the segments; it is made if it is missing
    :param size: most bytes on disk
    """

    def __init__(self, folder: Path, size: int) -> None:
        self._folder = folder
        self._half = max(size // 2, 2 * LINE_BYTES)
        self._file: int | None = None
        self._end = 0
        self._begin = 0
        self.lost = 0
        """Lines since the last one written that could not be, because the disk was full or broken."""
        self.lost_reason = ""

    def write(self, line: ModuleLogLine) -> None:
        """Append a line. Those that can't be written are counted, and reported by a line when writing works again."""
        try:
            self._append_lost(line.at)
            self._append(_record(line))
        except OSError as error:
            self.lost += 1
            self.lost_reason = error.strerror or str(error)

    def report_lost(self, at: float) -> None:
        """Try to write how many lines were lost.

        :param at: Unix time, seconds
        """
        with suppress(OSError):
            self._append_lost(at)

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _append_lost(self, at: float) -> None:
        if self.lost:
            text = f"{self.lost} lines of output were lost: {self.lost_reason}"
            self._append(_record(ModuleLogLine(at, "runner", "error", text)))
            self.lost = 0

    def _append(self, data: bytes) -> None:
        if self._file is None:
            self._open()
        elif self._end - self._begin + len(data) > self._half:
            self.close()
            self._begin = self._end
            self._open()
        assert self._file is not None
        written = os.write(self._file, data)
        if written < len(data):
            # A torn line would make the next one unreadable.
            os.ftruncate(self._file, self._end - self._begin)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._end += len(data)

    def _open(self) -> None:
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        segments = _segments(self._folder)
        if self._end == 0 and segments:
            # An earlier run wrote here.
            self._begin = segments[-1]
            self._end = self._begin + _path(self._folder, self._begin).stat().st_size
        self._file = os.open(
            _path(self._folder, self._begin), os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o600
        )
        for old in [each for each in segments if each != self._begin][:-1]:
            _path(self._folder, old).unlink(missing_ok=True)


@dataclass(frozen=True)
class LogPage:
    """Lines, oldest first.

    :param previous: give it to :func:`read_before` for earlier lines; 0 if there are none
    :param next: give it to :func:`read` for the lines that follow
    :param missed: whether lines before the first are no longer on disk
    """

    lines: list[ModuleLogLine]
    previous: int
    next: int
    missed: bool


def read(
    folder: Path, after: int = 0, most: int = 500, level: str = LEVELS[0], size: int = LOG_BYTES
) -> LogPage:
    """Lines of a log from an offset on. It may have none although later ones follow, see :data:`SCAN_BYTES`.

    :param after: offset to begin at, as of an earlier page; 0 for the oldest line on disk
    :param most: most lines
    :param level: only lines of this level or a more severe one
    :param size: most bytes of the file that they take; one line is always read
    """
    segments = _segments(folder)
    begin = end = max(after, segments[0]) if segments else after
    lines: list[ModuleLogLine] = []
    taken = 0
    for record in _records(folder, segments, begin):
        wanted = record.has_level(level)
        taken += record.end - record.begin if wanted else 0
        if lines and (taken > size or len(lines) == most):
            break
        end = record.end
        if wanted and record.line is not None:
            lines.append(record.line)
        if end - begin > SCAN_BYTES:
            break
    missed = bool(segments) and 0 < after < segments[0]
    return LogPage(lines, _previous(segments, begin), end, missed)


def read_before(
    folder: Path, before: int | None, most: int, level: str = LEVELS[0], size: int = LOG_BYTES
) -> LogPage:
    """The newest lines in front of an offset. It may have none although there are earlier ones, as :func:`read`.

    :param before: offset, as of a later page; ``None`` for the newest lines of all
    :param most: most lines
    :param level: only lines of this level or a more severe one
    :param size: most bytes of the file that they take; one line is always read
    """
    segments = _segments(folder)
    end = end_of(folder) if before is None else before
    scanned = size if level == LEVELS[0] else SCAN_BYTES
    begin = max(segments[0], end - scanned) if segments else end
    if segments and begin > segments[0]:
        begin = _next_line(folder, segments, begin)
    found: deque[_Record] = deque()
    taken = 0
    for record in _records(folder, segments, begin):
        if before is not None and record.end > before:
            break
        if before is None:
            # Written meanwhile.
            end = record.end
        if record.line is None or not record.has_level(level):
            continue
        found.append(record)
        taken += record.end - record.begin
        while len(found) > 1 and (len(found) > most or taken > size):
            dropped = found.popleft()
            taken -= dropped.end - dropped.begin
            begin = dropped.end
    return LogPage([each.line for each in found if each.line], _previous(segments, begin), end, missed=False)


def _previous(segments: list[int], begin: int) -> int:
    return begin if segments and begin > segments[0] else 0


def end_of(folder: Path) -> int:
    """The offset behind everything that was written."""
    segments = _segments(folder)
    if not segments:
        return 0
    try:
        return segments[-1] + _path(folder, segments[-1]).stat().st_size
    except FileNotFoundError:
        return segments[-1]


def _next_line(folder: Path, segments: list[int], offset: int) -> int:
    """The start of the first line at or behind an offset."""
    segment = max(each for each in segments if each <= offset)
    try:
        with _path(folder, segment).open("rb") as file:
            file.seek(offset - segment - 1)
            return offset - 1 + len(file.readline())
    except FileNotFoundError:
        return offset


class _Record(NamedTuple):
    """A whole line on disk, with its offset and the one behind it; ``None`` for a line that can't be read."""

    begin: int
    end: int
    line: ModuleLogLine | None

    def has_level(self, least: str) -> bool:
        return self.line is not None and LEVELS.index(self.line.level) >= LEVELS.index(least)


def _records(folder: Path, segments: list[int], begin: int) -> Iterator[_Record]:
    for number, segment in enumerate(segments):
        following = segments[number + 1] if number + 1 < len(segments) else None
        if following is not None and following <= begin:
            continue
        try:
            with _path(folder, segment).open("rb") as file:
                offset = max(segment, begin)
                file.seek(offset - segment)
                for data in file:
                    if not data.endswith(b"\n"):
                        break
                    offset += len(data)
                    yield _Record(offset - len(data), offset, _line(data))
        except FileNotFoundError:
            # Removed meanwhile, since newer lines were written.
            continue


def _record(line: ModuleLogLine) -> bytes:
    return json.dumps(vars(line), ensure_ascii=False, separators=(",", ":")).encode() + b"\n"


def _line(data: bytes) -> ModuleLogLine | None:
    try:
        line = ModuleLogLine(**json.loads(data))
    except (ValueError, TypeError):
        return None
    return line if line.stream in STREAMS and line.level in LEVELS else None


def _segments(folder: Path) -> list[int]:
    try:
        names = [each.name for each in folder.iterdir()]
    except FileNotFoundError:
        return []
    return sorted(int(found[1]) for found in map(_SEGMENT.match, names) if found)


def _path(folder: Path, begin: int) -> Path:
    return folder / f"log.{begin}"
