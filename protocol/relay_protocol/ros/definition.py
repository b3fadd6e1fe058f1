"""ROS 2 interface definitions, parsed from the text a robot sends.

The text is not trusted. It is read line by line with patterns that cannot backtrack. Nesting, fixed lengths and the
number of fields, which decide the memory and time of a message, are bounded here before anything is built from it.

Source: the ROS 2 interface definition format (design.ros2.org, "Interface definition using .msg / .srv /
.action files"), in rosbag2's ``ros2msg`` layout.
"""

from __future__ import annotations

import enum
import re
import struct
from collections.abc import Container
from typing import Any, NamedTuple

from relay_protocol.errors import Invalid
from relay_protocol.limits import NAME, RELAY_JSON_FRAME, TYPE_DEFINITION

MAX_NESTING = 32
"""Deepest nesting of messages in messages."""

MAX_PARTS = 20_000
"""Most single values of one message when all its sequences are empty; an array of numbers counts as one."""

MAX_FIELDS = 4_000
"""Most fields and constants in one text."""


class Primitive(NamedTuple):
    """One basic type.

    :param code: its letter in :mod:`struct`; empty for strings
    :param size: bytes on the wire, which is its alignment too
    :param idl: its name in IDL, which rosapi shows
    :param zero: its default value
    """

    code: str
    size: int
    idl: str
    zero: Any


PRIMITIVES = {
    "bool": Primitive("?", 1, "boolean", False),
    "byte": Primitive("B", 1, "octet", 0),
    "char": Primitive("B", 1, "uint8", 0),
    "int8": Primitive("b", 1, "int8", 0),
    "uint8": Primitive("B", 1, "uint8", 0),
    "int16": Primitive("h", 2, "int16", 0),
    "uint16": Primitive("H", 2, "uint16", 0),
    "int32": Primitive("i", 4, "int32", 0),
    "uint32": Primitive("I", 4, "uint32", 0),
    "int64": Primitive("q", 8, "int64", 0),
    "uint64": Primitive("Q", 8, "uint64", 0),
    "float32": Primitive("f", 4, "float", 0.0),
    "float64": Primitive("d", 8, "double", 0.0),
    "string": Primitive("", 4, "string", ""),
    "wstring": Primitive("", 4, "wstring", ""),
}
BYTES = frozenset({"byte", "char", "uint8"})
"""Types whose arrays are base64 in JSON."""


class Shape(enum.Enum):
    """How many values a field holds."""

    SCALAR = "one"
    ARRAY = "a fixed number"
    SEQUENCE = "any number up to a bound"


class FieldType(NamedTuple):
    """Type of a field.

    :param base: a basic type or the full name of a message, ``geometry_msgs/msg/Point``
    :param bound: longest string, bytes; 0 for any
    :param length: of an array; of a sequence the most it holds, 0 for any
    """

    base: str
    bound: int = 0
    shape: Shape = Shape.SCALAR
    length: int = 0

    @property
    def primitive(self) -> Primitive | None:
        """The basic type, or ``None`` for a message."""
        return PRIMITIVES.get(self.base)


class Field(NamedTuple):
    """One field; ``default`` is ``None`` when the text has none."""

    name: str
    type: FieldType
    default: Any = None


class Constant(NamedTuple):
    """A constant of a definition; it is not sent."""

    name: str
    type: FieldType
    value: Any


class Definition(NamedTuple):
    """One message, or one half of a service."""

    name: str
    fields: tuple[Field, ...]
    constants: tuple[Constant, ...]


