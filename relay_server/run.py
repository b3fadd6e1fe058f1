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
from relay_server.relay import Relay

STOP_SECONDS = 8.0
_ENDING = (signal.SIGTERM, signal.SIGINT)
log = Logger()


def run(
    settings: RelaySettings, ready: Callable[[Relay, str | None], None], *, in_terminal: bool = False
) -> int:
    """Serve until SIGTERM or SIGINT.

    :param ready: called once everything listens, with the first login link if no user can log in yet
    :param in_terminal: whether SIGHUP ends it too, which otherwise reloads the TLS certificate, and nothing is drained
    :returns: exit code; 1 when it could not start, 3 when the database or folder is not available; stderr
        says why
    """
    reactor = monotonic_reactor()
    try:
        relay = Relay(reactor, settings)
    except SwitchboardError as error:
        sys.stderr.write(f"switchboard: {error}\n")
        return _code_of(error)
    return _Process(reactor, relay, ready, in_terminal).run()


class _Process:
    """A relay between its start and the end of the process."""

    def __init__(
        self,
        reactor: Any,
        relay: Relay,
        ready: Callable[[Relay, str | None], None],
        in_terminal: bool,
    ) -> None:
        self._reactor = reactor
        self._relay = relay
        self._ready = ready
        self._in_terminal = in_terminal
        self._exit_code = 0
        self._leaving = False
        self._unfinished = ""
        """Why the relay did not stop in time; empty if it did."""

    def run(self) -> int:
        """Run the reactor until it stops; returns the exit code."""
        self._reactor.callWhenRunning(self._start)
        self._reactor.addSystemEventTrigger("before", "shutdown", self._stop)
        on_hangup = self._leave if self._in_terminal else self._relay.reload_tls
        signal.signal(signal.SIGHUP, lambda *_: self._reactor.callFromThread(on_hangup))
        self._reactor.run()
        if self._unfinished:
            # Threads that wait for a hanging database would keep the process running.
            log.error("leaving with the database unfinished: {reason}", reason=self._unfinished)
            sys.stdout.flush()
            os._exit(self._exit_code)
        return self._exit_code

    def _start(self) -> None:
        # In place of Twisted's handlers, which log a traceback at a second signal. A background job may have
        # been started to ignore Ctrl-C.
        for number in _ENDING:
            if signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, lambda *_: self._reactor.callFromThread(self._leave))
        Deferred.fromCoroutine(self._begin()).addErrback(self._failed)

    async def _begin(self) -> None:
        await self._relay.start()
        # Objects that exist now stay. Collecting garbage among them took 90 ms every few seconds under load.
        gc.collect()
        gc.freeze()
        self._ready(self._relay, await self._relay.first_login())

    def _failed(self, failure: Failure) -> None:
        sys.stderr.write(f"switchboard: {_sentence(failure)}\n")
        self._exit_code = self._exit_code or _code_of(failure.value)
        self._leave()

    def _leave(self) -> None:
        """Stop, after a drain; at the second signal at once."""
        if self._leaving or self._exit_code or self._in_terminal:
            leave(self._reactor)
            return
        self._leaving = True
        drained = Deferred.fromCoroutine(self._relay.drain())
        drained.addErrback(lambda failure: log.failure("the drain failed", failure))
        drained.addBoth(lambda _: leave(self._reactor))

    def _stop(self) -> Deferred[Any]:
        # Until the process is gone: at its very end Python would let the signals kill it.
        for number in _ENDING:
            signal.signal(number, signal.SIG_IGN)
        done = Deferred.fromCoroutine(self._relay.stop()).addTimeout(STOP_SECONDS, self._reactor)
        return done.addErrback(self._stopped_late)

    def _stopped_late(self, failure: Failure) -> None:
        timed_out = failure.check(TimeoutError)
        self._unfinished = f"no answer within {STOP_SECONDS:g} s" if timed_out else failure.getErrorMessage()


def leave(reactor: Any) -> None:
    """Stop the reactor, unless it is stopping already."""
    with suppress(ReactorNotRunning):
        reactor.stop()


def _code_of(error: BaseException | None) -> int:
    return 3 if isinstance(error, Unavailable) else 1


def monotonic_reactor() -> Any:
    """Twisted's reactor with the monotonic clock. Its default, the wall clock, jumps when NTP sets it."""
    from twisted.internet import reactor

    monotonic: Any = reactor
    monotonic.seconds = time.monotonic
    return monotonic


def _sentence(failure: Failure) -> str:
    error = failure.value
    if isinstance(error, CannotListenError):
        reason = getattr(error.socketError, "strerror", None) or str(error.socketError)
        where = f"{error.interface or 'any address'} port {error.port}"
        return f"cannot listen on {where}: {reason}; give another address with --http or --robots"
    if isinstance(error, SwitchboardError):
        return str(error)
    if isinstance(error, OSError):
        return f"cannot start: {error.strerror or error}{f': {error.filename}' if error.filename else ''}"
    return f"failed to start: {failure.getTraceback()}"
