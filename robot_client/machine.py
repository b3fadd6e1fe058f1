"""The machine: its operating system, and its load where psutil is installed."""

from __future__ import annotations

import platform
from typing import Any

try:
    import psutil
except ImportError:  # optional
    psutil = None


class Machine:
    """Load of processor and memory, each 0 to 1; ``None`` without psutil."""

    def __init__(self) -> None:
        self._psutil: Any = psutil
        self.cpu()  # psutil's first value is meaningless

    def cpu(self) -> float | None:
        """Processor load since the last call."""
        return self._psutil.cpu_percent(None) / 100 if self._psutil else None

    def memory(self) -> float | None:
        """Memory in use."""
        return self._psutil.virtual_memory().percent / 100 if self._psutil else None


def operating_system() -> str:
    """Name and version of the operating system."""
    try:
        return platform.freedesktop_os_release().get("PRETTY_NAME", "")
    except OSError:
        return f"{platform.system()} {platform.release()}"
