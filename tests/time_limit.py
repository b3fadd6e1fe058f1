"""A test that never ends fails, and tells what its threads do. The others go on."""

from __future__ import annotations

import faulthandler
import signal
import tempfile
from collections.abc import Generator
from types import FrameType

import greenlet
import pytest

SECONDS = 400.0
"""More than any test takes on a busy machine."""

AGAIN_SECONDS = 60.0
"""Until the next attempt: what cleans up behind the test may never end either."""


class TimeLimit:
    """Fails each test that takes too long, with its fixtures.

    :param seconds: for one test
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        tests = greenlet.getcurrent()

        def fail(_: int, frame: FrameType | None) -> None:
            failure = pytest.fail.Exception(f"it has not ended after {self._seconds:g} s\n{_stacks()}")
            if greenlet.getcurrent() is tests or _is_in(frame, str(item.path)):
                raise failure
            # The reactor has nothing to do, and what the test waits for never comes.
            from twisted.internet import reactor  # only now: a plugin chooses which one

            reactor.callLater(0, tests.throw, failure)  # type: ignore[attr-defined]

        former = signal.signal(signal.SIGALRM, fail)
        signal.setitimer(signal.ITIMER_REAL, self._seconds, AGAIN_SECONDS)
        try:
            return (yield)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, former)


def _stacks() -> str:
    with tempfile.TemporaryFile() as written:
        faulthandler.dump_traceback(written)
        written.seek(0)
        return written.read().decode(errors="replace")


def _is_in(frame: FrameType | None, file: str) -> bool:
    while frame is not None:
        if frame.f_code.co_filename == file:
            return True
        frame = frame.f_back
    return False
