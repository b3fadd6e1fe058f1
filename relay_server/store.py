"""The database, asked from the reactor: named queries run in bounded thread pools.

One pool reads, one writes; SQLite gets one writer, so writes queue here and not on the file's lock.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Concatenate, ParamSpec, TypeVar

from sqlalchemy.orm import Session
from twisted.internet.interfaces import IReactorThreads
from twisted.internet.threads import deferToThreadPool
from twisted.python.threadpool import ThreadPool

from relay_db.engine import Database
from relay_protocol.errors import Unavailable

P = ParamSpec("P")
T = TypeVar("T")

READERS = 2
WAITING = 256
"""More asks than this queue up only when the database hangs; further ones are refused."""


class Store:
    """Runs queries of :mod:`relay_db.queries` off the reactor's thread.

    :param reactor: calls results back
    """

    def __init__(self, reactor: IReactorThreads, database: Database) -> None:
        self.database = database
        self._reactor = reactor
        self._readers = ThreadPool(1, READERS, "db-read")
        self._writers = ThreadPool(1, database.writers, "db-write")
        self._waiting = 0

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

        return await self._run(self._readers, work)

    async def write(
        self, query: Callable[Concatenate[Session, P], T], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """Run a query in a transaction of its own; it has been committed when this returns.

        :raises Unavailable: as :meth:`read`
        """

        def work() -> T:
            with self.database.begin() as session:
                return query(session, *args, **kwargs)

        return await self._run(self._writers, work)

    async def _run(self, pool: ThreadPool, work: Callable[[], T]) -> T:
        if self._waiting >= WAITING:
            raise Unavailable("the database is overloaded; try again in a moment")
        self._waiting += 1
        try:
            result: T = await deferToThreadPool(self._reactor, pool, work)
            return result
        finally:
            self._waiting -= 1