_PARTS = {"msg": ("",), "srv": ("_Request", "_Response"), "action": ("_Goal", "_Result", "_Feedback")}
_SERVICES = ("_SendGoal", "_GetResult")
"""Services of an action (design.ros2.org, actions)."""
_DERIVED = {
    "srv": re.compile(r"(.+?)_(?:Request|Response|Event)\Z"),
    "action": re.compile(
        r"(.+?)_(?:Goal|Result|Feedback|FeedbackMessage|(?:SendGoal|GetResult)(?:_(?:Request|Response|Event))?)\Z"
    ),
}
"""Names of the types that rosidl derives from a service or an action."""
_TYPE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*/(?:(?:msg|srv|action)/)?[A-Za-z][A-Za-z0-9_]*\Z")
_SEPARATOR = re.compile(r"={80,}[ \t\r]*\Z")
_LINE = re.compile(
    r"(?P<base>[A-Za-z][A-Za-z0-9_/]*)(?:<=(?P<bound>[0-9]{1,9}))?"
    r"(?P<brackets>\[(?P<upto><=)?(?P<length>[0-9]{0,9})\])?"
    r"[ \t]+(?P<name>[A-Za-z][A-Za-z0-9_]*)(?P<rest>.*)\Z"
)
_QUOTED = re.compile(r"""[ \t]*(?:"((?:[^"\\]|\\.)*)"|'((?:[^'\\]|\\.)*)')[ \t]*""")
_ITEM = re.compile(r"""(?:[ \t]*(?:"(?:[^"\\]|\\.)*"|'(?:[^'\\]|\\.)*')[ \t]*|[^,"']*)(?:,|\Z)""")
_KIND = re.compile(r"/(?:msg|srv|action)/")
_LONG_TYPE = re.compile(r"\A([ \t]*[A-Za-z][A-Za-z0-9_]*)/(?:msg|srv|action)/(?=[A-Za-z])")
_HEADER_ALONE = re.compile(r"\A([ \t]*)Header(?=[ \t\[])")
HEADER = "std_msgs/msg/Header"
_BOOLEANS = {"true": True, "1": True, "false": False, "0": False}
_BUILT_IN = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/msg/Duration": "int32 sec\nuint32 nanosec",
}
_UUID = "unique_identifier_msgs/msg/UUID"
_EVENT_INFO = "service_msgs/msg/ServiceEventInfo"
_OF_DERIVED = {
    _UUID: "uint8[16] uuid",
    _EVENT_INFO: (
        "uint8 REQUEST_SENT=0\nuint8 REQUEST_RECEIVED=1\nuint8 RESPONSE_SENT=2\nuint8 RESPONSE_RECEIVED=3\n"
        "uint8 event_type\nbuiltin_interfaces/Time stamp\nchar[16] client_gid\nint64 sequence_number"
    ),
}


def normalise(type_name: str) -> str:
    """The full form of a type name: ``std_msgs/String`` is ``std_msgs/msg/String``.

    :raises Invalid: no type name
    """
    if len(type_name) > NAME or not _TYPE_NAME.match(type_name):
        raise Invalid(f"{_quote(type_name)} is not a type name; write package/msg/Name or package/srv/Name")
    package, *kind, name = type_name.split("/")
    return f"{package}/{kind[0] if kind else 'msg'}/{name}"


def parts_of(type_name: str) -> tuple[str, ...]:
    """The message types of a type: itself, or the parts of a service or action."""
    kind = type_name.split("/")[1]
    if source_of(type_name) != type_name:
        kind = "srv" if type_name.endswith(_SERVICES) else "msg"
    return tuple(type_name + suffix for suffix in _PARTS[kind])


def source_of(type_name: str) -> str:
    """The type whose text defines a type: of ``pkg/action/Name_FeedbackMessage`` it is ``pkg/action/Name``.

    rosidl derives further messages and services from each service and action, without a text of their own. No other
    type has an underscore in its name.

    :param type_name: a normalised name
    """
    package, kind, name = type_name.split("/")
    derived = _DERIVED[kind].match(name) if kind in _DERIVED else None
    return type_name if derived is None else f"{package}/{kind}/{derived[1]}"


def _derived(type_name: str) -> dict[str, str]:
    """Texts of the messages that rosidl derives from a service or an action, and of the types they contain."""
    kind = type_name.split("/")[1]
    if kind == "msg":
        return {}
    found = dict(_OF_DERIVED)
    services = [type_name]
    if kind == "action":
        send, get = services = [type_name + each for each in _SERVICES]
        found |= {
            f"{type_name}_FeedbackMessage": f"{_UUID} goal_id\n{type_name}_Feedback feedback",
            f"{send}_Request": f"{_UUID} goal_id\n{type_name}_Goal goal",
            f"{send}_Response": "bool accepted\nbuiltin_interfaces/Time stamp",
            f"{get}_Request": f"{_UUID} goal_id",
            f"{get}_Response": f"int8 status\n{type_name}_Result result",
        }
    for each in services:
        found[f"{each}_Event"] = (
            f"{_EVENT_INFO} info\n{each}_Request[<=1] request\n{each}_Response[<=1] response"
        )
    return found


def parse(type_name: str, text: str) -> dict[str, Definition]:
    """Parse a definition with all types it contains; the parts of ``type_name`` come first.

    :param type_name: a normalised name
    :param text: see :class:`relay_protocol.link.channel.TypeDefinition`
    :raises Invalid: not a definition, incomplete, or beyond the limits
    """
    if len(text) > TYPE_DEFINITION:
        raise Invalid(f"{type_name}: the definition has more than {TYPE_DEFINITION} characters")
    try:
        definitions = _parse_all(type_name, text)
        _check_size(definitions)
    except Invalid as error:
        raise Invalid(f"definition of {type_name}: {error}") from None
    return _with_derived(type_name, definitions)


def _with_derived(type_name: str, definitions: dict[str, Definition]) -> dict[str, Definition]:
    """Add the messages that rosidl derives from the type, unless they are beyond the limits."""
    bodies = {name: body.split("\n") for name, body in _derived(type_name).items()}
    known = {**bodies, **definitions}
    whole = {**{name: _parse_one(name, body, known) for name, body in bodies.items()}, **definitions}
    try:
        _check_size(whole)
    except Invalid:
        return definitions
    return {**definitions, **whole}


