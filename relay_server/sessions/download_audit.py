"""Audit entries of downloads."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Awaitable, Callable, Hashable

from relay_server.sessions.manager import Admission

REPEAT_SECONDS = 3600.0
"""A download has one audit entry in this time, however many parts it is read in."""

MAX_REMEMBERED = 1000
"""Downloads that are remembered for that."""


class DownloadAudit:
    """Writes one audit entry for all parts of a download.

    :param wall: Unix time in seconds
    """

    def __init__(self, wall: Callable[[], float]) -> None:
        self._wall = wall
        self._written: OrderedDict[Hashable, float] = OrderedDict()

    async def write_once(
        self, admission: Admission, file: Hashable, write: Callable[[], Awaitable[None]]
    ) -> None:
        """Write an entry, unless this user has one for this file and from this address.

        :raises Unavailable: it cannot be written
        """
        key = (admission.permit.principal.user_id, file, admission.address)
        if self._written.get(key, -REPEAT_SECONDS) + REPEAT_SECONDS > self._wall():
            return
        await write()
        self._written[key] = self._wall()
        self._written.move_to_end(key)
        while len(self._written) > MAX_REMEMBERED:
            self._written.popitem(last=False)
