"""Starts the parts of a process in order and stops them in reverse."""

from __future__ import annotations

import threading
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from twisted.internet.defer import Deferred
from twisted.logger import Logger


@dataclass(frozen=True, kw_only=True)
class LifecycleStep:
    """One part of a process. Each function is optional.

    :param name: for the log
    :param start: may return an awaitable, which is waited for
    :param leave: called with the reason when the process begins to stop; must not wait for anything
    :param stop: called once every step has left; may return an awaitable, which is waited for
    :param join: called last, in a thread of its own; may block
    """

    name: str
    start: Callable[[], Awaitable[object] | None] | None = None
    leave: Callable[[str], object] | None = None
    stop: Callable[[], Awaitable[object] | None] | None = None
    join: Callable[[], object] | None = None


class Lifecycle:
    """A stack of steps.

    Stopping has three phases, each in reverse order of starting: all steps leave, then each stops, then each joins its
    threads. A step that fails to leave, stop or join is logged and keeps no other step from it.

    :param reactor: Twisted's
    :param steps: in the order of starting
    """

    log = Logger()

    def __init__(self, reactor: Any, steps: list[LifecycleStep]) -> None:
        self._reactor = reactor
        self._steps = steps
        self._started: list[LifecycleStep] = []
        self._stopping = False

    async def start(self) -> None:
        """Start each step after the one before it.

        :raises Exception: what a step raised; those after it are not started, and :meth:`stop` stops the others
        """
        for step in self._steps:
            if self._stopping:
                return
            # A step that fails half-way has something to stop too.
            self._started.append(step)
            if step.start is not None:
                await _settled(step.start())

    async def stop(self, reason: str) -> None:
        """Stop what was started; returns when its threads have ended.

        :param reason: for clients and robots
        """
        self._stopping = True
        steps = self._started[::-1]
        self._started = []
        for step in steps:
            if step.leave is not None:
                try:
                    step.leave(reason)
                except Exception:
                    self.log.failure("{step} failed to leave", step=step.name)
        for step in steps:
            if step.stop is not None:
                try:
                    await _settled(step.stop())
                except Exception:
                    self.log.failure("{step} failed to stop", step=step.name)
        await self._join(steps)

    async def _join(self, steps: list[LifecycleStep]) -> None:
        # In a daemon thread: a thread that waits for a hanging database must block neither the reactor nor the exit.
        def join() -> None:
            for step in steps:
                if step.join is not None:
                    try:
                        step.join()
                    except Exception:
                        self.log.failure("the threads of {step} failed to end", step=step.name)
            self._reactor.callFromThread(done.callback, None)

        done: Deferred[None] = Deferred()
        threading.Thread(target=join, name="join", daemon=True).start()
        await done


async def _settled(answer: Awaitable[object] | None) -> None:
    if answer is not None:
        await answer
