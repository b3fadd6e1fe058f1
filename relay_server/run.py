"""Runs a relay in this process until a signal ends it."""

from __future__ import annotations

import gc
import os
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from twisted.internet.defer import Deferred, TimeoutError
from twisted.internet.error import CannotListenError, ReactorNotRunning
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol.errors import SwitchboardError, Unavailable
from relay_server.config import RelaySettings
from relay_server.service import Relay

STOP_SECONDS = 8.0
_ENDING = (signal.SIGTERM, signal.SIGINT)
log = Logger()


def run(
    settings: RelaySettings, ready: Callable[[Relay, str | None], None], *, hangup_ends: bool = False
) -> int:
    """Serve until SIGTERM or SIGINT.

    :param ready: called once everything listens, with the first login link if nobody can log in yet
    :param hangup_ends: whether SIGHUP ends it too; else it reads the TLS certificate again
    :returns: exit code; 1 when it could not start, 3 when the database or folder can't be had; said on stderr
    """
    reactor = monotonic_reactor()
    try:
        relay = Relay(reactor, settings)
    except SwitchboardError as error:
        sys.stderr.write(f"switchboard: {error}\n")
        return _code_of(error)
    failed: list[int] = []
    stuck: list[str] = []

    async def begin() -> None:
        await relay.start()
        # What is there by now stays. To look through all of it for garbage, every few seconds under load, took 90 ms.
        gc.collect()
        gc.freeze()
        ready(relay, await relay.first_login())

    def end() -> None:
        leave(reactor)

    def wrong(failure: Failure) -> None:
        sys.stderr.write(f"switchboard: {_sentence(failure)}\n")
        failed.append(_code_of(failure.value))
        end()

    def unfinished(failure: Failure) -> None:
        timed_out = failure.check(TimeoutError)
        stuck.append(f"no answer within {STOP_SECONDS:g} s" if timed_out else failure.getErrorMessage())

    def stopping() -> Deferred[Any]:
        # Until the process is gone: at its very end Python would let them kill it.
        for number in _ENDING:
            signal.signal(number, signal.SIG_IGN)
        done = Deferred.fromCoroutine(relay.stop()).addTimeout(STOP_SECONDS, reactor)
        return done.addErrback(unfinished)

    def start() -> None:
        # In place of Twisted's, which log a traceback when a second one comes. A job in the background may have been
        # started to ignore Ctrl-C.
        for number in _ENDING:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, lambda *_: reactor.callFromThread(end))
        Deferred.fromCoroutine(begin()).addErrback(wrong)

    reactor.callWhenRunning(start)
    reactor.addSystemEventTrigger("before", "shutdown", stopping)
    on_hangup = end if hangup_ends else relay.reload_tls
    signal.signal(signal.SIGHUP, lambda *_: reactor.callFromThread(on_hangup))
    reactor.run()
    code = failed[0] if failed else 0
    if stuck:
        # Threads that wait for a database that hangs would keep the process for as long as it does.
        log.error("leaving with the database unfinished: {reason}", reason=stuck[0])
        sys.stdout.flush()
        os._exit(code)
    return code


def leave(reactor: Any) -> None:
    """Stop the reactor; once it stops, nothing more comes of this."""
    with suppress(ReactorNotRunning):
        reactor.stop()


def _code_of(error: BaseException | None) -> int:
    return 3 if isinstance(error, Unavailable) else 1


def monotonic_reactor() -> Any:
    """Twisted's reactor on the monotonic clock: its own, the wall clock, jumps when NTP sets it."""
    from twisted.internet import reactor

    monotonic: Any = reactor
    monotonic.seconds = time.monotonic
    return monotonic


def _sentence(failure: Failure) -> str:
    error = failure.value
    if isinstance(error, CannotListenError):
        reason = getattr(error.socketError, "strerror", None) or str(error.socketError)
        return f"can't listen on {error.interface or 'any address'} port {error.port}: {reason}"
    if isinstance(error, SwitchboardError):
        return str(error)
    if isinstance(error, OSError):
        return f"it can't start: {error.strerror or error}{f': {error.filename}' if error.filename else ''}"
    return f"it failed to start: {failure.getTraceback()}"
