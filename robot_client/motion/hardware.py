"""A further stop in the robot's hardware: a service of the robot, a program on it, or both, as the settings say.

It comes after zero was said, and is never waited for longer than :data:`PATIENCE` and :data:`DYING`, or twice that in
the middle of a resume. What failed is thrown again as long as the robot is stopped.
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
from relay_protocol.text import inert
from robot_client.platforms.base import Platform

PATIENCE = 5.0
"""Seconds a service or a program may take."""

DYING = 1.0
"""Seconds a program may take to be gone when it is killed."""

LOOKS = 30
"""How often, a second apart, what failed is thrown again, and how often a daemon that starts stopped looks for the
service before it says that there is none: nodes may start after it."""

RARELY = 10
"""After that only each so many looks."""

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


_CALL, _PROGRAM = "call", "program"
_ALL = frozenset((_CALL, _PROGRAM))


class Hardware:
    """Throws the switches.

    :param reactor: for timers and programs
    """

    def __init__(self, switches: Switches, platform: Platform, reactor: Any) -> None:
        self.on_owed: Callable[[list[str]], None] = lambda problems: None
        """Told what a stop has not achieved, in words, and with none when it has."""
        self._switches = switches
        self._platform = platform
        self._reactor = reactor
        self._types: list[str] = []
        """Of the service, as it was found last."""
        self._prepared = ""
        """The type of which a client is kept."""
        self._owed: dict[str, str] = {}
        """What is still to be thrown, and what went wrong with it; empty where it was not tried."""
        self._looks = 0
        self._patient = False
        """Whether the service may yet come: nobody is told so soon that it is not there."""
        self._again: Deferred[None] | None = None
        """While something is thrown again: fires when that has ended."""
        self._stopping: list[Deferred[list[str]]] = []
        """Who waits for a stop under way."""
        self._resuming = False
        self._overtaken: list[Deferred[None]] = []
        """Stops that came while a resume was under way."""
        self._log = Logger("hardware")

    def begin(self) -> None:
        """The robot is stopped since before this start: :meth:`look` throws the switches when they are there."""
        self._owed, self._looks, self._patient = dict.fromkeys(_ALL, ""), 0, True

    def prepare(self) -> None:
        """Find the service before it is needed, and keep what calls it; to be called every second."""
        if self._switches.call and not self._prepared:
            try:
                self._find()
            except Exception:  # a look that fails must not be the last one
                self._log.failure("the graph could not be read")

    def look(self) -> None:
        """Throw again what failed; to be called every second while the robot is stopped, and is not being stopped."""
        if not self._owed or self._again is not None or self._resuming:
            return
        self._looks += 1
        if self._looks > LOOKS and self._looks % RARELY:
            return
        which = frozenset(self._owed)
        if self._patient and self._looks < LOOKS and self._switches.call and not self._prepared:
            which -= {_CALL}  # the program waits for no service
            if not which or not self._switches.stop:
                return
        else:
            self._patient = False
        self._again = Deferred()
        thrown = maybeDeferred(self._stop, which)
        thrown.addErrback(self._unforeseen).addCallback(self._thrown_again)

    def stop(self) -> Deferred[list[str]]:
        """Stop; fires with what went wrong, in words.

        One that is under way counts for all who ask meanwhile. What is under way of a resume may undo it, so then it is
        done once more when that has ended.
        """
        self._looks, self._patient = 0, False
        stopped: Deferred[list[str]] = Deferred()
        self._stopping.append(stopped)
        if len(self._stopping) == 1:
            maybeDeferred(self._stop_surely).addErrback(self._unforeseen).addCallback(self._stopped)
        return stopped

    def _stop_surely(self) -> Deferred[list[str]]:
        thrown = self._stop()
        if not self._resuming:
            return thrown
        over: Deferred[None] = Deferred()
        self._overtaken.append(over)
        last = over.addCallback(lambda _: self._stop())
        return thrown.addCallback(lambda _: last)

    def _stopped(self, problems: list[str]) -> None:
        stopping, self._stopping = self._stopping, []
        for each in stopping:
            each.callback(list(problems))

    def resume(self) -> Deferred[list[str]]:
        """Let go again; fires with what went wrong, in words. One at a time."""
        self._resuming = True
        ready = self._again or succeed(None)
        let_go = ready.addCallback(lambda _: self._let_go())
        let_go.addErrback(lambda failure: {_CALL: self._unforeseen(failure)[0]})
        return let_go.addCallback(self._resumed)

    def _let_go(self) -> Deferred[dict[str, str]]:
        if self._overtaken:  # a stop came while it was waited: what it has thrown must not be undone
            return succeed({})
        self._owed = {}
        return self._throw(False, _ALL)

    def _resumed(self, problems: dict[str, str]) -> list[str]:
        self._resuming = False
        overtaken, self._overtaken = self._overtaken, []
        for each in overtaken:
            each.callback(None)
        return list(problems.values())

    def _stop(self, which: frozenset[str] = _ALL) -> Deferred[list[str]]:
        return self._throw(True, which).addCallback(self._thrown, which)

    def _thrown(self, problems: dict[str, str], which: frozenset[str]) -> list[str]:
        """It stands whatever was thrown meanwhile: only a resume lets go, and that waits for this."""
        self._owed = {name: words for name, words in self._owed.items() if name not in which} | problems
        self.on_owed([words for words in self._owed.values() if words])
        return list(problems.values())

    def _thrown_again(self, problems: list[str]) -> None:
        again, self._again = self._again, None
        if again is not None:
            again.callback(None)

    def _throw(self, stop: bool, which: frozenset[str]) -> Deferred[dict[str, str]]:
        """Throw these; fires with what went wrong, in words, by switch."""
        under_way: dict[str, Deferred[None]] = {}
        if self._switches.call and _CALL in which:
            under_way[_CALL] = maybeDeferred(self._call, self._switches.call, stop)
        command = self._switches.stop if stop else self._switches.resume
        if command and _PROGRAM in which:
            under_way[_PROGRAM] = maybeDeferred(run, self._reactor, command)
        gathered: Deferred[Any] = DeferredList(list(under_way.values()), consumeErrors=True)
        return gathered.addCallback(
            lambda ends: {
                name: self._words(end) for name, (good, end) in zip(under_way, ends, strict=True) if not good
            }
        )

    def _find(self) -> None:
        """Look for the service in the graph; where it is, have its client kept."""
        call = self._switches.call
        known = self._platform.graph().services.get(self._platform.full_name(call, "service"))
        if known is None:
            return
        self._types = known.types
        type = self._type
        if type and type != self._prepared:
            self._prepared = type
            self._platform.prepare_call(call, type)

    @property
    def _type(self) -> str:
        """The type the service is called by; empty: it is not there, or of none that is known."""
        return next((each for each in (SET_BOOL, TRIGGER) if each in self._types), "")

    def _call(self, service: str, stop: bool) -> Deferred[None]:
        try:
            self._find()
        except Exception:  # it may still be as it was found
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
        answer = self._platform.call(service, type, request, PATIENCE)
        answer.addTimeout(PATIENCE, self._reactor, onTimeoutCancel=lambda *_: _late(service))
        return answer.addCallback(lambda body: _check(service, body))

    def _words(self, failure: Failure) -> str:
        if isinstance(failure.value, SwitchboardError):
            return failure.getErrorMessage()
        return self._unforeseen(failure)[0]

    def _unforeseen(self, failure: Failure) -> list[str]:
        self._log.failure("a switch in the hardware failed", failure)
        return ["a switch in the hardware failed; the robot's log says why"]


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
