"""Settings of groups of files (``[[file_group]]``)."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Annotated, Literal

import msgspec

GROUP_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,62}\Z")


class FileGroupSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Files that are uploaded to the relay.

    :param name: of the group; it begins the names of its files at the relay
    :param folder: absolute path; files in folders below it belong to the group too
    :param patterns: of names of files, with ``*``, ``?`` and ``[…]``; one with ``/`` is of the path below ``folder``
    :param settle_seconds: a file is uploaded when it has not been written for so long
    :param after: whether a file is deleted on the robot when the relay has confirmed it, or kept
    :param when: ``always``, or ``full`` to upload only while memory or disk of the robot is critical
    """

    name: str
    folder: str
    patterns: list[str] = msgspec.field(default_factory=lambda: ["*"])
    settle_seconds: Annotated[float, msgspec.Meta(ge=0.1, le=86_400)] = 10.0
    after: Literal["delete", "keep"] = "keep"
    when: Literal["always", "full"] = "always"

    def __post_init__(self) -> None:
        if not GROUP_NAME.match(self.name):
            raise ValueError(
                f"file_group: the name '{self.name}' must be of a-z, 0-9, _ and -, at most 63 characters"
            )
        if not self.folder.startswith("/"):
            raise ValueError(
                f"file_group {self.name}: folder '{self.folder}' must be an absolute path, such as /var/bags"
            )
        if not self.patterns or not all(self.patterns):
            raise ValueError(f"file_group {self.name}: patterns must not be empty; '*' stands for all files")


def check_groups(groups: Iterable[FileGroupSettings]) -> None:
    """:raises ValueError: two groups have the same name"""
    names = [each.name for each in groups]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"file_group: the name '{name}' occurs twice")
