"""Python classes of ROS 2 types by name: definitions, effect of commands, zero commands."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from rclpy.serialization import deserialize_message, serialize_message

from relay_protocol import link
from relay_protocol.errors import Invalid, NotFound
from robot_client.motion.velocity import velocity_access
from robot_client.platforms import definitions
from robot_client.platforms.base import CommandEffect
from robot_client.platforms.ros2 import command_classifier

_PLURALS = {"msg": "messages", "srv": "services", "action": "actions"}


_ACTION_SERVICES = {"SendGoal": "SendGoalService", "GetResult": "GetResultService"}
_DERIVED = {
    **{("srv", each, "msg"): (each,) for each in ("Request", "Response", "Event")},
    **{("action", each, "msg"): (each,) for each in ("Goal", "Result", "Feedback")},
    ("action", "FeedbackMessage", "msg"): ("Impl", "FeedbackMessage"),
    **{("action", name, "srv"): ("Impl", each) for name, each in _ACTION_SERVICES.items()},
    **{
        ("action", f"{name}_{part}", "msg"): ("Impl", each, part)
        for name, each in _ACTION_SERVICES.items()
        for part in ("Request", "Response", "Event")
    },
}
"""Attributes of a service's or action's class that hold derived types, by its kind, the suffix of the name,
and the kind of the derived type."""


class Interface(NamedTuple):
    """A service or an action: its name in the graph, the full name of its type, and that type's class."""

    name: str
    type: str
    kind: Any


class Types:
    """The types of this robot, each loaded once."""

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
        # By kind too: the C library of a service must never be used for an action.
        found = self._classes.get((name, kind))
        if found is None:
            full = definitions.normalise(name, kind)
            package, has, short = full.split("/")
            base, separator, suffix = short.partition("_")
            if separator and (has, suffix, kind) in _DERIVED:
                loaded = _load(package, has, base, full)
                found = _derived(loaded, _DERIVED[has, suffix, kind], full)
            elif has == kind:
                found = _load(package, kind, short, full)
            else:
                raise Invalid(f"{name} is not one of the {_PLURALS[kind]}")
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
        """Full names of all types with a definition, sorted; searched once."""
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
        except (NotFound, AttributeError):  # AttributeError: a part of a service, which is in its package too
            return None

    def classify_command(self, type: str, body: bytes) -> CommandEffect:
        """Whether a command of this type moves the robot."""
        velocity_form = velocity_access(type, "cdr")
        velocity = velocity_form.read(body) if velocity_form is not None else None
        if velocity is not None:
            if not velocity.finite:
                return CommandEffect.INVALID
            return CommandEffect.MOVING if velocity.moves else CommandEffect.STILL
        try:
            message = deserialize_message(body, self.message(type))
        except Exception:  # rclpy's errors differ between releases
            return CommandEffect.INVALID
        return command_classifier.classify(type, message)

    def zero_template(self, type: str, body: bytes) -> bytes:
        """The zero command of the same shape, without a stamp; empty for types whose messages all have one
        shape.

        :param body: a valid command
        """
        if type not in command_classifier.TYPES_WITH_TEMPLATE:
            return b""
        kind = self.message(type)
        return bytes(
            serialize_message(command_classifier.zero_like(type, deserialize_message(body, kind), kind()))
        )

    def zero_command(self, type: str, stamp: Any, template: bytes = b"") -> bytes:
        """The zero command, with this stamp if it has a header.

        :param template: from :meth:`zero_template` of the last command
        """
        kind = self.message(type)
        message = deserialize_message(template, kind) if template else kind()
        if message.get_fields_and_field_types().get("header") == command_classifier.HEADER:
            message.header.stamp = stamp
        return bytes(serialize_message(message))


def _derived(found: Any, path: tuple[str, ...], name: str) -> Any:
    """The class of a type that ROS derives from a service or an action.

    :raises NotFound: this distribution does not have it (before Iron, services have no events)
    """
    try:
        for each in path:
            found = getattr(found, each)
        found.__class__.__import_type_support__()
    except Exception:
        raise NotFound(f"the type {name} is not available on this robot") from None
    return found


def parse(body: bytes, kind: Any, what: str) -> Any:
    """Deserialise a message.

    :param kind: its class
    :param what: what it should be, for the error
    :raises Invalid: the bytes are not such a message
    """
    try:
        return deserialize_message(body, kind)
    except Exception:  # rclpy's errors differ between releases
        raise Invalid(f"the bytes are no {what}") from None


def _load(package: str, kind: str, short: str, name: str) -> Any:
    if not _has_interfaces(package, kind):
        raise NotFound(f"the type {name} is not installed on this robot")
    try:
        found = getattr(importlib.import_module(f"{package}.{kind}"), short)
    except (ImportError, AttributeError):
        raise NotFound(f"the type {name} is not installed on this robot") from None
    try:
        # Types of other distributions can be imported, but have no C library for this one.
        found.__class__.__import_type_support__()
    except Exception:
        raise NotFound(
            f"the type {name} is installed on this robot, but its library can't be loaded"
        ) from None
    return found


def _has_interfaces(package: str, kind: str) -> bool:
    """Whether this is a package of interfaces: importing any other one that a client names would run its
    code."""
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return False
    places = (spec and spec.submodule_search_locations) or ()
    return any(Path(place, kind).is_dir() for place in places)


def introspected(found: Any, kind: str) -> str:
    """Definition text from a Python class: fields and constants, without comments and defaults."""
    if kind == "srv":
        return f"{_fields(found.Request)}---\n{_fields(found.Response)}"
    if kind == "action":
        return f"{_fields(found.Goal)}---\n{_fields(found.Result)}---\n{_fields(found.Feedback)}"
    return _fields(found)


def _fields(found: Any) -> str:
    lines = [f"{_constant(name, value)}" for name, value in sorted(_constants(found).items())]
    for field, type in found.get_fields_and_field_types().items():
        lines.append(f"{_field_type(type)} {field}")
    return "".join(line + "\n" for line in lines)


def _constants(found: Any) -> Mapping[str, Any]:
    for name, value in vars(type(found)).items():
        if name.endswith("__constants") and isinstance(value, dict):
            return value
    return {}


def _constant(name: str, value: Any) -> str:
    # The class has a constant's value, but not its width; the widest type fits all.
    if isinstance(value, bool):
        return f"bool {name}={str(value).lower()}"
    if isinstance(value, int):
        return f"{'uint64' if value > 2**63 - 1 else 'int64'} {name}={value}"
    if isinstance(value, float):
        return f"float64 {name}={value!r}"
    if isinstance(value, bytes):
        return f"byte {name}={value[0]}"
    return f'string {name}="{value}"'


def _field_type(type: str) -> str:
    """A field's type in the syntax of .msg files: ``sequence<double, 3>`` is ``float64[<=3]``."""
    if type.startswith("sequence<"):
        inner, _, bound = type[len("sequence<") : -1].partition(", ")
        return f"{_field_type(inner)}[{'<=' + bound if bound else ''}]"
    if type.endswith("]"):
        inner, _, size = type[:-1].rpartition("[")
        return f"{_field_type(inner)}[{size}]"
    for plain in ("string", "wstring"):
        if type.startswith(plain + "<"):
            return f"{plain}<={type[len(plain) + 1 : -1]}"
    return {"double": "float64", "float": "float32", "boolean": "bool", "octet": "byte"}.get(type, type)
