"""ROS 2 types in Python: found by name, described, judged, zeroed."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from rclpy.serialization import deserialize_message, serialize_message

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound
from robot_client.motion.velocity import form
from robot_client.platforms import definitions
from robot_client.platforms.base import Motion
from robot_client.platforms.ros2 import motion

_OF = {"msg": "messages", "srv": "services", "action": "actions"}


_OF_ACTION = {"SendGoal": "SendGoalService", "GetResult": "GetResultService"}
_DERIVED = {
    **{("srv", each, "msg"): (each,) for each in ("Request", "Response", "Event")},
    **{("action", each, "msg"): (each,) for each in ("Goal", "Result", "Feedback")},
    ("action", "FeedbackMessage", "msg"): ("Impl", "FeedbackMessage"),
    **{("action", name, "srv"): ("Impl", each) for name, each in _OF_ACTION.items()},
    **{
        ("action", f"{name}_{part}", "msg"): ("Impl", each, part)
        for name, each in _OF_ACTION.items()
        for part in ("Request", "Response", "Event")
    },
}
"""Where the class of a service or an action has those of what ROS makes of it, by its kind, the ending of the name, and
the kind that is wanted."""


class Interface(NamedTuple):
    """A service or an action: its name in the graph, the full name of its type, and that type's class."""

    name: str
    type: str
    kind: Any


class Types:
    """All types of this robot, each looked up once."""

    def __init__(self) -> None:
        self._classes: dict[tuple[str, str], Any] = {}
        self._definitions: dict[str, link.TypeDefinition] = {}
        self._prefixes = definitions.prefixes()
        self._names: list[str] | None = None

    def message(self, name: str) -> Any:
        """The class of a message type.

        :raises NotFound: it is not installed
        """
        return self._class(name, "msg")

    def service(self, name: str) -> Any:
        """The class of a service type.

        :raises NotFound: it is not installed
        """
        return self._class(name, "srv")

    def action(self, name: str) -> Any:
        """The class of an action type.

        :raises NotFound: it is not installed
        """
        return self._class(name, "action")

    def _class(self, name: str, kind: str) -> Any:
        # By kind too: the C library of a service must never be handed to what makes an action.
        found = self._classes.get((name, kind))
        if found is None:
            full = definitions.normalise(name, kind)
            package, has, short = full.split("/")
            made, separator, what = short.partition("_")
            if separator and (has, what, kind) in _DERIVED:
                loaded = _load(package, has, made, full)
                found = _derived(loaded, _DERIVED[has, what, kind], full)
            elif has == kind:
                found = _load(package, kind, short, full)
            else:
                raise Invalid(f"{name} is no type of {_OF[kind]}")
            self._classes[name, kind] = found
        return found

    def definition(self, name: str) -> link.TypeDefinition:
        """Text and hash of a type.

        :raises NotFound: it is not installed
        """
        full = definitions.normalise(name)
        known = self._definitions.get(full)
        if known is None:
            text = definitions.full_text(full, self._text)
            known = link.TypeDefinition(
                type=name, text=text, hash=definitions.type_hash(full, self._prefixes)
            )
            self._definitions[full] = known
        return known

    def names(self) -> list[str]:
        """Full names of all types whose definition can be told, sorted; looked for once."""
        if self._names is None:
            self._names = definitions.all_names(self._prefixes)
        return self._names

    def _text(self, name: str) -> str | None:
        text = definitions.installed(name, self._prefixes)
        if text is not None:
            return text
        package, kind, short = name.split("/")
        try:
            return introspected(_load(package, kind, short, name), kind)
        except (NotFound, AttributeError):  # the latter for a part of a service, which its package has too
            return None

    def judge(self, type: str, body: bytes) -> Motion:
        """What a command of this type would do."""
        speeds = form(type, "cdr")
        velocity = speeds.read(body) if speeds is not None else None
        if velocity is not None:
            if not velocity.finite:
                return Motion.INVALID
            return Motion.MOVING if velocity.moves else Motion.STILL
        try:
            message = deserialize_message(body, self.message(type))
        except Exception:  # rclpy names its errors differently from release to release
            return Motion.INVALID
        return motion.judge(type, message)

    def resting(self, type: str, body: bytes) -> bytes:
        """The command of the same shape that stands still, without a stamp; empty where all zeros are alike.

        :param body: a command that was judged
        """
        if type not in motion.SHAPED:
            return b""
        kind = self.message(type)
        return bytes(serialize_message(motion.rest(type, deserialize_message(body, kind), kind())))

    def zero(self, type: str, stamp: Any, rest: bytes = b"") -> bytes:
        """The message that stands still, with this stamp in its header if it has one.

        :param rest: what :meth:`resting` gave for the last command
        """
        kind = self.message(type)
        message = deserialize_message(rest, kind) if rest else kind()
        if message.get_fields_and_field_types().get("header") == motion.HEADER:
            message.header.stamp = stamp
        return bytes(serialize_message(message))


