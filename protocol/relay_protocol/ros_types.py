"""The types of one robot: their definitions, and conversion of messages between CDR, JSON and CBOR.

JSON has rosbridge's form: arrays of bytes are base64, NaN and infinity are ``null``. So has CBOR: arrays of
numbers are typed arrays (RFC 8746). For the relay only; a robot passes CDR on unread.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import cbor2
import msgspec
import orjson

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, MalformedMessage, NotFound
from relay_protocol.limits import MIB, TYPE_TEXTS
from relay_protocol.ros import fast_reader, fast_writer
from relay_protocol.ros.definition import Definition, normalise, parse, parts_of
from relay_protocol.ros.fast_writer import LARGEST_BODY
from relay_protocol.ros.reader import ReaderFactory
from relay_protocol.ros.typedefs import typedef
from relay_protocol.ros.writer import Mismatch, WriterFactory, as_invalid

_ORDERS = {b"\x00\x01": "<", b"\x00\x00": ">"}
"""Byte order of the numbers by the first two bytes of a message."""
_WRITTEN_HEAD = b"\x00\x01\x00\x00"
_SHARED_CHARACTERS = 8 * MIB
_TYPES_OF_A_ROBOT = 4096

Body = bytes | dict[str, Any]


Reader = Callable[[bytes], bytes]
"""Takes CDR with its header; gives the message in JSON or CBOR. Raises :class:`Invalid`."""

Writer = Callable[[Any, int], bytes]
"""Takes JSON (text as bytes, or decoded) and the present time (ns since 1970); gives CDR with its header.
Raises :class:`Invalid`."""


class _Compiled:
    """All types of one text. Readers and writers are built when first needed, and then kept."""

    def __init__(self, type_name: str, text: str) -> None:
        self.definitions: dict[str, Definition] = parse(type_name, text)
        self._writers = WriterFactory(self.definitions)
        self._factories: dict[tuple[str, str], ReaderFactory] = {}
        self._made: dict[tuple[str, str], Reader] = {}
        self._made_writers: dict[tuple[str, bool], Writer] = {}

    def reader(self, name: str, form: str) -> Reader:
        """What turns a message of this type into ``form``."""
        found = self._made.get((name, form))
        if found is None:
            found = self._made[name, form] = self._reader(name, form)
        return found

    def _reader(self, name: str, form: str) -> Reader:
        encode = _ENCODERS[form]

        def slow(cdr: bytes) -> bytes:
            if len(cdr) < 4:
                raise Invalid(f"{name}: {len(cdr)} bytes are too short for a CDR message")
            try:
                return encode(self._factory(cdr[:2], form).read(name, cdr))
            except Invalid as error:
                raise Invalid(f"{name}: {error}") from None

        return fast_reader.generate(name, self.definitions, form, slow)

    def _factory(self, encapsulation: bytes, form: str) -> ReaderFactory:
        order = _ORDERS.get(encapsulation)
        if order is None:
            raise Invalid(f"bytes 0 and 1 are {encapsulation.hex()}; plain CDR has 0001 or 0000")
        found = self._factories.get((order, form))
        if found is None:
            found = self._factories[order, form] = ReaderFactory(self.definitions, order, form == "cbor")
        return found

    def writer(self, name: str, checked: bool) -> Writer:
        """What turns JSON into a message of this type."""
        found = self._made_writers.get((name, checked))
        if found is None:
            found = self._made_writers[name, checked] = self._writer(name, checked)
        return found

    def _writer(self, name: str, checked: bool) -> Writer:
        decode = _decode_checked if checked else jsontext.decode_any

        def slow(body: Any, now_ns: int) -> bytes:
            try:
                value = decode(body) if type(body) is bytes else body
            except MalformedMessage as error:
                raise Invalid(f"{name}: {error}") from None
            out = bytearray()
            try:
                self._writers.writer(name)(out, value, now_ns)
            except Mismatch as error:
                raise as_invalid(name, error) from None
            if len(out) > LARGEST_BODY:
                raise Invalid(
                    f"{name}: the message has {len(out)} bytes; a robot takes at most {LARGEST_BODY}"
                )
            return _WRITTEN_HEAD + out

        return fast_writer.generate(name, self.definitions, slow)


def _decode_checked(text: bytes) -> Any:
    try:
        return _ANY.decode(text)
    except (msgspec.DecodeError, RecursionError, ValueError) as error:
        raise MalformedMessage(f"the message is not JSON: {error}") from None


_ANY: msgspec.json.Decoder[Any] = msgspec.json.Decoder()


def _json(value: Any) -> bytes:
    return orjson.dumps(value, option=orjson.OPT_SERIALIZE_NUMPY)


_ENCODERS: dict[str, Callable[[Any], bytes]] = {"json": _json, "cbor": cbor2.dumps}


class _Shared:
    """A fleet of like robots sends the same texts: each is compiled once. The least used make room."""

    def __init__(self, characters: int) -> None:
        self._room = characters
        self._kept: OrderedDict[tuple[str, str], _Compiled] = OrderedDict()

    def compiled(self, type_name: str, text: str) -> _Compiled:
        key = (type_name, text)
        found = self._kept.get(key)
        if found is not None:
            self._kept.move_to_end(key)
            return found
        found = self._kept[key] = _Compiled(type_name, text)
        self._room -= len(text)
        while self._room < 0:
            (_, former), _ = self._kept.popitem(last=False)
            self._room += len(former)
        return found


_shared = _Shared(_SHARED_CHARACTERS)


class TypeRegistry:
    """What one robot's types look like. Names may be given as ``pkg/Name`` or ``pkg/msg/Name``."""

    def __init__(self) -> None:
        self._types: dict[str, _Compiled] = {}
        self._texts: dict[str, str] = {}
        self._characters = 0

    def add(self, type_name: str, text: str) -> None:
        """Register a definition; the same again changes nothing, another one replaces the former.

        :param type_name: of a message, service or action
        :param text: as in :class:`relay_protocol.link.TypeDefinition`
        :raises Invalid: a bad name, or a text that is no complete definition
        """
        name = normalise(type_name)
        if self._texts.get(name) == text:
            return
        if len(self._texts) >= _TYPES_OF_A_ROBOT and name not in self._texts:
            raise Invalid(f"{name}: this robot has sent {_TYPES_OF_A_ROBOT} types already")
        characters = self._characters + len(text) - len(self._texts.get(name, ""))
        if characters > TYPE_TEXTS:
            raise Invalid(f"{name}: this robot has sent definitions of {TYPE_TEXTS // MIB} MiB already")
        compiled = _shared.compiled(name, text)
        self._texts[name] = text
        self._characters = characters
        for part in parts_of(name):
            self._types[part] = compiled
        # What it contains is known too, unless the robot sent a text of its own for it.
        for contained in compiled.definitions:
            self._types.setdefault(contained, compiled)

    def knows(self, type_name: str) -> bool:
        """Whether messages of this type (all parts of this service or action) can be converted."""
        try:
            name = normalise(type_name)
        except Invalid:
            return False
        return name in self._types or all(part in self._types for part in parts_of(name))

    def has_text(self, type_name: str) -> bool:
        """Whether the robot has sent a text for just this type."""
        try:
            return normalise(type_name) in self._texts
        except Invalid:
            return False

    def definition(self, type_name: str) -> str:
        """The text as the robot sent it.

        :raises NotFound: none was sent for just this type
        """
        text = self._texts.get(normalise(type_name))
        if text is None:
            raise NotFound(f"the definition of {type_name} is not known")
        return text

    def reader(self, type_name: str, form: str) -> Reader:
        """What turns messages of this type from a robot into ``form``: the fast way for many of them.

        It stays right until the robot sends another definition of the type; then ask anew.

        :param form: ``json`` or ``cbor``
        :raises NotFound: the type is not registered
        """
        name, compiled = self._find(type_name)
        return compiled.reader(name, form)

    def writer(self, type_name: str, checked: bool = False) -> Writer:
        """What turns JSON into messages of this type for a robot; see :meth:`reader`.

        :param checked: text that is given to it was looked at by :func:`relay_protocol.jsontext.check_text`
            before, as part of a larger message
        :raises NotFound: the type is not registered
        """
        name, compiled = self._find(type_name)
        return compiled.writer(name, checked)

    def to_json(self, type_name: str, cdr: bytes) -> bytes:
        """A message from a robot as compact JSON.

        :param cdr: with its four-byte encapsulation header, little or big endian. Bytes left over are no
            error: rclpy counts gaps before empty sequences that it does not write, and pads the end.
        :raises NotFound: the type is not registered
        :raises Invalid: the bytes are no message of this type
        """
        return self.reader(type_name, "json")(cdr)

    def to_cbor(self, type_name: str, cdr: bytes) -> bytes:
        """A message from a robot as CBOR; see :meth:`to_json`. NaN and infinity stay what they are."""
        return self.reader(type_name, "cbor")(cdr)

    def from_json(self, type_name: str, body: Body, now_ns: int) -> bytes:
        """A message for a robot as CDR with its header, little endian.

        :param body: a JSON object, as text or decoded
        :param now_ns: nanoseconds since 1970 for headers without a stamp
        :raises NotFound: the type is not registered
        :raises Invalid: it does not fit the type; the sentence names the field
        """
        return self.writer(type_name)(body, now_ns)

    def args_from_json(self, type_name: str, body: Body | list[Any] | None, now_ns: int) -> bytes:
        """A service request as CDR, from an object or from a list of arguments in order.

        :param type_name: the service (``pkg/srv/Name`` or ``pkg/Name``) or its request (``…/Name_Request``)
        :param body: ``None`` or nothing for no arguments
        :raises NotFound: the type is not registered
        :raises Invalid: see :meth:`from_json`
        """
        name, compiled = self._find(self._request_of(type_name))
        value = None if body == b"" else body
        if isinstance(value, bytes):
            try:
                value = jsontext.decode_any(value)
            except MalformedMessage as error:
                raise Invalid(f"{name}: {error}") from None
        if isinstance(value, list):
            fields = compiled.definitions[name].fields
            if len(value) > len(fields):
                raise Invalid(f"{name} has {len(fields)} arguments, not {len(value)}")
            value = {field.name: part for field, part in zip(fields, value, strict=False)}
        return compiled.writer(name, False)({} if value is None else value, now_ns)

    def zero(self, type_name: str) -> bytes:
        """The message in which every field has its default."""
        return self.from_json(type_name, {}, 0)

    def typedefs(self, type_name: str) -> list[dict[str, Any]]:
        """rosapi's typedefs of a message and of all it contains, each where it is met first, going down.

        :raises NotFound: the type is not registered
        """
        name, compiled = self._find(type_name)
        waiting, found = [name], dict[str, dict[str, Any]]()
        while waiting:
            name = waiting.pop()
            if name not in found:
                definition = compiled.definitions[name]
                found[name] = typedef(definition)
                contained = [each.type.base for each in definition.fields if each.type.primitive is None]
                waiting += reversed(contained)
        return list(found.values())

    def _request_of(self, type_name: str) -> str:
        if type_name.count("/") == 1:
            type_name = type_name.replace("/", "/srv/")
        request = f"{normalise(type_name)}_Request"
        return request if request in self._types else type_name

    def _find(self, type_name: str) -> tuple[str, _Compiled]:
        compiled = self._types.get(type_name)
        if compiled is not None:
            return type_name, compiled
        name = normalise(type_name)
        compiled = self._types.get(name)
        if compiled is None:
            raise NotFound(f"the definition of {name} is not known")
        return name, compiled
