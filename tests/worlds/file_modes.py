"""Files that others may access."""

from __future__ import annotations

import os
import stat
from pathlib import Path


def open_to_others(folder: Path) -> dict[str, str]:
    """Paths below a folder that others may access, except links."""
    found = {}
    for root, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(root, name)
            mode = path.lstat().st_mode
            if not stat.S_ISLNK(mode) and mode & 0o077:
                found[str(path.relative_to(folder))] = oct(mode)
    return found
