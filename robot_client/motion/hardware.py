"""Stops the robot's hardware by a service of the robot, a program on it, or both, as configured.

Each is a switch, set at a stop and released at a resume. Zero velocity is published first. Setting the switches takes
at most :data:`SWITCH_SECONDS` plus :data:`KILL_SECONDS`, twice that when it begins during a resume. A switch that
failed is set again as long as the robot is stopped.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from twisted.internet.defer import Deferred, DeferredList, fail, maybeDeferred, succeed
from twisted.internet.error import ProcessExitedAlready
from twisted.internet.protocol import ProcessProtocol
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_protocol.text import escape_unprintable
from robot_client.platforms.base import Platform

SWITCH_SECONDS = 5.0
"""Seconds a service or a program may take."""

KILL_SECONDS = 1.0
"""Seconds a program may take to end after SIGKILL."""

FREQUENT_RETRIES = 30
"""How often, one second apart, a failed switch is set again. A daemon that starts stopped also looks for the service
this often before it reports that there is none, as nodes may start after it."""

RARE_RETRY_INTERVAL = 10
"""After :data:`FREQUENT_RETRIES`, only every RARE_RETRY_INTERVAL-th call of :meth:`Hardware.retry` tries again."""

TRIGGER = "std_srvs/srv/Trigger"
SET_BOOL = "std_srvs/srv/SetBool"
MAX_QUOTED = 200
"""Most characters quoted from the message of a service, or the error output of a program."""

_CDR = b"\0\1\0\0"


class Switches(NamedTuple):
    """The settings of the hardware switches.

    :param call: service of type Trigger, called at a stop, or SetBool, called with true at a stop and with false at a
        resume; empty for none
    :param stop: program and its arguments, run at a stop; empty for none
    :param resume: the same for a resume
    """

    call: str = ""
    stop: Sequence[str] = ()
    resume: Sequence[str] = ()


_CALL, _PROGRAM = "call", "program"
_ALL = frozenset((_CALL, _PROGRAM))


class Hardware:
    """Sets and releases the switches.

    :param reactor: for timers and programs
    """

    def __init__(self, switches: Switches, platform: Platform, reactor: Any) -> None:
        self.on_problems: Callable[[list[str]], None] = lambda problems: None
        """Called with sentences about switches that could not be set; with none when all are set."""
        self._switches = switches
        self._platform = platform
        self._reactor = reactor
        self._types: list[str] = []
        """Types of the service, as last found in the graph."""
        self._prepared_type = ""
        """The type for which the platform keeps a client; empty before the service was found."""
        self._pending: dict[str, str] = {}
        """By switch still to be set, a sentence about its failure; empty where it was not tried."""
        self._attempts = 0
        self._expect_service = False
        """Whether the service may still appear; until then its absence is not reported."""
        self._retry_done: Deferred[None] | None = None
        """While failed switches are set again: fires when that has ended."""
        self._stop_waiters: list[Deferred[list[str]]] = []
        """Callers of a stop that is under way."""
        self._resuming = False
        self._stops_during_resume: list[Deferred[None]] = []
        """Stops requested while a resume is under way; they fire when it ends."""
        self._log = Logger("hardware")

    def begin_stopped(self) -> None:
        """Begin with a robot stopped before the daemon started: :meth:`retry` sets the switches when it can."""
        self._pending, self._attempts, self._expect_service = dict.fromkeys(_ALL, ""), 0, True

    def prepare(self) -> None:
        """Find the service and prepare its client before it is needed; to be called every second."""
        if self._switches.call and not self._prepared_type:
            try:
                self._find_service()
            except Exception:  # one failure must not end the periodic calls
                self._log.failure("the graph could not be read")

    def retry(self) -> None:
        """Set failed switches again; to be called every second while the robot is stopped and no stop is under way."""
        if not self._pending or self._retry_done is not None or self._resuming:
            return
        self._attempts += 1
        if self._attempts > FREQUENT_RETRIES and self._attempts % RARE_RETRY_INTERVAL:
            return
        which = frozenset(self._pending)
        if (
            self._expect_service
            and self._attempts < FREQUENT_RETRIES
            and self._switches.call
            and not self._prepared_type
        ):
            which -= {_CALL}  # the program does not wait for the service
            if not which or not self._switches.stop:
                return
        else:
            self._expect_service = False
        self._retry_done = Deferred()
        retried = maybeDeferred(self._stop, which)
        retried.addErrback(self._log_unexpected).addCallback(self._retry_ended)

    def stop(self) -> Deferred[list[str]]:
        """Set all switches; fires with sentences about failures.

        Calls made while a stop is under way share its result. A resume under way may undo the stop, so the switches
        are then set once more after the resume has ended.
        """
        self._attempts, self._expect_service = 0, False
        stopped: Deferred[list[str]] = Deferred()
        self._stop_waiters.append(stopped)
        if len(self._stop_waiters) == 1:
            maybeDeferred(self._stop_despite_resume).addErrback(self._log_unexpected).addCallback(
                self._notify_stopped
            )
        return stopped

    def _stop_despite_resume(self) -> Deferred[list[str]]:
        stopped = self._stop()
        if not self._resuming:
            return stopped
        resumed: Deferred[None] = Deferred()
        self._stops_during_resume.append(resumed)
        last = resumed.addCallback(lambda _: self._stop())
        return stopped.addCallback(lambda _: last)

    def _notify_stopped(self, problems: list[str]) -> None:
        waiters, self._stop_waiters = self._stop_waiters, []
        for each in waiters:
            each.callback(list(problems))

    def resume(self) -> Deferred[list[str]]:
        """Release all switches; fires with sentences about failures. One call at a time."""
        self._resuming = True
        retry_ended = self._retry_done or succeed(None)
        released = retry_ended.addCallback(lambda _: self._release())
        released.addErrback(lambda failure: {_CALL: self._log_unexpected(failure)[0]})
        return released.addCallback(self._notify_resumed)

    def _release(self) -> Deferred[dict[str, str]]:
        if self._stops_during_resume:  # a stop came during the wait: its switches must stay set
            return succeed({})
        self._pending = {}
        return self._set_switches(False, _ALL)

    def _notify_resumed(self, problems: dict[str, str]) -> list[str]:
        self._resuming = False
        waiters, self._stops_during_resume = self._stops_during_resume, []
        for each in waiters:
            each.callback(None)
        return list(problems.values())

    def _stop(self, which: frozenset[str] = _ALL) -> Deferred[list[str]]:
        return self._set_switches(True, which).addCallback(self._record_problems, which)

    def _record_problems(self, problems: dict[str, str], which: frozenset[str]) -> list[str]:
        """Note the problems of these switches. Only a resume releases switches, and it waits for this."""
        self._pending = {
            name: sentence for name, sentence in self._pending.items() if name not in which
        } | problems
        self.on_problems([sentence for sentence in self._pending.values() if sentence])
        return list(problems.values())

    def _retry_ended(self, problems: list[str]) -> None:
        retry, self._retry_done = self._retry_done, None
        if retry is not None:
            retry.callback(None)

    def _set_switches(self, stop: bool, which: frozenset[str]) -> Deferred[dict[str, str]]:
        """Set switches, or release them; fires with a sentence about each that failed.

        :param stop: whether to set them
        :param which: the switches, of :data:`_ALL`
        """
        under_way: dict[str, Deferred[None]] = {}
        if self._switches.call and _CALL in which:
            under_way[_CALL] = maybeDeferred(self._call, self._switches.call, stop)
        command = self._switches.stop if stop else self._switches.resume
        if command and _PROGRAM in which:
            under_way[_PROGRAM] = maybeDeferred(run, self._reactor, command)
        gathered: Deferred[Any] = DeferredList(list(under_way.values()), consumeErrors=True)
        return gathered.addCallback(
            lambda results: {
                name: self._describe(failure)
                for name, (succeeded, failure) in zip(under_way, results, strict=True)
                if not succeeded
            }
        )

    def _find_service(self) -> None:
        """Look for the service in the graph; where it exists, have the platform keep a client."""
        call = self._switches.call
        known = self._platform.graph().services.get(self._platform.full_name(call, "service"))
        if known is None:
            return
        self._types = known.types
        type = self._type
        if type and type != self._prepared_type:
            self._prepared_type = type
            self._platform.prepare_call(call, type)

    @property
    def _type(self) -> str:
        """The type used to call the service; empty: there is no service, or none of a known type."""
        return next((each for each in (SET_BOOL, TRIGGER) if each in self._types), "")

    def _call(self, service: str, stop: bool) -> Deferred[None]:
        try:
            self._find_service()
        except Exception:  # the types found before may still hold
            self._log.failure("the graph could not be read")
        type = self._type
        if type == SET_BOOL:
            request = _CDR + bytes([stop])
        elif type == TRIGGER:
            if not stop:
                return succeed(None)
            request = _CDR + b"\0"
        elif not self._types:
            return fail(NotFound(f"there is no service {service} on this robot"))
        else:
            return fail(Invalid(f"the service {service} is neither {TRIGGER} nor {SET_BOOL}"))
        answer = self._platform.call(service, type, request, SWITCH_SECONDS)
        answer.addTimeout(SWITCH_SECONDS, self._reactor, onTimeoutCancel=lambda *_: _timeout_failure(service))
        return answer.addCallback(lambda body: _check_response(service, body))

    def _describe(self, failure: Failure) -> str:
        if isinstance(failure.value, SwitchboardError):
            return failure.getErrorMessage()
        return self._log_unexpected(failure)[0]

    def _log_unexpected(self, failure: Failure) -> list[str]:
        self._log.failure("a hardware switch failed", failure)
        return ["a hardware switch failed; the robot's log says why"]


def run(reactor: Any, command: Sequence[str]) -> Deferred[None]:
    """Run a program without a shell.

    A program still running after :data:`SWITCH_SECONDS` is killed. One that survives this for
    :data:`KILL_SECONDS`, or can't be killed, is left running.

    :return: fires when the program ends with 0; else fails with :class:`~relay_protocol.errors.Unavailable`
    """
    program = _Program(reactor, command[0])
    try:
        reactor.spawnProcess(
            program,
            command[0],
            list(command),
            env=dict(os.environ),
            childFDs={0: "w", 1: "r", 2: "r"},
        )
    except OSError as error:
        return fail(Unavailable(f"{command[0]} can't be started: {error.strerror}"))
    return program.done


class _Program(ProcessProtocol):
    transport: Any

    def __init__(self, reactor: Any, name: str) -> None:
        self.done: Deferred[None] = Deferred()
        self._name = name
        self._stderr = b""
        self._timed_out = False
        self._reactor = reactor
        self._timer = reactor.callLater(SWITCH_SECONDS, self._kill)

    def connectionMade(self) -> None:
        """Close its standard input."""
        self.transport.closeStdin()

    def outReceived(self, data: bytes) -> None:
        """Ignore its standard output."""

    def errReceived(self, data: bytes) -> None:
        """Keep the end of its error output for the message."""
        self._stderr = (self._stderr + data)[-4 * MAX_QUOTED :]

    def processExited(self, reason: Failure) -> None:
        """Report the result without waiting for the pipes, which its children may still hold."""
        if self._timer.active():
            self._timer.cancel()
        self.transport.loseConnection()
        if self.done.called:
            return
        code = getattr(reason.value, "exitCode", None)
        if code == 0 and not self._timed_out:
            self.done.callback(None)
            return
        self._fail(f"did not end within {SWITCH_SECONDS:g} s" if self._timed_out else f"ended with {code}")

    def _kill(self) -> None:
        self._timed_out = True
        try:
            self.transport.signalProcess("KILL")
        except ProcessExitedAlready:
            return
        except OSError as error:  # it runs as another user
            self._fail(f"did not end within {SWITCH_SECONDS:g} s and can't be killed ({error.strerror})")
            return
        self._timer = self._reactor.callLater(KILL_SECONDS, self._give_up)

    def _give_up(self) -> None:
        """Stop waiting: the program hangs in the kernel, for instance in a device that does not answer."""
        self._fail(f"did not end within {SWITCH_SECONDS:g} s, and could not be killed")

    def _fail(self, how: str) -> None:
        lines = self._stderr.decode(errors="replace").split("\n")
        last_line = escape_unprintable(next((each.strip() for each in reversed(lines) if each.strip()), ""))[
            :MAX_QUOTED
        ]
        self.done.errback(Unavailable(f"{self._name} {how}" + (f": {last_line}" if last_line else "")))


def _timeout_failure(service: str) -> Failure:
    return Failure(Unavailable(f"the service {service} did not answer within {SWITCH_SECONDS:g} s"))


def _check_response(service: str, body: bytes) -> None:
    """Read ``success`` and ``message``, with which responses of both types begin.

    :param body: CDR
    :raises Unavailable: the service reports a failure
    """
    if len(body) > 4 and body[4]:
        return
    message = ""
    if len(body) >= 12:
        order = "<" if body[1] & 1 else ">"
        (length,) = struct.unpack_from(order + "I", body, 8)
        message = escape_unprintable(body[12 : 12 + max(0, length - 1)].decode(errors="replace"))[:MAX_QUOTED]
    raise Unavailable(f"the service {service} reported a failure" + (f": {message}" if message else ""))
