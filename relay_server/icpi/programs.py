"""Programs that are connected by ICPI: their ports and functions, and requests to them.

A program is reached by its own user alone. It is there while its websocket is open.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from typing import NamedTuple, Protocol

from relay_protocol.errors import Invalid, NotFound, Refused

MAX_PROGRAMS = 32
"""Of one user."""

MAX_NAMES = 256
"""Ports, and functions, of one program."""

REPLY = "reply"
"""The function of messages that answer others. No program has it."""

RELAY = "relay"
"""The receiver of requests to the relay, and the sender of its own. No program has this name."""

_NAME = re.compile(r"[A-Za-z]\w{0,63}\Z")


class Program(NamedTuple):
    """A registered program.

    :param request: calls a function of it: name, arguments, name of the sender, seconds; the values of its reply
    :param notify: sends it a message without a reply: function, arguments, name of the sender
    """

    name: str
    ports: frozenset[str]
    functions: frozenset[str]
    request: ProgramRequest
    notify: Callable[[str, Iterable[str], str], None]


class ProgramRequest(Protocol):
    """Calls a function of a program."""

    async def __call__(self, function: str, args: Iterable[str], sender: str, seconds: float) -> str:
        """The value of its reply.

        :raises NotDone: it refused, with its reason
        :raises Unavailable: it did not answer, or has disconnected
        """


class PublishedValue(NamedTuple):
    """A value that a program publishes at a port.

    :param user: of the program
    :param value: JSON, or a text
    :param earliest_sent: see :class:`relay_server.sessions.message_age.MessageAge`
    """

    user: int
    program: str
    port: str
    value: str
    earliest_sent: int


class ProgramRegistry:
    """Programs by their user.

    :ivar on_value: is called with each published value; how many pipes have carried it
    """

    def __init__(self) -> None:
        self.on_value: Callable[[PublishedValue], int] = lambda value: 0
        self._programs: dict[int, dict[str, Program]] = {}

    def register(self, user: int, program: Program) -> Callable[[], None]:
        """Add a program; returns a function that removes it.

        :raises Invalid: a name can't be used
        :raises Refused: the user has a program of this name, or too many
        """
        for name in (program.name, *program.ports, *program.functions):
            if not _NAME.match(name) or name in (RELAY, REPLY):
                raise Invalid(f"'{name[:40]}' is no name: it must have letters, digits and '_'")
        if max(len(program.ports), len(program.functions)) > MAX_NAMES:
            raise Invalid(f"a program has {MAX_NAMES} ports and {MAX_NAMES} functions at most")
        mine = self._programs.setdefault(user, {})
        if program.name in mine:
            raise Refused(f"a program '{program.name}' of yours is connected already; choose another name")
        if len(mine) >= MAX_PROGRAMS:
            raise Refused(f"you have {MAX_PROGRAMS} programs, the most one user may have")
        mine[program.name] = program

        def remove() -> None:
            if mine.get(program.name) is program:
                del mine[program.name]
            if not mine and self._programs.get(user) is mine:
                del self._programs[user]

        return remove

    def of(self, user: int) -> list[Program]:
        """The programs of a user, by name."""
        return sorted(self._programs.get(user, {}).values(), key=lambda each: each.name)

    def find(self, user: int, name: str) -> Program:
        """A program of a user.

        :raises NotFound: there is none of this name
        """
        program = self._programs.get(user, {}).get(name)
        if program is None:
            raise NotFound(f"there is no program '{name[:64]}' of yours; it must connect and register")
        return program


def port_of(program: Program, port: str) -> str:
    """:raises NotFound: the program has no such port"""
    if port not in program.ports:
        raise NotFound(f"program {program.name} has no port '{port[:64]}'; it has {_listed(program.ports)}")
    return port


def function_of(program: Program, function: str) -> str:
    """:raises NotFound: the program has no such function"""
    if function not in program.functions:
        known = _listed(program.functions)
        raise NotFound(f"program {program.name} has no function '{function[:64]}'; it has {known}")
    return function


def _listed(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)) or "none"
