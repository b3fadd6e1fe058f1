"""All types of one text with what converts their messages, built when first needed and then kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cbor2
import msgspec
import orjson

from relay_protocol import json_cost, jsontext
from relay_protocol.errors import Invalid, MalformedMessage
from relay_protocol.ros import fast_reader, fast_writer
from relay_protocol.ros.definition import Definition, parse
from relay_protocol.ros.fast_writer import LARGEST_BODY
from relay_protocol.ros.reader import HEAD, ReaderFactory
from relay_protocol.ros.writer import Mismatch, WriterFactory, as_invalid

Reader = Callable[[bytes], bytes]
"""Takes CDR with its header; gives the message in JSON or CBOR. Raises :class:`Invalid`."""

Writer = Callable[[Any, int], bytes]
"""Takes JSON (text as bytes, or decoded) and the present time (ns since 1970); gives CDR with its header.
Raises :class:`Invalid`."""

_ORDERS = {b"\x00\x01": "<", b"\x00\x00": ">"}
"""Byte order of the numbers by the first two bytes of a message."""

_WRITTEN_HEAD = b"\x00\x01\x00\x00"


def _json(value: Any) -> bytes:
    return orjson.dumps(value, option=orjson.OPT_SERIALIZE_NUMPY)


_ENCODERS: dict[str, Callable[[Any], bytes]] = {"json": _json, "cbor": cbor2.dumps}
_ANY: msgspec.json.Decoder[Any] = msgspec.json.Decoder()


class Compiled:
    """The types of one text. Each way has a fast part for what is usual and closures for all else.

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

    def reader(self, name: str, form: str) -> Reader:
        """What turns a message of this type into ``form``, ``json`` or ``cbor``."""
        found = self._readers.get((name, form))
        if found is None:
            slow = self._slow_reader(name, form)
            found = fast_reader.generate(name, self.definitions, form, slow)
            self._readers[name, form] = found
        return found

    def _slow_reader(self, name: str, form: str) -> Reader:
        encode = _ENCODERS[form]

        def read(cdr: bytes) -> bytes:
            if len(cdr) < HEAD:
                raise Invalid(f"{name}: {len(cdr)} bytes are too short for a CDR message")
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
        """What turns JSON into a message of this type; ``checked`` text is not checked again."""
        found = self._writers.get(name)
        if found is None:
            made = fast_writer.generate(name, self.definitions)
            strict, trusting = self._slow_writer(name, jsontext.decode_any), self._slow_writer(name, _decode)
            found = self._writers[name] = (made(strict), made(trusting))
        return found[checked]

    def _slow_writer(self, name: str, decode: Callable[[bytes], Any]) -> Writer:
        def write(body: Any, now_ns: int) -> bytes:
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
            return _WRITTEN_HEAD + out

        return write


def _decode(text: bytes) -> Any:
    try:
        return _ANY.decode(text)
    except jsontext.FAULTS as error:
        raise jsontext.malformed(error, Any) from None
