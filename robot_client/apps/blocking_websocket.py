"""A websocket for programs without an event loop."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Coroutine, Iterator
from types import TracebackType
from typing import Any, TypeVar

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosedOK

Result = TypeVar("Result")


class BlockingWebsocket:
    """A websocket whose methods wait.

    The connection lives in a thread of its own, which alone reads and writes it. ``websockets.sync`` reads in one
    thread and writes in another, and OpenSSL allows one thread at a time for a TLS connection: there now and then a
    connection never opens, and no time limit ends the wait.

    :param url: ``ws://…`` or ``wss://…``
    :param options: those of :func:`websockets.asyncio.client.connect`
    :raises Exception: what ``connect`` raises
    """

    def __init__(self, url: str, **options: Any) -> None:
        self._loop = asyncio.new_event_loop()
        self._ended = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="websocket", daemon=True)
        self._thread.start()
        try:
            self.connection: ClientConnection = self._result(_connected(url, options))
        except BaseException:
            self._end()
            raise

    def __enter__(self) -> BlockingWebsocket:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __iter__(self) -> Iterator[str | bytes]:
        """Its messages, until it is closed in order.

        :raises websockets.exceptions.ConnectionClosed: it ends otherwise
        """
        with contextlib.suppress(ConnectionClosedOK):
            while True:
                yield self.recv()

    def send(self, message: str | bytes) -> None:
        """Send a message.

        :raises websockets.exceptions.ConnectionClosed: the connection has ended
        """
        self._result(self.connection.send(message))

    def recv(self, timeout: float | None = None) -> str | bytes:
        """The next message.

        :param timeout: seconds; by default it waits as long as it takes
        :raises TimeoutError: none came
        :raises websockets.exceptions.ConnectionClosed: the connection has ended
        """
        return self._result(self._next(timeout))

    def close(self) -> None:
        """Close the connection, and wait for the close frame of the other side, at most ``close_timeout``."""
        if not self._thread.is_alive():
            return
        try:
            self._result(self.connection.close())
        finally:
            self._end()

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._until_ended())
        finally:
            self._loop.close()

    async def _until_ended(self) -> None:
        await self._ended.wait()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for each in others:
            each.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    async def _next(self, timeout: float | None) -> str | bytes:
        try:
            return await asyncio.wait_for(self.connection.recv(), timeout)
        except asyncio.TimeoutError:  # another class than TimeoutError before Python 3.11
            raise TimeoutError from None

    def _result(self, coroutine: Coroutine[Any, Any, Result]) -> Result:
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result()

    def _end(self) -> None:
        self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join()


async def _connected(url: str, options: dict[str, Any]) -> ClientConnection:
    return await connect(url, **options)
