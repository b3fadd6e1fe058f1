"""The types of one definition text with their readers and writers, created on first use."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, cast

import cbor2
import msgspec
import orjson

from relay_protocol import json_cost, jsontext, nonfinite
from relay_protocol.errors import Invalid, MalformedMessage
from relay_protocol.ros import generated_cdr_to_json, generated_json_to_cdr
from relay_protocol.ros.cdr_to_json import HEADER_BYTES, ReaderFactory
from relay_protocol.ros.definition import HEADER, Definition, Shape, parse
from relay_protocol.ros.generated_json_to_cdr import LARGEST_BODY, Check
from relay_protocol.ros.json_to_cdr import Mismatch, WriterFactory, as_invalid

Reader = Callable[[bytes], bytes]
"""Takes CDR with its header; returns JSON or CBOR. Raises :class:`Invalid`."""


class Writer(Protocol):
    """Converts JSON to CDR."""

    def __call__(self, body: Any, now_ns: int = 0, /) -> bytes:
        """Convert one message.

        :param body: JSON text, or the decoded value
        :param now_ns: the current time, ns since 1970, for stamps that are left out
        :returns: with its header
        :raises Invalid: it is not of the type
        """


_ORDERS = {b"\x00\x01": "<", b"\x00\x00": ">"}
"""Byte order of the numbers by the first two bytes of a message."""

_ENCAPSULATION_HEADER = b"\x00\x01\x00\x00"


def _json(value: Any) -> bytes:
    return orjson.dumps(value, option=orjson.OPT_SERIALIZE_NUMPY)


_ENCODERS: dict[str, Callable[[Any], bytes]] = {"json": _json, "cbor": cbor2.dumps}
_ANY: msgspec.json.Decoder[Any] = msgspec.json.Decoder()


class CompiledTypes:
    """The types of one text. Each conversion has generated code for usual messages and a slow path for all others.

    :raises Invalid: see :func:`relay_protocol.ros.definition.parse`
    """

    def __init__(self, type_name: str, text: str) -> None:
        self.type_name = type_name
        self.text = text
        self.definitions: dict[str, Definition] = parse(type_name, text)
        self._slow_writers = WriterFactory(self.definitions)
        self._slow_readers: dict[tuple[str, str], ReaderFactory] = {}
        self._readers: dict[tuple[str, str], Reader] = {}
        self._writers: dict[str, tuple[Writer, Writer]] = {}
        self._checks: dict[tuple[str, bool], Check] = {}

    def reader(self, name: str, form: str) -> Reader:
        """The reader of a message type for ``json`` or ``cbor``."""
        found = self._readers.get((name, form))
        if found is None:
            slow = self._slow_reader(name, form)
            found = generated_cdr_to_json.generate(name, self.definitions, form, slow)
            self._readers[name, form] = found
        return found

    def _slow_reader(self, name: str, form: str) -> Reader:
        encode = _ENCODERS[form]

        def read(cdr: bytes) -> bytes:
            if len(cdr) < HEADER_BYTES:
                raise Invalid(f"{name}: {len(cdr)} bytes are too few for a CDR message")
            try:
                return encode(self._factory(cdr[:2], form).read(name, cdr))
            except Invalid as error:
                raise Invalid(f"{name}: {error}") from None

        return read

    def _factory(self, encapsulation: bytes, form: str) -> ReaderFactory:
        order = _ORDERS.get(encapsulation)
        if order is None:
            raise Invalid(f"bytes 0 and 1 are {encapsulation.hex()}; plain CDR has 0001 or 0000")
        found = self._slow_readers.get((order, form))
        if found is None:
            found = self._slow_readers[order, form] = ReaderFactory(self.definitions, order, form == "cbor")
        return found

    def writer(self, name: str, checked: bool) -> Writer:
        """The writer of a message type; ``checked`` text is not checked again."""
        found = self._writers.get(name)
        if found is None:
            made = generated_json_to_cdr.generate(name, self.definitions)
            strict, trusting = self._slow_writer(name, jsontext.decode_any), self._slow_writer(name, _decode)
            found = self._writers[name] = (cast(Writer, made(strict)), cast(Writer, made(trusting)))
        return found[checked]

    def command_writer(self, name: str) -> Writer:
        """The writer of a message type for commands, as checked text: their numbers are finite.

        Generated code takes no other numbers, but in lists.
        """
        if _has_lists_of_floats(name, self.definitions):
            return _finite(self.writer(name, checked=True))
        made = generated_json_to_cdr.generate(name, self.definitions)
        return cast(Writer, made(_finite(self._slow_writer(name, _decode))))

    def check(self, name: str, commands: bool) -> Check:
        """The check of a text for robots that speak JSON; it takes what :meth:`writer` takes; returns what they get.

        A short text of a type without lists is encoded again, with all fields of the type. Others stay as they are.

        :param commands: whether it takes what :meth:`command_writer` takes
        """
        found = self._checks.get((name, commands))
        if found is None:
            write = self.writer(name, checked=True)

            def check_by_writing(body: bytes) -> bytes:
                write(body)
                if commands:
                    nonfinite.require_finite(body)
                return json_for_robot(body)

            made = generated_json_to_cdr.generate_check(name, self.definitions)
            found = self._checks[name, commands] = made(check_by_writing) if made else check_by_writing
        return found

    def is_stamped(self, name: str) -> bool:
        """Whether :meth:`writer` may need the present time: the type is a header, or has one somewhere."""
        return HEADER in _contained(name, self.definitions)

    def _slow_writer(self, name: str, decode: Callable[[bytes], Any]) -> Writer:
        def write(body: Any, now_ns: int = 0, /) -> bytes:
            if type(body) is bytes:
                json_cost.check_odd(body)
            try:
                value = decode(body) if type(body) is bytes else body
            except MalformedMessage as error:
                raise Invalid(f"{name}: {error}") from None
            out = bytearray()
            try:
                self._slow_writers.writer(name)(out, value, now_ns)
            except Mismatch as error:
                raise as_invalid(name, error) from None
            if len(out) > LARGEST_BODY:
                raise Invalid(
                    f"{name}: the message has {len(out)} bytes; a robot takes at most {LARGEST_BODY}"
                )
            return _ENCAPSULATION_HEADER + out

        return write


def json_for_robot(body: bytes) -> bytes:
    """A text that was checked but for its keys, as robots that speak JSON get it: unchanged.

    :raises Invalid: it is too large
    :raises MalformedMessage: it has a key twice, which the robot could read in another way
    """
    jsontext.check_keys(body)
    body = nonfinite.marks_to_null(body)
    if len(body) > LARGEST_BODY:
        raise Invalid(f"the message has {len(body)} bytes as JSON; a robot takes at most {LARGEST_BODY}")
    return body


def _finite(write: Writer) -> Writer:
    """A writer of commands, which refuses numbers that are not finite."""

    def write_command(body: bytes, now_ns: int = 0, /) -> bytes:
        written = write(body, now_ns)
        nonfinite.require_finite(body)
        return written

    return write_command


def _has_lists_of_floats(name: str, definitions: dict[str, Definition]) -> bool:
    """Whether a type has lists of floating-point numbers, in which ``null`` is NaN."""
    return any(
        field.type.shape is not Shape.SCALAR
        and field.type.primitive is not None
        and type(field.type.primitive.zero) is float
        for each in _contained(name, definitions)
        for field in definitions[each].fields
    )


def _contained(name: str, definitions: dict[str, Definition]) -> set[str]:
    """Names of a type and all types in it."""
    found: set[str] = set()
    left = [name]
    while left:
        name = left.pop()
        if name in definitions and name not in found:
            found.add(name)
            left += [field.type.base for field in definitions[name].fields]
    return found


def _decode(text: bytes) -> Any:
    try:
        return _ANY.decode(text)
    except jsontext.FAULTS as error:
        raise jsontext.malformed(error, Any) from None
