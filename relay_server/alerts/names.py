"""What names stand for, asked of the system in threads of our own: a name server that hangs holds up nobody else."""

from __future__ import annotations

import socket
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.defer import TimeoutError as DeferTimeout

from relay_protocol.errors import Unavailable
from relay_server.alerts.message import Undelivered
from relay_server.store import Threads

SECONDS = 5.0
THREADS = 4
WAITING = 64


class Names:
    """The system's resolver.

    :param reactor: calls results back
    """

    def __init__(self, reactor: Any) -> None:
        self._reactor = reactor
        self._threads = Threads(reactor, "alert-names", THREADS, WAITING, "too many names are looked up")

    def start(self) -> None:
        """Start the first thread."""
        self._threads.start()

    def stop(self) -> None:
        """Finish what is under way; blocks for as long as that takes."""
        self._threads.stop()

    async def addresses(self, host: str, port: int) -> list[str]:
        """All addresses of a host, each once.

        :raises Undelivered: there are none, or nobody says so in time
        """
        asked = Deferred.fromCoroutine(self._threads.run(_ask, host, port))
        try:
            return await asked.addTimeout(SECONDS, self._reactor)
        except (OSError, UnicodeError, DeferTimeout, Unavailable):
            raise Undelivered(f"nobody knows an address of '{host}' now", again=True) from None


def _ask(host: str, port: int) -> list[str]:
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    return list(dict.fromkeys(str(each[4][0]) for each in found))