def _derived(found: Any, path: tuple[str, ...], name: str) -> Any:
    """The class of what ROS makes of a service or an action.

    :raises NotFound: this distribution makes none (before Iron services have no events)
    """
    try:
        for each in path:
            found = getattr(found, each)
        found.__class__.__import_type_support__()
    except Exception:
        raise NotFound(f"the type {name} is not available on this robot") from None
    return found


def parse(body: bytes, kind: Any, what: str) -> Any:
    """The message in these bytes.

    :param kind: its class
    :param what: what it must be, for the error
    :raises Invalid: the bytes are none
    """
    try:
        return deserialize_message(body, kind)
    except Exception:  # rclpy names its errors differently from release to release
        raise Invalid(f"the bytes are no {what}") from None


def _load(package: str, kind: str, short: str, name: str) -> Any:
    if not _has_interfaces(package, kind):
        raise NotFound(f"the type {name} is not installed on this robot")
    try:
        found = getattr(importlib.import_module(f"{package}.{kind}"), short)
    except (ImportError, AttributeError):
        raise NotFound(f"the type {name} is not installed on this robot") from None
    try:
        # Types of other distributions import well but have no C library for this one.
        found.__class__.__import_type_support__()
    except Exception:
        raise NotFound(
            f"the type {name} is installed on this robot, but its library can't be loaded"
        ) from None
    return found


def _has_interfaces(package: str, kind: str) -> bool:
    """Whether this looks like a package of interfaces: to import any other, as a client names it, runs its code."""
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return False
    places = (spec and spec.submodule_search_locations) or ()
    return any(Path(place, kind).is_dir() for place in places)


def introspected(found: Any, kind: str) -> str:
    """The text of a type as its Python class tells it: fields and constants, no comments, no defaults."""
    if kind == "srv":
        return f"{_fields(found.Request)}---\n{_fields(found.Response)}"
    if kind == "action":
        return f"{_fields(found.Goal)}---\n{_fields(found.Result)}---\n{_fields(found.Feedback)}"
    return _fields(found)


def _fields(found: Any) -> str:
    lines = [f"{_constant(name, value)}" for name, value in sorted(_constants(found).items())]
    for field, type in found.get_fields_and_field_types().items():
        lines.append(f"{_written(type)} {field}")
    return "".join(line + "\n" for line in lines)


def _constants(found: Any) -> Mapping[str, Any]:
    for name, value in vars(type(found)).items():
        if name.endswith("__constants") and isinstance(value, dict):
            return value
    return {}


def _constant(name: str, value: Any) -> str:
    # The class keeps a constant's value, not its width; the widest type holds them all.
    if isinstance(value, bool):
        return f"bool {name}={str(value).lower()}"
    if isinstance(value, int):
        return f"{'uint64' if value > 2**63 - 1 else 'int64'} {name}={value}"
    if isinstance(value, float):
        return f"float64 {name}={value!r}"
    if isinstance(value, bytes):
        return f"byte {name}={value[0]}"
    return f'string {name}="{value}"'


def _written(type: str) -> str:
    """A field's type as .msg files write it: ``sequence<double, 3>`` is ``float64[<=3]``."""
    if type.startswith("sequence<"):
        inner, _, bound = type[len("sequence<") : -1].partition(", ")
        return f"{_written(inner)}[{'<=' + bound if bound else ''}]"
    if type.endswith("]"):
        inner, _, size = type[:-1].rpartition("[")
        return f"{_written(inner)}[{size}]"
    for plain in ("string", "wstring"):
        if type.startswith(plain + "<"):
            return f"{plain}<={type[len(plain) + 1 : -1]}"
    return {"double": "float64", "float": "float32", "boolean": "bool", "octet": "byte"}.get(type, type)
