"""Limits of ICPI programs."""

from __future__ import annotations

from typing import Any, cast

import pytest
from twisted.internet.defer import Deferred
from twisted.internet.task import Clock

from relay_server.access import Principal
from relay_server.icpi.messages import IcpiMessage, parse, write
from relay_server.icpi.programs import ProgramRegistry
from relay_server.icpi.session import IcpiServices, IcpiSession
from relay_server.roles.commands import RoleUser, arguments_of
from relay_server.roles.schemas import ElementDone, NewElementValue

REQUEST = write(IcpiMessage("relay", "test", "1", True, "programs")).encode()


class Transport:
    """Keeps the results of replies."""

    def __init__(self) -> None:
        self.results: list[tuple[str, ...]] = []

    def send(self, data: bytes) -> None:
        text = data[data.index(b"test" if b"test!" in data else b"program!") :].decode()
        self.results.append(parse(text).args)


def principal(user: int) -> Principal:
    return Principal(user, f"user{user}", "lab", False, user, None)


class Commands:
    """Keeps the values that are set."""

    def __init__(self) -> None:
        self.values: list[Any] = []

    async def set(self, user: RoleUser, role: str, element: str, new: NewElementValue) -> ElementDone:
        self.values.append(new.value)
        return ElementDone(role, element, "set", "robots/rover/topics/cmd_vel")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("0.5", 0.5),
        ("on", "on"),
        ("{no JSON", "{no JSON"),
        ('["NaN", 1]', ["NaN", 1]),
        ('{"x": NaN, "y": [-Infinity]}', {"x": "\0NaN", "y": ["\0-Infinity"]}),
    ],
)
def test_a_value_is_json_or_a_text(text: str, value: Any) -> None:
    """NaN and infinity are marked for the encoders of messages."""
    commands = Commands()
    assert _set(commands, text) == ("ok", "robots/rover/topics/cmd_vel")
    assert commands.values == [value]


def test_a_program_gets_strict_json() -> None:
    """NaN and infinity become null, as in all JSON of the relay."""
    assert arguments_of(["\0NaN", "NaN", {"x": ["\0Infinity", 1]}]) == ["null", "NaN", '{"x":[null,1]}']


def test_a_value_with_a_key_twice_is_refused() -> None:
    commands = Commands()
    result, reason = _set(commands, '{"x": 1, "x": 2}')
    assert result == "error" and "the key 'x' twice" in reason
    assert commands.values == []


def _set(commands: Commands, text: str) -> tuple[str, ...]:
    """The result of setting an element of a Role."""

    async def authenticate(token: str) -> Principal:
        return principal(1)

    clock: Any = Clock()
    unused = cast(Any, None)
    services = IcpiServices(clock, ProgramRegistry(), cast(Any, commands), unused, authenticate, lambda: 0)
    transport = Transport()
    session = IcpiSession(services, cast(Any, transport), principal(1), "1", "here", lambda _: None)
    session.message(write(IcpiMessage("Role", "test", "1", True, "set", ("SPEED", text))).encode())
    return transport.results[0]


def test_programs_of_a_user_share_the_limit_of_messages() -> None:
    async def authenticate(token: str) -> Principal:
        return principal(int(token))

    clock: Any = Clock()
    unused = cast(Any, None)
    services = IcpiServices(clock, ProgramRegistry(), unused, unused, authenticate, lambda: 0)

    def program(user: int) -> tuple[IcpiSession, Transport]:
        transport = Transport()
        made = IcpiSession(services, cast(Any, transport), principal(user), str(user), "here", lambda _: None)
        return made, transport

    (first, _), (second, seen), (other, others) = program(1), program(1), program(2)
    for _ in range(200):
        first.message(REQUEST)
    second.message(REQUEST)
    other.message(REQUEST)
    assert "your programs send more than 50 messages a second" in seen.results[0][1]
    assert others.results == [("ok", "[]")]
    clock.advance(0.02)
    second.message(REQUEST)
    assert seen.results[1] == ("ok", "[]")


def test_a_stop_gets_through_beside_a_flood_and_slow_requests() -> None:
    waiting: list[Deferred[Principal]] = []

    async def authenticate(token: str) -> Principal:
        held: Deferred[Principal] = Deferred()
        waiting.append(held)
        return await held

    clock: Any = Clock()
    unused = cast(Any, None)
    services = IcpiServices(clock, ProgramRegistry(), unused, unused, authenticate, lambda: 0)
    transport = Transport()
    session = IcpiSession(services, cast(Any, transport), principal(1), "1", "here", lambda _: None)
    for _ in range(240):
        session.message(REQUEST)
    assert len(waiting) == 32
    session.message(write(IcpiMessage("Role", "test", "s", True, "stop")).encode())
    assert len(waiting) == 33


def test_a_program_that_has_left_is_not_registered() -> None:
    waiting: list[Deferred[Principal]] = []

    async def authenticate(token: str) -> Principal:
        held: Deferred[Principal] = Deferred()
        waiting.append(held)
        return await held

    clock: Any = Clock()
    unused = cast(Any, None)
    programs = ProgramRegistry()
    services = IcpiServices(clock, programs, unused, unused, authenticate, lambda: 0)
    session = IcpiSession(services, cast(Any, Transport()), principal(1), "1", "here", lambda _: None)
    session.message(write(IcpiMessage("relay", "", "1", True, "register", ("lamp", "[]", "[]"))).encode())
    session.end()
    waiting[0].callback(principal(1))
    assert programs.of(1) == []


def test_a_program_that_commands_is_pinged_so_that_its_next_command_is_not_too_old() -> None:
    async def authenticate(token: str) -> Principal:
        return principal(1)

    class Pinged(Transport):
        pings = 0

        def ping(self, payload: bytes) -> None:
            self.pings += 1

    clock: Any = Clock()
    unused = cast(Any, None)
    counts = []
    for commands in (False, True):
        services = IcpiServices(
            clock, ProgramRegistry(), cast(Any, Commands()), unused, authenticate, lambda: 0
        )
        transport = Pinged()
        session = IcpiSession(services, cast(Any, transport), principal(1), "1", "here", lambda _: None)
        session.start()
        if commands:
            session.message(write(IcpiMessage("Role", "test", "1", True, "set", ("SPEED", "1"))).encode())
        for _ in range(60):
            clock.advance(0.2)
            session.pong(next(reversed(session._pings), b""))
        counts.append(transport.pings)
        session.end()
    assert counts[0] <= 3
    assert counts[1] >= 58
