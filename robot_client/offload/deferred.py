"""Offloading for programs that run on Twisted's reactor: what would wait is a Deferred.

::

    from robot_client.offload.deferred import DeferredCloud

    workers = DeferredCloud()
    faces = await workers.call("detect_faces", image=jpeg)
    found = await workers.run(detect, jpeg)     # a function with @offload, here or there
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorFromThreads
from twisted.internet.threads import deferToThreadPool
from twisted.python.threadpool import ThreadPool

from relay_protocol.errors import Unavailable
from robot_client.offload.cloud import CALL_SECONDS, Cloud, Handle, cloud

P = ParamSpec("P")
R = TypeVar("R")

THREADS = 16
"""Calls of one object that run at a time; further ones wait for a turn."""


class DeferredCloud:
    """The relay's workers, for one robot, by threads of its own. Errors are those of :class:`Cloud`.

    A Deferred that is cancelled fails at once; its call goes on, and its result is dropped.

    :param client: the workers; by default those of the relay of this robot
    :param threads: calls at a time
    """

    def __init__(self, client: Cloud = cloud, threads: int = THREADS) -> None:
        # Imported here, since a program installs the reactor that it wants first.
        from twisted.internet import reactor

        self._reactor = cast(Any, reactor)
        self._cloud = client
        self._threads = ThreadPool(0, threads, "offload")
        self._threads.start()
        self._reactor.addSystemEventTrigger("during", "shutdown", self.close)

    def call(self, function: str, /, *, timeout: float = CALL_SECONDS, **arguments: Any) -> Deferred[Any]:
        """Run a function; fires with its result. See :meth:`Cloud.call`, also for ``version`` and ``newest``.

        :param timeout: seconds, also to wait for a turn
        """
        end = time.monotonic() + timeout

        def begin() -> Any:
            left = end - time.monotonic()
            if left <= 0:
                raise Unavailable(
                    f"too many calls of this program run: {function} was not begun in {timeout:g} s"
                )
            return self._cloud.call(function, timeout=left, **arguments)

        return self.run(begin)

    def submit(self, function: str, /, **options: Any) -> Deferred[Handle]:
        """Have a function run, and do not wait for it. See :meth:`Cloud.submit`."""
        return self.run(self._cloud.submit, function, **options)

    def result(self, handle: Handle, timeout: float = CALL_SECONDS) -> Deferred[Any]:
        """Fires with the result of a job. See :meth:`Handle.result`."""
        return self.run(handle.result, timeout)

    def run(self, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> Deferred[R]:
        """Fires with what a function returns that waits, such as one with ``@offload``."""
        threads: IReactorFromThreads = self._reactor
        return deferToThreadPool(threads, self._threads, function, *args, **kwargs)

    def close(self) -> None:
        """Wait for the calls that run, and end the threads. The link stays, as others may use it."""
        if self._threads.joined:
            return
        self._threads.stop()
