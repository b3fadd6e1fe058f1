"""What the machine is, and its load, where psutil is there to tell."""

from __future__ import annotations

import platform
from typing import Any

try:
    import psutil
except ImportError:  # a robot without it has no figures, and no trouble
    psutil = None


class Machine:
    """Processor and memory of this machine, each 0 to 1."""

    def __init__(self) -> None:
        self._psutil: Any = psutil
        self.cpu()  # the first answer of psutil means nothing

    def cpu(self) -> float | None:
        """Load since the last question."""
        return self._psutil.cpu_percent(None) / 100 if self._psutil else None

    def memory(self) -> float | None:
        """Memory in use."""
        return self._psutil.virtual_memory().percent / 100 if self._psutil else None


def operating_system() -> str:
    """Its name and version."""
    try:
        return platform.freedesktop_os_release().get("PRETTY_NAME", "")
    except OSError:
        return f"{platform.system()} {platform.release()}"
