"""What names stand for, asked of the system in threads of our own, of which no user has more than a few.

A name server that hangs holds a thread for as long as the system waits for it, however soon we give up; so a place is
let go only when its thread is done, and who has none left waits for himself alone.
"""

from __future__ import annotations

import socket
from ipaddress import ip_address
from typing import Any

from twisted.internet.defer import Deferred, DeferredSemaphore
from twisted.internet.defer import TimeoutError as DeferTimeout
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol.errors import Unavailable
from relay_server.alerts.message import Undelivered
from relay_server.store import Threads

SECONDS = 5.0
THREADS = 16
LOOKUPS = 2
"""Names of one user that are looked up at a time."""

WAITING = 64

SPECIAL = "it is in a network that this relay does not send to"

_log = Logger()


class Names:
    """The system's resolver.

    :param reactor: calls results back
    """

    def __init__(self, reactor: Any) -> None:
        self._reactor = reactor
        self._threads = Threads(reactor, "alert-names", THREADS, WAITING, "too many names are looked up")
        self._places: dict[int, DeferredSemaphore] = {}

    def start(self) -> None:
        """Start the first thread."""
        self._threads.start()

    def stop(self) -> None:
        """Finish what is under way; blocks for as long as that takes."""
        self._threads.stop()

    async def addresses(self, host: str, port: int, user: int) -> list[str]:
        """All addresses of a host, each once; an address stands for itself, and nobody is asked.

        :param user: for whom: his lookups that hang are in nobody else's way
        :raises Undelivered: there are none, or nobody says so in time
        """
        literal = _literal(host)
        if literal is not None:
            return [literal]
        asked = Deferred.fromCoroutine(self._look_up(host, port, user))
        try:
            return await asked.addTimeout(SECONDS, self._reactor)
        except (OSError, UnicodeError, DeferTimeout, Unavailable):
            raise unreachable(host, "nobody knows an address of it now") from None

    async def _look_up(self, host: str, port: int, user: int) -> list[str]:
        places = self._places.setdefault(user, DeferredSemaphore(LOOKUPS))
        try:
            await places.acquire()
            # Whoever waits may give up: that leaves the thread at work, and its place taken.
            answer: Deferred[list[str]] = Deferred()
            looking = Deferred.fromCoroutine(self._threads.run(_ask, host, port))
            looking.addBoth(self._looked, places, user, answer)
            return await answer
        finally:
            self._tidy(places, user)

    def _looked(self, result: Any, places: DeferredSemaphore, user: int, answer: Deferred[list[str]]) -> None:
        places.release()
        self._tidy(places, user)
        if isinstance(result, Failure):
            answer.errback(result)
        else:
            answer.callback(result)

    def _tidy(self, places: DeferredSemaphore, user: int) -> None:
        if places.tokens == places.limit and self._places.get(user) is places:
            del self._places[user]


def unreachable(host: str, why: str) -> Undelivered:
    """What people are told of a host that nothing can be sent to.

    Of a name only the log knows which it is: names of the relay's own networks are nobody else's business.

    :param why: for the log
    """
    if _literal(host) is not None:
        return Undelivered(f"{host}: {SPECIAL}; its administrator can allow that", again=False)
    _log.info("nothing can be sent to '{host}': {why}", host=host, why=why)
    words = f"nobody knows an address of '{host}' now, or {SPECIAL}; its administrator can allow that"
    return Undelivered(words, again=True)


def _literal(host: str) -> str | None:
    """An address as the system would write it."""
    try:
        return str(ip_address(host))
    except ValueError:
        return None


def _ask(host: str, port: int) -> list[str]:
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    return list(dict.fromkeys(str(each[4][0]) for each in found))
