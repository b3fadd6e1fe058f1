"""A port or function of a program, at an end of a pipe.

A value that is no object is carried as the field ``data``.
"""

from __future__ import annotations

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, MalformedMessage, NotFound, Unavailable
from relay_server.icpi.programs import RELAY, Program, ProgramRegistry, function_of, port_of
from relay_server.in_process_sessions.in_process_port import ServiceReply
from relay_server.pipes.schemas import PipeEnd
from relay_server.pipes.service_caller import CALL_SECONDS, PipeCall

MAX_VALUE = 8 * 1024
"""Bytes of the arguments of one call."""

ANY_TYPE = "JSON"
"""Stands for the type of a program's values. They are checked one by one."""


class ProgramEnd:
    """
    :param owner_id: the user of the program
    :param gets: whether a port is asked for its value, not set
    """

    def __init__(self, programs: ProgramRegistry, owner_id: int, end: PipeEnd, *, gets: bool) -> None:
        self._programs = programs
        self._owner_id = owner_id
        self._end = end
        self._gets = gets

    def __str__(self) -> str:
        return f"program {self._end.program}"

    def find(self) -> Program | None:
        """The program, while it is connected.

        :raises NotFound: it has no such port or function
        """
        try:
            program = self._programs.find(self._owner_id, self._end.program)
        except NotFound:
            return None
        if self._end.port:
            port_of(program, self._end.port)
        else:
            function_of(program, self._end.function)
        return program

    async def request(self, call: PipeCall) -> ServiceReply:
        """Get or set the port, or call the function.

        :raises SwitchboardError: the program is away, refuses or does not answer; the value is too large
        """
        program = self.find()
        if program is None:
            raise Unavailable(f"{self} has disconnected")
        function, args = self._message(call.args)
        size = sum(len(each.encode()) for each in args)
        if size > MAX_VALUE:
            raise Invalid(f"{self} takes values of {MAX_VALUE} bytes at most, not {size}; carry fields")
        answer = await program.request(function, args, RELAY, CALL_SECONDS)
        return ServiceReply(True, message_of(answer))

    def _message(self, body: bytes) -> tuple[str, list[str]]:
        """The function of the program that is called, and its arguments."""
        if not self._end.port:
            return self._end.function, [_text(each) for each in jsontext.decode_any(body).values()]
        if self._gets:
            return "get", [self._end.port]
        message = jsontext.decode_any(body)
        value = message["data"] if list(message) == ["data"] else message
        return "set", [self._end.port, jsontext.encode(value).decode()]


def message_of(value: str) -> bytes:
    """The JSON object that a program's value is carried as.

    :param value: JSON, or a text
    """
    try:
        decoded = jsontext.decode_any(value.encode())
    except MalformedMessage:
        decoded = value
    return jsontext.encode(decoded if isinstance(decoded, dict) else {"data": decoded})


def _text(value: object) -> str:
    return value if isinstance(value, str) else jsontext.encode(value).decode()
