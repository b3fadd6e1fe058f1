"""Shares of a CPU that the processes of a robot take."""

from __future__ import annotations

from msgspec.structs import asdict

from relay_protocol import link
from relay_server.modules.schemas import ProcessList, ProcessStatus


class CpuShares:
    """Shares of a CPU between the measurements of one client.

    Each client has its own: the intervals of others must not shorten the time that its figures are about.
    """

    def __init__(self) -> None:
        self._before: dict[tuple[int, float], link.ProcessInfo] = {}
        """The previous measurement, by pid and start, as a pid is used again."""

    def measured(self, found: link.Processes | ProcessList) -> ProcessList:
        """A measurement with the shares since the one before; ``None`` of processes that it did not have."""
        rows = [ProcessStatus(**{**asdict(each), "cpu": self._share(each)}) for each in found.processes]
        self._before = {(each.pid, each.created): each for each in found.processes}
        return ProcessList(at=found.at, processes=rows, more=found.more)

    def _share(self, now: link.ProcessInfo) -> float | None:
        before = self._before.get((now.pid, now.created))
        if before is None or now.read_at <= before.read_at or now.busy < before.busy:
            return None
        return round(100 * (now.busy - before.busy) / (now.read_at - before.read_at), 1)