def text_of(name: str, top: str, text: str, definitions: dict[str, Definition]) -> str:
    """The text of one message with all it contains and nothing else, in rosbag2's ``ros2msg`` layout.

    Types are named ``package/Name``, as in .msg files, also those of services and actions: readers of MCAP refuse
    longer names (mcap.dev/spec/registry, ``ros2msg``).

    :param name: a part of ``top``, or a message its text contains
    :param top: the type whose text it is
    :param definitions: what :func:`parse` made of it
    """
    main, *contained = _sections(text.split("\n"))
    bodies = {each: body.split("\n") for each, body in (_BUILT_IN | _derived(top)).items()}
    for lines in reversed(contained):
        bodies[normalise(lines[0].strip()[4:].strip())] = lines[1:]
    names = parts_of(top)
    bodies.update(zip(names, _split_parts(main, len(names)), strict=True))
    waiting, found = [name], dict[str, str]()
    while waiting:
        each = waiting.pop()
        if each not in found:
            title = "" if each == name else f"{'=' * 80}\nMSG: {_KIND.sub('/', each)}\n"
            own_header = f"{each.split('/')[0]}/msg/Header" in definitions
            body = "\n".join(_with_short_type(line, own_header) for line in bodies[each])
            found[each] = title + body.rstrip("\n") + "\n"
            kinds = (field.type for field in definitions[each].fields)
            waiting += reversed([kind.base for kind in kinds if kind.primitive is None])
    return "".join(found.values())


def _with_short_type(line: str, own_header: bool) -> str:
    """A line with its type as ``package/Name``.

    :param own_header: whether the package has a ``Header``, see :func:`_full_name`
    """
    if not own_header:
        line = _HEADER_ALONE.sub(r"\1std_msgs/Header", line)
    return _LONG_TYPE.sub(r"\1/", line)


def _parse_all(type_name: str, text: str) -> dict[str, Definition]:
    main, *contained = _sections(text.split("\n"))
    names = parts_of(type_name)
    bodies = dict(zip(names, _split_parts(main, len(names)), strict=True))
    for lines in contained:
        title = lines[0].strip() if lines else ""
        if not title.startswith("MSG:"):
            raise Invalid(f"after a line of '=' comes 'MSG: package/msg/Name', not {_quote(title)}")
        bodies.setdefault(normalise(title[4:].strip()), lines[1:])
    for name, body in _BUILT_IN.items():
        bodies.setdefault(name, body.split("\n"))
    found = {name: _parse_one(name, body, bodies) for name, body in bodies.items()}
    if sum(len(each.fields) + len(each.constants) for each in found.values()) > MAX_FIELDS:
        raise Invalid(f"more than {MAX_FIELDS} fields")
    return found


def _sections(lines: list[str]) -> list[list[str]]:
    sections: list[list[str]] = [[]]
    for line in lines:
        if _SEPARATOR.match(line):
            sections.append([])
        else:
            sections[-1].append(line)
    return sections


def _split_parts(lines: list[str], wanted: int) -> list[list[str]]:
    parts: list[list[str]] = [[]]
    for line in lines:
        if line.rstrip() == "---":
            parts.append([])
        else:
            parts[-1].append(line)
    if len(parts) != wanted:
        raise Invalid(f"{len(parts)} parts divided by '---', expected {wanted}")
    return parts


def _parse_one(name: str, lines: list[str], known: Container[str]) -> Definition:
    fields: dict[str, Field] = {}
    constants: dict[str, Constant] = {}
    for line in lines:
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        match = _LINE.match(line)
        if match is None:
            raise Invalid(f"{_quote(line)} is not a field")
        kind = _field_type(match, name.split("/")[0], known)
        label, rest = match["name"], match["rest"].lstrip()
        if label in fields or label in constants:
            raise Invalid(f"{name} has two fields '{label}'")
        if rest.startswith("="):
            constants[label] = Constant(label, kind, _literal(kind, rest[1:], label))
        else:
            default = _literal(kind, rest, label) if rest and not rest.startswith("#") else None
            fields[label] = Field(label, kind, default)
    return Definition(name, tuple(fields.values()), tuple(constants.values()))


def _field_type(match: re.Match[str], package: str, known: Container[str]) -> FieldType:
    base = match["base"]
    if base not in PRIMITIVES:
        base = _full_name(base, package, known)
    bound = int(match["bound"] or 0)
    if bound and base not in ("string", "wstring"):
        raise Invalid(f"{base} can't have a bound; only strings have")
    if not match["brackets"]:
        return FieldType(base, bound)
    length = int(match["length"] or 0)
    if match["length"] and not match["upto"]:
        if length == 0:
            raise Invalid(f"'{match['name']}' is an array of length 0")
        return FieldType(base, bound, Shape.ARRAY, length)
    return FieldType(base, bound, Shape.SEQUENCE, length)


