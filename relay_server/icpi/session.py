"""The websocket of one ICPI program (SPEC 1.21)."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Coroutine, Iterable
from typing import Any

import msgspec
from twisted.internet.defer import Deferred
from twisted.logger import Logger

from relay_protocol import jsontext, nonfinite
from relay_protocol.errors import Invalid, MalformedMessage, SwitchboardError, Unavailable
from relay_server.access import Principal
from relay_server.common import close_codes, websocket_frames
from relay_server.common.clock import Clock, PeriodicTimer, PeriodicTimers
from relay_server.common.concurrency import with_timeout
from relay_server.common.errors import NotDone
from relay_server.common.freshness_tokens import FreshnessTokenExpired
from relay_server.common.send_queue import SendQueue
from relay_server.common.token_bucket import Buckets
from relay_server.icpi.messages import IcpiMessage, id_of, parse, write
from relay_server.icpi.programs import (
    RELAY,
    REPLY,
    Program,
    ProgramRegistry,
    PublishedValue,
    function_of,
    port_of,
)
from relay_server.roles.commands import RoleCommands, RoleUser
from relay_server.roles.runs import RoleRuns
from relay_server.roles.schemas import ElementCall, NewElementValue
from relay_server.sessions.ports import ClientTransport

MESSAGES_PER_SECOND = 50.0
MESSAGES_BURST = 200.0
"""Of all programs of one user."""

MAX_USERS = 10_000
"""Users whose messages are counted."""

MAX_ERRORS = 50
"""Messages that can't be read, or come too fast, before the connection is closed."""

MAX_RUNNING = 32
"""Requests of one program that are in progress, and requests to it."""

STOPS_RUNNING = 8
"""More that stop something."""

REPLY_SECONDS = 10.0
"""Time limit of a program's reply."""

PING_SECONDS = 0.2
QUIET_PINGS = 25
"""A program that has sent nothing recently gets one ping in so many."""

COMMANDING_SECONDS = 600.0
"""A program that has given a Role a command gets all pings for so long, so that the next one is not too old at once."""

SILENT_SECONDS = 20.0
"""A program that has not answered a ping for this time is disconnected."""


class IcpiServices:
    """Services that ICPI programs use.

    :param authenticate: the principal of a token, now
    :param clock_ns: monotonic nanoseconds
    """

    def __init__(
        self,
        clock: Clock,
        programs: ProgramRegistry,
        commands: RoleCommands,
        runs: RoleRuns,
        authenticate: Callable[[str], Coroutine[Any, Any, Principal]],
        clock_ns: Callable[[], int],
    ) -> None:
        self.clock = clock
        self.programs = programs
        self.commands = commands
        self.runs = runs
        self.authenticate = authenticate
        self.clock_ns = clock_ns
        self.timers = PeriodicTimers(clock)
        self.messages = Buckets(MESSAGES_PER_SECOND, MESSAGES_BURST, MAX_USERS, clock.seconds)
        self.stops = Buckets(MESSAGES_PER_SECOND, MESSAGES_BURST, MAX_USERS, clock.seconds)
        """Requests to stop are counted apart, so that other messages keep none from being carried out."""


