"""Where temporary files of a program on a robot can be written."""

from __future__ import annotations

import tempfile

MEMORY = "/dev/shm"  # noqa: S108  # files in it get random names
"""A file system in memory."""


def temporary_parent() -> str:
    """The folder for temporary files; in memory if all disks are full or read-only."""
    try:
        # It has been written to, as a test.
        return tempfile.gettempdir()
    except OSError:
        return MEMORY