def _full_name(base: str, package: str, known: Container[str]) -> str:
    """The full name of a message a field names.

    As in rosidl a name without a package is of the same package. ``Header`` alone is ``std_msgs/Header`` where the
    package has none, as in ROS 1.
    """
    if "/" in base:
        return normalise(base)
    own = normalise(f"{package}/msg/{base}")
    return HEADER if base == "Header" and own not in known else own


def _literal(kind: FieldType, text: str, label: str) -> Any:
    """A constant's or default's value, checked to fit its type."""
    primitive = kind.primitive
    if primitive is None:
        raise Invalid(f"'{label}' is a message and can't have a value in the text")
    try:
        if kind.shape is Shape.SCALAR:
            return _scalar(kind, primitive, text)
        values = [_scalar(kind, primitive, item) for item in _items(text)]
    except (ValueError, OverflowError, struct.error):
        raise Invalid(f"{_quote(text.strip())} is not a value for '{label}', which is {kind.base}") from None
    if (kind.shape is Shape.ARRAY and len(values) != kind.length) or (
        kind.length and len(values) > kind.length
    ):
        raise Invalid(f"'{label}' can't hold {len(values)} values")
    return values


def _scalar(kind: FieldType, primitive: Primitive, text: str) -> Any:
    if not primitive.code:
        quoted = _QUOTED.match(text)
        value = text.partition("#")[0].strip() if quoted is None else _unescape(quoted[1] or quoted[2] or "")
        if "\0" in value or (kind.bound and len(value.encode()) > kind.bound):
            raise ValueError
        return value
    text = text.partition("#")[0].strip()
    if primitive.code == "?":
        if text.lower() not in _BOOLEANS:
            raise ValueError
        return _BOOLEANS[text.lower()]
    number = float(text) if primitive.code in "fd" else _integer(text)
    struct.pack("<" + primitive.code, number)
    return number


def _integer(text: str) -> int:
    try:
        return int(text, 0)
    except ValueError:
        return int(text)


def _unescape(text: str) -> str:
    return re.sub(r"\\(.)", r"\1", text)


def _items(text: str) -> list[str]:
    text = text.strip()
    end = text.rfind("]")
    if not text.startswith("[") or end < 0 or text[end + 1 :].strip()[:1] not in ("", "#"):
        raise ValueError
    inner = text[1:end]
    items: list[str] = []
    position = 0
    while position < len(inner):
        match = _ITEM.match(inner, position)
        if match is None:
            raise ValueError
        items.append(match[0].removesuffix(","))
        position = match.end()
    return items


class _Cost(NamedTuple):
    """Size of a message when all its sequences are empty: values, bytes, levels of nesting."""

    parts: int
    size: int
    depth: int


def _check_size(definitions: dict[str, Definition]) -> None:
    """Reject cycles, missing types, deep nesting, and messages that are huge even when empty."""
    costs: dict[str, _Cost] = {}
    for name in definitions:
        _cost(name, definitions, costs, ())


def _cost(
    name: str, definitions: dict[str, Definition], costs: dict[str, _Cost], path: tuple[str, ...]
) -> _Cost:
    if name in costs:
        return costs[name]
    if name in path:
        raise Invalid(f"{name} contains itself")
    if name not in definitions:
        raise Invalid(f"{path[-1]} contains {name}, whose definition is not in the text")
    parts, size, depth = 1, 0, 0
    for field in definitions[name].fields:
        kind = field.type
        if kind.primitive is not None:
            one = _Cost(1, kind.primitive.size, 0)
        elif len(path) < MAX_NESTING:
            one = _cost(kind.base, definitions, costs, (*path, name))
            depth = max(depth, one.depth + 1)
        if depth > MAX_NESTING or (kind.primitive is None and len(path) >= MAX_NESTING):
            raise Invalid(f"messages are nested deeper than {MAX_NESTING}")
        if kind.shape is Shape.SEQUENCE:
            parts, size = parts + 1, size + 4
        elif kind.shape is Shape.ARRAY:
            packed = kind.primitive is not None and kind.primitive.code
            parts, size = parts + (1 if packed else one.parts * kind.length), size + one.size * kind.length
        else:
            parts, size = parts + one.parts, size + one.size
        if parts > MAX_PARTS or size > RELAY_JSON_FRAME:
            raise Invalid(f"{name} is too large even when its sequences are empty")
    costs[name] = _Cost(parts, size, depth)
    return costs[name]


def _quote(text: str) -> str:
    return repr(text if len(text) <= 60 else text[:57] + "...")
