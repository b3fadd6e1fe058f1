"""The types of one robot: their definitions, and conversion of messages between CDR, JSON and CBOR.

JSON follows rosbridge: byte arrays are base64, NaN and infinity are ``null``. In CBOR arrays of numbers are typed
arrays (RFC 8746). Only the relay converts; a robot forwards CDR unread.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

from relay_protocol import jsontext
from relay_protocol.errors import Invalid, MalformedMessage, NotFound
from relay_protocol.limits import KIB, MIB, TYPE_TEXTS
from relay_protocol.ros.compiled import CompiledTypes, Reader, Writer
from relay_protocol.ros.definition import Definition, normalise, parts_of, source_of, text_of
from relay_protocol.ros.generated_json_to_cdr import Check
from relay_protocol.ros.typedefs import typedef

__all__ = ["Body", "Reader", "TypeRegistry", "Writer"]

_CACHE_CHARACTERS = 8 * MIB
_MIN_CHARACTERS = 4 * KIB
"""Every text counts as at least this many, because compiled types take memory too."""
_MAX_TYPES = 4096

Body = bytes | dict[str, Any]


class _CompiledCache:
    """Caches compiled texts, because the robots of a fleet send the same ones. The least recently used are evicted."""

    def __init__(self, characters: int) -> None:
        self._free_characters = characters
        self._entries: OrderedDict[tuple[str, str], CompiledTypes] = OrderedDict()

    def compiled(self, type_name: str, text: str) -> CompiledTypes:
        key = (type_name, text)
        found = self._entries.get(key)
        if found is not None:
            self._entries.move_to_end(key)
            return found
        found = self._entries[key] = CompiledTypes(type_name, text)
        self._free_characters -= max(len(text), _MIN_CHARACTERS)
        while self._free_characters < 0:
            (_, former), _ = self._entries.popitem(last=False)
            self._free_characters += max(len(former), _MIN_CHARACTERS)
        return found


_compiled_cache = _CompiledCache(_CACHE_CHARACTERS)


class TypeRegistry:
    """The type definitions of one robot. Names may be given as ``pkg/Name`` or ``pkg/msg/Name``."""

    def __init__(self) -> None:
        self._types: dict[str, CompiledTypes] = {}
        self._texts: dict[str, str] = {}
        self._characters = 0
        self._readers: dict[str, dict[str, Reader]] = {"json": {}, "cbor": {}}
        self._writers: dict[bool, dict[str, Writer]] = {False: {}, True: {}}

    def add(self, type_name: str, text: str) -> None:
        """Register a definition. An equal text changes nothing, another one replaces the earlier.

        :param type_name: of a message, service or action
        :param text: as in :class:`relay_protocol.link.channel.TypeDefinition`
        :raises Invalid: a bad name, or a text that is no complete definition
        """
        name = normalise(type_name)
        if self._texts.get(name) == text:
            return
        if len(self._texts) >= _MAX_TYPES and name not in self._texts:
            raise Invalid(f"{name}: this robot has sent {_MAX_TYPES} types already")
        characters = self._characters + len(text) - len(self._texts.get(name, ""))
        if characters > TYPE_TEXTS:
            raise Invalid(f"{name}: this robot has sent definitions of {TYPE_TEXTS // MIB} MiB already")
        compiled = _compiled_cache.compiled(name, text)
        self._texts[name] = text
        self._characters = characters
        self._clear_converters()
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
        """Whether the robot has sent a text for just this type, or for what ROS makes it of."""
        try:
            return source_of(normalise(type_name)) in self._texts
        except Invalid:
            return False

    def definition(self, type_name: str) -> str:
        """The text as the robot sent it, or the text of a type that rosidl derives.

        :raises NotFound: no text was sent for this type
        """
        name = normalise(type_name)
        text = self._texts.get(name)
        if text is not None:
            return text
        if source_of(name) not in self._texts:
            raise NotFound(f"the definition of {type_name} is not known")
        return self.full_text(name)

    def full_text(self, type_name: str) -> str:
        """The definition of a message with all it contains, also if it came as a part of another's.

        :raises NotFound: the type is not registered
        """
        name, compiled = self._find(type_name)
        return text_of(name, compiled.type_name, compiled.text, compiled.definitions)

    def reader(self, type_name: str, form: str) -> Reader:
        """A function that converts messages of this type to ``form``.

        It is valid until the robot sends another definition of the type.

        :param form: ``json`` or ``cbor``
        :raises NotFound: the type is not registered
        """
        made = self._readers[form]
        found = made.get(type_name)
        if found is None:
            name, compiled = self._find(type_name)
            found = made[type_name] = compiled.reader(name, form)
        return found

    def writer(self, type_name: str, checked: bool = False) -> Writer:
        """A function that converts JSON to messages of this type; see :meth:`reader`.

        :param checked: its text was already checked by :func:`relay_protocol.jsontext.check_text`
        :raises NotFound: the type is not registered
        """
        made = self._writers[checked]
        found = made.get(type_name)
        if found is None:
            name, compiled = self._find(type_name)
            found = made[type_name] = compiled.writer(name, checked)
        return found

    def command_writer(self, type_name: str) -> Writer:
        """The :meth:`writer` of commands of this type, as checked text. It refuses numbers that are not finite.

        :raises NotFound: the type is not registered
        """
        name, types = self._find(type_name)
        return types.command_writer(name)

    def check(self, type_name: str, commands: bool = False) -> Check:
        """The check of texts for robots that speak JSON; faster than writing. See :meth:`reader`.

        :param commands: whether it refuses what :meth:`command_writer` refuses
        :raises NotFound: the type is not registered
        """
        name, types = self._find(type_name)
        return types.check(name, commands)

    def is_stamped(self, type_name: str) -> bool:
        """Whether messages of this type have a header somewhere, whose stamp a client may leave out.

        :raises NotFound: the type is not registered
        """
        name, types = self._find(type_name)
        return types.is_stamped(name)

    def _clear_converters(self) -> None:
        for readers in self._readers.values():
            readers.clear()
        for writers in self._writers.values():
            writers.clear()

    def to_json(self, type_name: str, cdr: bytes) -> bytes:
        """A message from a robot as compact JSON.

        :param cdr: with its four-byte encapsulation header, little or big endian. Extra bytes are no
            error: rclpy counts gaps before empty sequences that it does not write, and pads the end.
        :raises NotFound: the type is not registered
        :raises Invalid: not a message of this type
        """
        found = self._readers["json"].get(type_name) or self.reader(type_name, "json")
        return found(cdr)

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
        """A service request or an action's goal as CDR, from an object or from a list of arguments in order.

        :param type_name: the service (``pkg/srv/Name`` or ``pkg/Name``), the action, or the message they
            stand for (``…/Name_Request``, ``…/Name_Goal``)
        :param body: ``None`` or nothing for no arguments
        :raises NotFound: the type is not registered
        :raises Invalid: see :meth:`from_json`
        """
        name, compiled = self._find(self._request_type(type_name))
        value = None if body == b"" else body
        if isinstance(value, bytes) and not value.startswith(b"{"):
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
        """rosapi's typedefs of a message and all messages it contains, each once, in depth-first order.

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

    def definitions(self, type_name: str) -> Mapping[str, Definition]:
        """The definition of a message, and of all others that came with it, by their full names.

        :raises NotFound: the type is not registered
        """
        return self._find(type_name)[1].definitions

    def _request_type(self, type_name: str) -> str:
        """The request of a service or the goal of an action; any other name unchanged."""
        full = [type_name]
        if type_name.count("/") == 1:
            full = [type_name.replace("/", f"/{kind}/") for kind in ("srv", "action")]
        for name in map(normalise, full):
            for asking in (f"{name}_Request", f"{name}_Goal"):
                if asking in self._types:
                    return asking
        return type_name

    def _find(self, type_name: str) -> tuple[str, CompiledTypes]:
        compiled = self._types.get(type_name)
        if compiled is not None:
            return type_name, compiled
        name = normalise(type_name)
        compiled = self._types.get(name)
        if compiled is None:
            raise NotFound(f"the definition of {name} is not known")
        return name, compiled
