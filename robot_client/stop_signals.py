"""SIGTERM and SIGINT while the daemon starts, when Twisted's reactor does not handle them yet."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import Any

from twisted.internet.error import ReactorNotRunning


def exit_on_signals(before: Callable[[], object]) -> None:
    """Have them end this process at once, with exit code 0.

    :param before: called before that
    """

    def leave(number: int, frame: FrameType | None) -> None:
        before()
        # The orderly end of Python would wait for threads, as that of a ROS executor.
        os._exit(0)

    _handle(leave)


def stop_reactor_on_signals(reactor: Any) -> None:
    """Have them stop a reactor, as soon as it runs. Then it brings handlers of its own."""

    def stop() -> None:
        with suppress(ReactorNotRunning):
            reactor.stop()

    _handle(lambda number, frame: reactor.callFromThread(stop))


def _handle(handler: Callable[[int, FrameType | None], None]) -> None:
    for number in (signal.SIGTERM, signal.SIGINT):
        # A background job may have been started to ignore Ctrl-C.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)