class IcpiSession:
    """One program. It is a :class:`relay_server.ws.handshake.WebSocketHandler`.

    :param token: its access token, which is checked again with each message
    :param ended: called when the websocket is closed
    """

    log = Logger()

    def __init__(
        self,
        services: IcpiServices,
        transport: ClientTransport,
        principal: Principal,
        token: str,
        address: str,
        ended: Callable[[IcpiSession], None],
    ) -> None:
        self.send_queue = SendQueue(transport.send, services.clock.seconds, self._cut)
        self.earliest_sent = 0
        self._services = services
        self._transport = transport
        self._user = principal.user_id
        self._token = token
        self._address = address
        self._ended = ended
        self._name = ""
        self._unregister: Callable[[], None] | None = None
        self._errors = 0
        self._running = 0
        self._asked = 0
        """Requests to this program; their ids are numbers from 1."""
        self._waiting: dict[str, Deferred[str]] = {}
        """Those that are not answered yet, by id."""
        self._pinging = PeriodicTimer(self._tick, PING_SECONDS)
        self._ticks = 0
        self._active = False
        self._commanding_until = 0.0
        self._pings: dict[bytes, int] = {}
        self._last_pong = services.clock.seconds()
        self._closed = False

    # --- WebSocketHandler ---------------------------------------------------------------------------------

    def start(self) -> None:
        """The websocket is open."""
        self._services.timers.start(self._pinging)

    def message(self, payload: bytes, *, earliest_sent: int | None = None) -> None:
        """Carry out one message, and answer it."""
        if self._closed:
            return
        self._active = True
        sent = self.earliest_sent if earliest_sent is None else earliest_sent
        text = payload.decode()
        try:
            message = parse(text)
            is_reply = message.function == REPLY
            # A reply that is waited for does not count: the relay has asked for it.
            is_stop = message.function == "stop"
            if not (is_reply and message.id in self._waiting):
                self._count(self._services.stops if is_stop else self._services.messages)
        except SwitchboardError as error:
            self._refuse(id_of(text), error)
            return
        if is_reply:
            self._replied(message)
            return
        if self._running >= MAX_RUNNING + (STOPS_RUNNING if is_stop else 0):
            self._reply(message, "error", f"{MAX_RUNNING} requests of yours are in progress; wait for one")
            return
        self._running += 1
        work = Deferred.fromCoroutine(self._answer(message, sent))
        work.addErrback(lambda failure: self.log.failure("a message of a program failed", failure))

    def ping(self) -> None:
        """Send a ping now. Its answer dates the messages that come after it."""
        # Unguessable, so that a pong can't be sent in advance.
        payload = secrets.token_bytes(8)
        self._pings[payload] = self._services.clock_ns()
        while len(self._pings) > 64:
            del self._pings[next(iter(self._pings))]
        self._transport.ping(payload)

    def pong(self, payload: bytes) -> None:
        """Messages that come from now on were sent after that ping."""
        sent = self._pings.pop(payload, None)
        if sent is not None:
            self.earliest_sent = max(self.earliest_sent, sent)
            self._last_pong = self._services.clock.seconds()

    def pause(self) -> None:
        """The transport's buffer is full."""
        self.send_queue.pause()

    def resume(self) -> None:
        """The transport takes bytes again."""
        self.send_queue.resume()

    def close(self, code: int, reason: str) -> None:
        """Close the websocket."""
        self._transport.close(code, reason)
        self.end()

    def end(self, *, orderly: bool = False) -> None:
        """The websocket is closed or closing: requests to the program fail."""
        if self._closed:
            return
        self._closed = True
        self._pinging.stop()
        self.send_queue.close()
        if self._unregister is not None:
            self._unregister()
        waiting, self._waiting = self._waiting, {}
        for each in waiting.values():
            each.errback(Unavailable(f"program {self._name} has disconnected"))
        self._ended(self)

    def _count(self, messages: Buckets) -> None:
        """:raises Unavailable: the user's programs send too much"""
        if not messages.take(self._user):
            raise Unavailable(
                f"your programs send more than {MESSAGES_PER_SECOND:g} messages a second; this one was dropped"
            )

    # --- requests of the program --------------------------------------------------------------------------

    async def _answer(self, message: IcpiMessage, sent: int) -> None:
        try:
            principal = await self._services.authenticate(self._token)
            principal.require_full_scope()
            if self._closed:
                raise Unavailable("the program has disconnected")
            value = await self._carry_out(message, RoleUser(principal, self._address, sent))
            if message.acknowledge:
                self._reply(message, "ok", value)
        except FreshnessTokenExpired:
            self._reply(message, "error", "the command may have been sent too long ago; send it again")
        except SwitchboardError as error:
            self._reply(message, "error", str(error))
        finally:
            self._running -= 1

    async def _carry_out(self, message: IcpiMessage, user: RoleUser) -> str:
        programs = self._services.programs
        if message.broadcast:
            receivers = [each for each in programs.of(self._user) if each.name != self._name]
            for each in receivers:
                each.notify(message.function, message.args, self._sender)
            return str(len(receivers))
        if message.dest == RELAY:
            return self._for_relay(message, user)
        if any(each.name == message.dest for each in programs.of(self._user)):
            program = programs.find(self._user, message.dest)
            if message.function in ("get", "set"):
                port_of(program, _argument(message, 0))
            else:
                function_of(program, message.function)
            return await program.request(message.function, message.args, self._sender, REPLY_SECONDS)
        return await self._for_role(message, user)

    def _for_relay(self, message: IcpiMessage, user: RoleUser) -> str:
        if message.function == "programs":
            found = [
                {"name": each.name, "ports": sorted(each.ports), "functions": sorted(each.functions)}
                for each in self._services.programs.of(self._user)
            ]
            return jsontext.encode(found).decode()
        if message.function == "publish":
            return str(self._services.programs.on_value(self._published(message, user.earliest_sent or 0)))
        if message.function != "register":
            raise Invalid(
                f"the relay has no function '{message.function}'; it has register, programs and publish"
            )
        if self._unregister is not None:
            raise Invalid(f"this program is registered already, as {self._name}")
        name = _argument(message, 0)
        ports, functions = (_names(message, position) for position in (1, 2))
        program = Program(name, ports, functions, self._request, self._notify)
        self._unregister = self._services.programs.register(self._user, program)
        self._name = name
        return name

    def _published(self, message: IcpiMessage, earliest_sent: int) -> PublishedValue:
        """:raises Invalid: the program is not registered, or an argument is missing
        :raises NotFound: it has no such port
        """
        if self._unregister is None:
            raise Invalid("only a registered program publishes; call 'register' first")
        port = port_of(self._services.programs.find(self._user, self._name), _argument(message, 0))
        return PublishedValue(self._user, self._name, port, _argument(message, 1), earliest_sent)

    async def _for_role(self, message: IcpiMessage, user: RoleUser) -> str:
        """A command on an element of a Role, or on a whole Role."""
        commands, role, do = self._services.commands, message.dest, message.function
        if do in ("set", "call", "start"):
            self._commanding_until = self._services.clock.seconds() + COMMANDING_SECONDS
        if do in ("start", "stop") and not message.args:
            order = self._services.runs.start if do == "start" else self._services.runs.stop
            return (await order(user, role)).state
        element = _argument(message, 0)
        if do == "get":
            return jsontext.encode((await commands.get(user, role, element)).value).decode()
        if do == "set":
            new = NewElementValue(_value(_argument(message, 1)))
            return (await commands.set(user, role, element, new)).resource
        if do == "call":
            args = _value(message.args[1]) if len(message.args) > 1 else {}
            done = await commands.call(user, role, element, ElementCall(args))
            return jsontext.encode(done.values).decode()
        if do in ("start", "stop"):
            return (await commands.switch(user, role, element, "start" if do == "start" else "stop")).state
        raise Invalid(f"a Role has no function '{do}'; it has get, set, call, start and stop")

    # --- requests to the program --------------------------------------------------------------------------

    async def _request(self, function: str, args: Iterable[str], sender: str, seconds: float) -> str:
        if self._closed:
            raise Unavailable(f"program {self._name} has disconnected")
        if len(self._waiting) >= MAX_RUNNING:
            raise Unavailable(f"program {self._name} has {MAX_RUNNING} requests to answer; try again")
        self._asked += 1
        number = str(self._asked)
        waiting: Deferred[str] = Deferred()
        self._waiting[number] = waiting
        self._send(IcpiMessage(self._name, sender, number, True, function, tuple(args)))
        try:
            late = f"program {self._name} did not reply within {seconds:g} s"
            return await with_timeout(self._services.clock, seconds, waiting, late)
        finally:
            self._waiting.pop(number, None)

    def _notify(self, function: str, args: Iterable[str], sender: str) -> None:
        self._send(IcpiMessage(self._name, sender, "", False, function, tuple(args), True))

    def _replied(self, message: IcpiMessage) -> None:
        waiting = self._waiting.pop(message.id, None)
        if waiting is None and self._was_asked(message.id):
            # It comes too late; who asked has an error already.
            return
        if waiting is None or len(message.args) != 2 or message.args[0] not in ("ok", "error"):
            if waiting is not None:
                waiting.errback(NotDone(f"program {self._name} gave a reply that can't be read"))
            self._refuse(
                message.id, Invalid("this replies to no request: write (0)ok|error(1)value and its id")
            )
        elif message.args[0] == "ok":
            waiting.callback(message.args[1])
        else:
            waiting.errback(NotDone(f"{self._name}: {message.args[1][:500]}"))

    @property
    def _sender(self) -> str:
        """What others reply to."""
        return self._name or "program"

    def _was_asked(self, id: str) -> bool:
        return id.isascii() and id.isdigit() and 1 <= int(id) <= self._asked

    # --- sending ------------------------------------------------------------------------------------------

    def _reply(self, request: IcpiMessage, result: str, value: str) -> None:
        """The request's form, with sender and receiver exchanged."""
        receiver, sender = request.sender or self._sender, request.dest or RELAY
        self._send(IcpiMessage(receiver, sender, request.id, False, REPLY, (result, value)))

    def _refuse(self, id: str, error: SwitchboardError) -> None:
        self._errors += 1
        if self._errors > MAX_ERRORS:
            self.close(close_codes.TOO_MANY_ERRORS, f"{MAX_ERRORS} errors; the last one: {error}"[:120])
        else:
            self._reply(IcpiMessage(RELAY, "", id, False, REPLY), "error", str(error))

    def _send(self, message: IcpiMessage) -> None:
        if not self._closed:
            self.send_queue.send_reliable(websocket_frames.text(write(message).encode()))

    def _cut(self) -> None:
        self.close(close_codes.TOO_SLOW, "the program does not read")

    def _tick(self) -> None:
        self._ticks += 1
        if self._services.clock.seconds() - self._last_pong > SILENT_SECONDS:
            self.close(close_codes.TOO_SLOW, f"no answer to pings for {SILENT_SECONDS:g} s")
        elif (
            self._active
            or self._ticks % QUIET_PINGS == 0
            or self._services.clock.seconds() < self._commanding_until
        ):
            self.ping()
            if self._ticks % QUIET_PINGS == 0:
                self._active = False
                self._prove()

    def _prove(self) -> None:
        """Close when the token has ended."""

        def over(failure: Any) -> None:
            failure.trap(SwitchboardError)
            if not isinstance(failure.value, Unavailable):
                self.close(close_codes.UNAUTHENTICATED, str(failure.value))

        Deferred.fromCoroutine(self._services.authenticate(self._token)).addErrback(over)


def _argument(message: IcpiMessage, position: int) -> str:
    """:raises Invalid: it is missing"""
    if len(message.args) <= position:
        raise Invalid(f"'{message.function}' needs argument ({position})")
    return message.args[position]


def _names(message: IcpiMessage, position: int) -> frozenset[str]:
    """Names in a list, JSON.

    :raises Invalid: it is none
    """
    text = message.args[position] if len(message.args) > position else "[]"
    try:
        names: list[str] = jsontext.decode(_NAMES, text.encode())
        return frozenset(names)
    except MalformedMessage as error:
        raise Invalid(f"argument ({position}) of register is no list of names in JSON: {error}") from None


_NAMES: msgspec.json.Decoder[list[str]] = msgspec.json.Decoder(list[str])


def _value(text: str) -> Any:
    """JSON, or a text. NaN and infinity are marked, see :mod:`relay_protocol.nonfinite`.

    :raises MalformedMessage: it is JSON that has a key twice
    """
    data = text.encode()
    try:
        data = nonfinite.mark_body(data)
        msgspec.json.decode(data)
    except (SwitchboardError, *jsontext.FAULTS):
        return text
    return jsontext.decode_any(data)
