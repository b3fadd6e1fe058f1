"""A further stop in the robot's hardware: a service of the robot, a program on it, or both, as the settings say.

It comes after zero was said, and is never waited for longer than :data:`PATIENCE` and :data:`DYING`, or twice that in
the middle of a resume.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

from twisted.internet.defer import Deferred, DeferredList, fail, maybeDeferred, succeed
from twisted.internet.error import ProcessExitedAlready
from twisted.internet.protocol import ProcessProtocol
from twisted.logger import Logger
from twisted.python.failure import Failure

from relay_protocol.errors import Invalid, NotFound, SwitchboardError, Unavailable
from relay_protocol.text import inert
from robot_client.platforms.base import Platform

PATIENCE = 5.0
"""Seconds a service or a program may take."""

DYING = 1.0
"""Seconds a program may take to be gone when it is killed."""

TRIGGER = "std_srvs/srv/Trigger"
SET_BOOL = "std_srvs/srv/SetBool"
WORDS = 200
"""Most characters of what a service or a program says about its failure."""

_CDR = b"\0\1\0\0"


class Switches(NamedTuple):
    """What is to be done beside saying zero.

    :param call: service of type Trigger, called at a stop, or SetBool, called with true at a stop and with false at a
        resume; empty for none
    :param stop: program and its arguments, run at a stop; empty for none
    :param resume: the same for a resume
    """

    call: str = ""
    stop: Sequence[str] = ()
    resume: Sequence[str] = ()


class Hardware:
    """Throws the switches.

    :param reactor: for timers and programs
    """

    def __init__(self, switches: Switches, platform: Platform, reactor: Any) -> None:
        self._switches = switches
        self._platform = platform
        self._reactor = reactor
        self._resuming = False
        self._overtaken: list[Deferred[None]] = []
        """Stops that came while a resume was under way."""
        self._log = Logger("hardware")

    @property
    def reachable(self) -> bool:
        """Whether the service to be called is there, if there is to be one."""
        call = self._switches.call
        return not call or self._platform.full_name(call, "service") in self._platform.graph().services

    def stop(self) -> Deferred[list[str]]:
        """Stop; fires with what went wrong, in words.

        What is under way of a resume may undo it, so then it is done once more when that has ended.
        """
        thrown = self._throw(True, self._switches.stop)
        if not self._resuming:
            return thrown
        over: Deferred[None] = Deferred()
        self._overtaken.append(over)
        last = over.addCallback(lambda _: self._throw(True, self._switches.stop))
        return thrown.addCallback(lambda _: last)

    def resume(self) -> Deferred[list[str]]:
        """Let go again; fires with what went wrong, in words. One at a time."""
        self._resuming = True
        return self._throw(False, self._switches.resume).addCallback(self._resumed)

    def _resumed(self, problems: list[str]) -> list[str]:
        self._resuming = False
        overtaken, self._overtaken = self._overtaken, []
        for each in overtaken:
            each.callback(None)
        return problems

    def _throw(self, stop: bool, command: Sequence[str]) -> Deferred[list[str]]:
        under_way: list[Deferred[None]] = []
        if self._switches.call:
            under_way.append(maybeDeferred(self._call, self._switches.call, stop))
        if command:
            under_way.append(maybeDeferred(run, self._reactor, command))
        if not under_way:
            return succeed([])
        gathered: Deferred[Any] = DeferredList(under_way, consumeErrors=True)
        return gathered.addCallback(lambda ends: [self._words(end) for good, end in ends if not good])

    def _call(self, service: str, stop: bool) -> Deferred[None]:
        known = self._platform.graph().services.get(self._platform.full_name(service, "service"))
        types = known.types if known is not None else []
        if SET_BOOL in types:
            type, request = SET_BOOL, _CDR + bytes([stop])
        elif TRIGGER in types:
            if not stop:
                return succeed(None)
            type, request = TRIGGER, _CDR + b"\0"
        elif known is None:
            return fail(NotFound(f"there is no service {service} on this robot"))
        else:
            return fail(Invalid(f"the service {service} is neither {TRIGGER} nor {SET_BOOL}"))
        answer = self._platform.call(service, type, request, PATIENCE)
        answer.addTimeout(PATIENCE, self._reactor, onTimeoutCancel=lambda *_: _late(service))
        return answer.addCallback(lambda body: _check(service, body))

    def _words(self, failure: Failure) -> str:
        if isinstance(failure.value, SwitchboardError):
            return failure.getErrorMessage()
        self._log.failure("a switch in the hardware failed", failure)
        return "a switch in the hardware failed; the robot's log says why"


def run(reactor: Any, command: Sequence[str]) -> Deferred[None]:
    """Run a program without a shell; fails in words unless it ends with 0 within :data:`PATIENCE`.

    One that is not gone :data:`DYING` after it was killed, or that must not be killed, is left alone.
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
        self._said = b""
        self._late = False
        self._reactor = reactor
        self._timer = reactor.callLater(PATIENCE, self._kill)

    def connectionMade(self) -> None:
        """Tell it nothing."""
        self.transport.closeStdin()

    def outReceived(self, data: bytes) -> None:
        """Let it go."""

    def errReceived(self, data: bytes) -> None:
        """Keep its last words."""
        self._said = (self._said + data)[-4 * WORDS :]

    def processExited(self, reason: Failure) -> None:
        """It is gone, perhaps with children that still hold its pipes."""
        if self._timer.active():
            self._timer.cancel()
        self.transport.loseConnection()
        if self.done.called:
            return
        code = getattr(reason.value, "exitCode", None)
        if code == 0 and not self._late:
            self.done.callback(None)
            return
        self._fail(f"did not end within {PATIENCE:g} s" if self._late else f"ended with {code}")

    def _kill(self) -> None:
        self._late = True
        try:
            self.transport.signalProcess("KILL")
        except ProcessExitedAlready:
            return
        except OSError as error:  # it runs as somebody else
            self._fail(f"did not end within {PATIENCE:g} s and can't be killed ({error.strerror})")
            return
        self._timer = self._reactor.callLater(DYING, self._give_up)

    def _give_up(self) -> None:
        """It is held up in the kernel, for instance by a device that does not answer."""
        self._fail(f"did not end within {PATIENCE:g} s, and does not die")

    def _fail(self, how: str) -> None:
        lines = self._said.decode(errors="replace").split("\n")
        words = inert(next((each.strip() for each in reversed(lines) if each.strip()), ""))[:WORDS]
        self.done.errback(Unavailable(f"{self._name} {how}" + (f": {words}" if words else "")))


def _late(service: str) -> Failure:
    return Failure(Unavailable(f"the service {service} did not answer within {PATIENCE:g} s"))


def _check(service: str, body: bytes) -> None:
    """Read ``success`` and ``message``, which both types begin with.

    :raises Unavailable: it failed
    """
    if len(body) > 4 and body[4]:
        return
    words = ""
    if len(body) >= 12:
        order = "<" if body[1] & 1 else ">"
        (length,) = struct.unpack_from(order + "I", body, 8)
        words = inert(body[12 : 12 + max(0, length - 1)].decode(errors="replace"))[:WORDS]
    raise Unavailable(f"the service {service} says it could not" + (f": {words}" if words else ""))
