"""Shapes of the files of robots, as clients see them."""

from __future__ import annotations

import msgspec


class FileInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A file of a robot.

    :param name: with `/` between folders
    :param size: bytes
    :param sha256: of its content, hexadecimal
    :param origin: group of files in the robot's settings, or `user:` and who uploaded it
    :param modified: when it was changed last before it was uploaded, Unix seconds
    :param stored: when it was stored, Unix seconds
    """

    name: str
    size: int
    sha256: str
    origin: str
    modified: float
    stored: float


class UploadInfo(msgspec.Struct, frozen=True, kw_only=True):
    """A file that is being uploaded.

    :param received: bytes that have arrived
    :param started: when this upload began, or went on after a break, Unix seconds
    """

    name: str
    size: int
    received: int
    origin: str
    started: float


class FilePage(msgspec.Struct, frozen=True, kw_only=True):
    """Files of a robot by name. A name occurs once for each content.

    :param next: `after` of the next page, null on the last
    :param uploads: files that are being uploaded
    :param count: number of all files, with those that are being uploaded
    :param used: bytes of all files; each counts as at least 4096
    :param quota: most bytes of the robot's files
    :param may_manage: whether the caller may delete and upload files
    """

    files: list[FileInfo]
    next: str | None
    uploads: list[UploadInfo]
    count: int
    used: int
    quota: int
    may_manage: bool
