"""Database access from the reactor: named queries run in bounded thread pools.

One pool reads, one writes. SQLite gets one writer, so writes queue here and not on the lock of the file.
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
"""Most reads, and most writes, that run or wait. So many wait only if the database hangs; further ones are refused."""


class BoundedThreadPool:
    """A pool of threads with a bounded queue in front.

    :param reactor: calls results back
    :param most: most jobs that run or wait, including those whose caller has left
    :param overload: error text for further callers
    :param only_reads: whether the work changes nothing; a job whose caller leaves before it begins is skipped
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
        """Finish all jobs; blocks for as long as that takes."""
        self._pool.stop()

    async def run(self, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Do work in a thread. It is done even if its caller leaves, except with ``only_reads``.

        :raises Unavailable: too many jobs wait
        """
        if self._under_way >= self._most:
            raise Unavailable(self._overload)
        self._under_way += 1
        # Not the thread's own Deferred: cancelling it would free the slot while the work goes on.
        waiting: Deferred[T] = Deferred()

        def begin() -> T:
            if self._only_reads and waiting.called:
                # Its caller has left; skipping it leaves the threads to others when the database is back.
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
        """Start the pools. The database must have been upgraded before."""
        self._readers.start()
        self._writers.start()

    def stop(self) -> None:
        """Finish all queries and close the database; blocks for as long as that takes."""
        self._readers.stop()
        self._writers.stop()
        self.database.close()

    async def read(self, query: Callable[Concatenate[Session, P], T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run a query that changes nothing.

        :raises Unavailable: the database does not answer, or too many queries wait
        """

        def work() -> T:
            with self.database.reading() as session:
                return query(session, *args, **kwargs)

        return await self._readers.run(work)

    async def write(
        self, query: Callable[Concatenate[Session, P], T], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """Run a query in a transaction of its own; it has been committed when this returns.

        It runs even if its caller has left, as it may be a logout, a removal or a revocation.

        :raises Unavailable: as :meth:`read`
        """

        def work() -> T:
            with self.database.begin() as session:
                return query(session, *args, **kwargs)

        return await self._writers.run(work)
