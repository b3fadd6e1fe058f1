"""Elements of Roles and the resources that they are bound to: addresses, commands, and values of fields."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any, Literal, NamedTuple, get_args
from urllib.parse import unquote

from relay_protocol.errors import Invalid, NotFound, Refused

RESOURCE_EXAMPLE = "robots/rover/topics/joy#/axes/0"

Command = Literal["get", "set", "call", "start", "stop"]
COMMANDS: tuple[Command, ...] = get_args(Command)

KINDS: dict[Command, tuple[str, ...]] = {
    "get": ("topics", "params", "modules", "pipes", "ports"),
    "set": ("topics", "params", "ports"),
    "call": ("services", "functions", "actions"),
    "start": ("modules", "pipes", "programs", "services", "topics"),
    "stop": ("modules", "pipes", "programs", "services", "topics", "actions"),
}
"""Resources that take a command. ``start`` and ``stop`` of a topic or service switch a device on and off."""

_ROBOT_RESOURCE = re.compile(
    r"(?:\w+:)?/?(?:api/v1/)?robots/(?P<robot>[^/#]+)"
    r"/(?P<kind>topics|services|actions|params|modules)/(?P<name>[^#]+)(?:#(?P<pointer>/.*))?\Z"
)
_PIPE_RESOURCE = re.compile(r"(?:\w+:)?/?(?:api/v1/)?pipes/(?P<name>[a-z][a-z0-9_-]{0,62})\Z")
_PROGRAM_RESOURCE = re.compile(
    r"(?:\w+:)?/?(?:api/v1/)?programs/(?P<program>[A-Za-z]\w{0,63})"
    r"(?:/(?P<kind>ports|functions)/(?P<name>[A-Za-z]\w{0,63})(?:#(?P<pointer>/.*))?)?\Z"
)
_INDEX = re.compile(r"(0|[1-9][0-9]{0,8})\Z")


class ElementNotCommandable(Refused):
    """An element is bound to no resource that takes a command."""

    code = "no_resource"
    http_status = 409


class Binding(NamedTuple):
    """The resource that an element is bound to.

    :param text: as the document has it
    :param robot: empty for a pipe or program
    :param kind: ``topics``, ``services``, ``actions``, ``params``, ``modules``, ``pipes``, ``programs``, ``ports`` or
        ``functions``
    :param name: of a port or function ``<program>/<name>``
    :param pointer: JSON Pointer (RFC 6901) to a field; empty for the whole. Of a service to a field of its reply; where
        another element is mapped to it, to an argument
    """

    text: str
    robot: str
    kind: str
    name: str
    pointer: str

    @property
    def steps(self) -> list[str]:
        """Names and indices of the pointer."""
        return [each.replace("~1", "/").replace("~0", "~") for each in self.pointer.split("/")[1:]]


def binding_of(text: str) -> Binding | None:
    """A binding by the value of ``switchboard:resource``; ``None`` if that is no address of a resource."""
    found = _ROBOT_RESOURCE.match(text)
    if found is not None:
        robot, name, pointer = (unquote(found[each] or "") for each in ("robot", "name", "pointer"))
        return Binding(text, robot, found["kind"], name, pointer)
    found = _PIPE_RESOURCE.match(text)
    if found is not None:
        return Binding(text, "", "pipes", found["name"], "")
    found = _PROGRAM_RESOURCE.match(text)
    if found is None:
        return None
    if not found["kind"]:
        return Binding(text, "", "programs", found["program"], "")
    name = f"{found['program']}/{found['name']}"
    return Binding(text, "", found["kind"], name, unquote(found["pointer"] or ""))


def choose(element: str, command: Command, own: Iterable[Binding], mapped: Iterable[Binding]) -> Binding:
    """The resource that a command goes to: the element's own, or that of an element which it is mapped to.

    :raises ElementNotCommandable: there is none
    :raises Invalid: there are several
    """
    kinds = KINDS[command]
    own, mapped = dict.fromkeys(own), dict.fromkeys(mapped)
    fitting = [each for each in own if each.kind in kinds] or [each for each in mapped if each.kind in kinds]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        names = ", ".join(each.text for each in fitting)
        raise Invalid(
            f"{element} is bound to several resources that take '{command}': {names}; name another element"
        )
    bound = ", ".join(each.text for each in (*own, *mapped))
    has = f"is bound to {bound}, which takes" if bound else "is bound to no resource, so it takes"
    raise ElementNotCommandable(
        f"{element} {has} no '{command}'; '{command}' needs one of {', '.join(kinds)}"
    )


def value_at(value: Any, binding: Binding) -> Any:
    """The field of a value that a binding points to.

    :raises NotFound: there is no such field
    """
    for step in binding.steps:
        try:
            value = value[int(step)] if isinstance(value, list) and _INDEX.match(step) else value[step]
        except (LookupError, TypeError):
            raise NotFound(f"{binding.text}: the value has no field {binding.pointer}") from None
    return value


def message_with(value: Any, binding: Binding) -> Any:
    """The message that sets the field of a binding. A plain value for a whole message is its field ``data``.

    :raises Invalid: the field is in a list
    """
    steps = binding.steps
    if not steps:
        return value if isinstance(value, dict) else {"data": value}
    if any(_INDEX.match(each) for each in steps):
        raise Invalid(f"{binding.text}: a value in a list can't be set alone; set the whole message")
    for step in reversed(steps):
        value = {step: value}
    return value


def field_path(binding: Binding) -> str:
    """The pointer as pipes write it, such as ``axes[0]``; empty for the whole message."""
    text = ""
    for step in binding.steps:
        text += f"[{step}]" if _INDEX.match(step) else f".{step}" if text else step
    return text
