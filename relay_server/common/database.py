"""The database, asked from the reactor: named queries run in bounded thread pools.

One pool reads, one writes; SQLite gets one writer, so writes queue here and not on the file's lock.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Concatenate, ParamSpec, TypeVar

from sqlalchemy.orm import Session
from twisted.internet.defer import CancelledError, Deferred
from twisted.internet.interfaces import IReactorThreads
from twisted.internet.threads import deferToThreadPool
from twisted.python.failure import Failure
from twisted.python.threadpool import ThreadPool

from relay_db.engine import Database
from relay_protocol.errors import Unavailable

P = ParamSpec("P")
T = TypeVar("T")

READERS = 2
WAITING = 256
"""Reads, and writes, at a time. More queue up only when the database hangs; further ones are refused."""


class BoundedThreadPool:
    """A pool of threads with a bounded queue in front.

    :param reactor: calls results back
    :param most: pieces of work that may be under way or wait, also those whose asker has left
    :param overload: what further askers are told
    :param only_reads: the work changes nothing; what has not begun when its asker leaves is left out
    """

    def __init__(
        self,
        reactor: IReactorThreads,
        name: str,
        size: int,
        most: int,
        overload: str,
        *,
        only_reads: bool = False,
    ) -> None:
        self._reactor = reactor
        self._pool = ThreadPool(1, size, name)
        self._most = most
        self._overload = overload
        self._only_reads = only_reads
        self._under_way = 0

    def start(self) -> None:
        """Start the first thread."""
        self._pool.start()

    def stop(self) -> None:
        """Finish what is under way; blocks for as long as that takes."""
        self._pool.stop()

    async def run(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Do this in a thread. It is done also when its asker leaves (``only_reads`` apart).

        :raises Unavailable: too much waits already
        """
        if self._under_way >= self._most:
            raise Unavailable(self._overload)
        self._under_way += 1
        # Not the thread's own Deferred: cancelling that would free the place while the work goes on.
        waiting: Deferred[T] = Deferred()

        def begin() -> T:
            if self._only_reads and waiting.called:
                # Nobody waits for it any more: the threads are for others when the database is back.
                raise CancelledError
            return work(*args, **kwargs)

        done = deferToThreadPool(self._reactor, self._pool, begin)
        done.addBoth(self._done, waiting)
        return await waiting

    def _done(self, result: T | Failure, waiting: Deferred[T]) -> None:
        self._under_way -= 1
        if isinstance(result, Failure):
            waiting.errback(result)
        else:
            waiting.callback(result)


class AsyncDatabase:
    """Runs queries of :mod:`relay_db.queries` off the reactor's thread.

    :param reactor: calls results back
    """

    def __init__(self, reactor: IReactorThreads, database: Database) -> None:
        self.database = database
        overload = "the database is overloaded; try again in a moment"
        self._readers = BoundedThreadPool(reactor, "db-read", READERS, WAITING, overload, only_reads=True)
        self._writers = BoundedThreadPool(reactor, "db-write", database.writers, WAITING, overload)

    def start(self) -> None:
        """Start the pools. The database must be upgraded already."""
        self._readers.start()
        self._writers.start()

    def stop(self) -> None:
        """Finish what is under way and close the database; blocks for as long as that takes."""
        self._readers.stop()
        self._writers.stop()
        self.database.close()

    async def read(self, query: Callable[Concatenate[Session, P], T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run a query that changes nothing.

        :raises Unavailable: the database can't be reached, or too many asks wait for it
        """

        def work() -> T:
            with self.database.reading() as session:
                return query(session, *args, **kwargs)

        return await self._readers.run(work)

    async def write(
        self, query: Callable[Concatenate[Session, P], T], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """Run a query in a transaction of its own; it has been committed when this returns.

        It is done also when its asker has left: somebody logged out, removed or revoked something.

        :raises Unavailable: as :meth:`read`
        """

        def work() -> T:
            with self.database.begin() as session:
                return query(session, *args, **kwargs)

        return await self._writers.run(work)
