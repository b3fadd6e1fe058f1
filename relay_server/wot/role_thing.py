"""Thing Descriptions and Thing Models of Roles: elements that take commands are properties and actions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple
from urllib.parse import quote

from relay_protocol.errors import Invalid, Refused
from relay_protocol.link import Service, Topic
from relay_protocol.rights import Operation, Rules
from relay_server.relay_node.visible_graph import VisibleGraph
from relay_server.roles.bindings import COMMANDS, Binding, Command, binding_of, choose
from relay_server.roles.commands import BOOL, SET_BOOL, TRIGGER
from relay_server.roles.schemas import RoleElement
from relay_server.wot.description import (
    ANY,
    JSON,
    MAX_AFFORDANCES,
    OBJECT,
    SECONDS,
    TD_CONTEXT,
    TEXT,
    TIME,
    form,
    or_null,
    security_of,
    thing_id,
)

_NEEDED: dict[tuple[str, Command], Operation] = {
    ("topics", "get"): Operation.SUBSCRIBE,
    ("topics", "set"): Operation.PUBLISH,
    ("topics", "start"): Operation.PUBLISH,
    ("topics", "stop"): Operation.PUBLISH,
    ("services", "call"): Operation.CALL,
    ("services", "start"): Operation.CALL,
    ("services", "stop"): Operation.CALL,
    ("actions", "call"): Operation.CALL,
    ("actions", "stop"): Operation.CALL,
    ("modules", "start"): Operation.MANAGE,
    ("modules", "stop"): Operation.MANAGE,
}
"""Rights that commands on elements need, beside any right on the robot."""

_SWITCHES: dict[tuple[str, Command], frozenset[str]] = {
    ("topics", "start"): frozenset({BOOL}),
    ("topics", "stop"): frozenset({BOOL}),
    ("services", "start"): frozenset({SET_BOOL, TRIGGER}),
    ("services", "stop"): frozenset({SET_BOOL}),
}
"""Types of the devices that a command switches."""


class RoleRobot(NamedTuple):
    """A robot of a Role: the reader's rights, and what they see of it."""

    rules: Rules
    graph: VisibleGraph


Robots = Mapping[str, RoleRobot]
"""The robots that the reader has a right on, by name."""


def role_description(
    name: str, full: str, elements: Iterable[RoleElement], robots: Robots, base: str
) -> dict[str, Any]:
    """The Thing Description of a Role.

    :param full: name that is unique in the relay
    :param base: ``scheme://host[:port]`` of the relay
    """
    place = f"{base}/api/v1/roles/{quote(name, safe='')}"
    made = _affordances(elements, robots, place)
    return {
        "@context": TD_CONTEXT,
        "id": thing_id(base, "roles", full),
        "title": name,
        **security_of(base),
        "links": [
            {"href": f"{place}/tm", "rel": "type", "type": "application/tm+json"},
            {"href": place, "rel": "alternate", "type": JSON},
        ],
        **made,
    }


def role_model(name: str, elements: Iterable[RoleElement], robots: Robots) -> dict[str, Any]:
    """The Thing Model of a Role: the same without addresses; see :func:`role_description`."""
    made = _affordances(elements, robots, "")
    for group in made.values():
        for affordance in group.values():
            del affordance["forms"]
    return {"@context": TD_CONTEXT, "@type": "tm:ThingModel", "title": name, **made}


def _affordances(elements: Iterable[RoleElement], robots: Robots, place: str) -> dict[str, dict[str, Any]]:
    properties: dict[str, Any] = {"role-state": _role_state(place)}
    actions: dict[str, Any] = {f"{each}-role": _role_order(place, each) for each in ("start", "stop")}
    by_name = {each.name: each for each in elements}
    mapped = _mapped(by_name)
    for element in by_name.values():
        commands = _commands(element, [by_name[each] for each in mapped(element.name)], robots)
        href = f"{place}/elements/{quote(element.name, safe='')}"
        if len(properties) < MAX_AFFORDANCES and not commands.isdisjoint({"get", "set"}):
            properties[element.name] = _value(element, href, commands)
        if len(actions) < MAX_AFFORDANCES:
            actions |= _orders(element, href, commands)
    return {"properties": properties, "actions": actions}


def _mapped(elements: Mapping[str, RoleElement]) -> Callable[[str], list[str]]:
    """Finds the names of other elements that one is mapped to, over any number of mappings and either way."""
    joined: dict[str, set[str]] = {name: set() for name in elements}
    for name, element in elements.items():
        for other in element.mappings:
            joined[name].add(other)
            joined.setdefault(other, set()).add(name)

    def find(name: str) -> list[str]:
        seen, waiting = {name}, [name]
        while waiting:
            new = joined[waiting.pop()] - seen
            seen |= new
            waiting += new
        return sorted((seen - {name}) & elements.keys())

    return find


def _commands(element: RoleElement, mapped: list[RoleElement], robots: Robots) -> set[Command]:
    """Commands that an element takes, by its own resources or those of elements that it is mapped to."""
    own, others = _bindings([element]), _bindings(mapped)
    return {each for each in COMMANDS if _takes(own, others, each, robots)}


def _bindings(elements: Iterable[RoleElement]) -> list[Binding]:
    found = (binding_of(resource) for each in elements for resource in each.resources)
    return list(dict.fromkeys(each for each in found if each is not None))


def _takes(own: list[Binding], others: list[Binding], command: Command, robots: Robots) -> bool:
    """Whether a command goes to exactly one resource, and the reader has the right."""
    try:
        binding = choose("", command, own, others)
    except (Invalid, Refused):
        return False
    if not binding.robot:
        return True
    robot = robots.get(binding.robot)
    if robot is None:
        return False
    step = binding.kind, command
    name = binding.name if binding.kind == "modules" else f"/{binding.name.lstrip('/')}"
    if step in _NEEDED and not robot.rules.decide(_NEEDED[step], name).allowed:
        return False
    return step not in _SWITCHES or not _SWITCHES[step].isdisjoint(_types(robot.graph, binding.kind, name))


def _types(graph: VisibleGraph, kind: str, name: str) -> list[str]:
    there: Mapping[str, Topic | Service] = graph.topics if kind == "topics" else graph.services
    found = there.get(name)
    return [] if found is None else found.types


def _about(element: RoleElement) -> dict[str, str]:
    return {
        "title": element.name,
        "description": f"{' '.join(element.types)}: {', '.join(element.resources) or 'by its mappings'}",
    }


def _value(element: RoleElement, href: str, commands: set[Command]) -> dict[str, Any]:
    readable, writable = "get" in commands, "set" in commands
    operations = ["readproperty"] * readable + ["writeproperty"] * writable
    read_only = {**TEXT, "readOnly": True}
    return {
        **_about(element),
        "type": "object",
        "properties": {"role": read_only, "element": read_only, "resource": read_only, "value": ANY},
        "required": ["value"],
        "readOnly": not writable,
        "writeOnly": not readable,
        "forms": [form(href, *operations)],
    }


def _orders(element: RoleElement, href: str, commands: set[Command]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if "call" in commands:
        timeout = {**SECONDS, "minimum": 0.1, "maximum": 300, "default": 10}
        found[element.name] = {
            **_about(element),
            "input": {"type": "object", "properties": {"args": ANY, "timeout": timeout}},
            "output": _done(),
            "synchronous": True,
            "forms": [form(f"{href}/call", "invokeaction")],
        }
    for each in ("start", "stop"):
        if each in commands:
            found[f"{each}-{element.name}"] = {
                **_about(element),
                "output": _done(),
                "synchronous": False,
                "forms": [form(f"{href}/{each}", "invokeaction")],
            }
    return found


def _done() -> dict[str, Any]:
    texts = dict.fromkeys(("role", "element", "command", "resource", "state"), TEXT)
    return {"type": "object", "properties": {**texts, "values": ANY}}


def _state() -> dict[str, Any]:
    states = ["stopped", "starting", "running", "partial", "ended"]
    return {
        "type": "object",
        "properties": {
            "role": TEXT,
            "state": {**TEXT, "enum": states},
            "why": TEXT,
            "by": TEXT,
            "at": or_null(TIME),
            "parts": {"type": "array", "items": OBJECT},
        },
    }


def _role_state(place: str) -> dict[str, Any]:
    return {
        "title": "Whether the Role is started",
        **_state(),
        "readOnly": True,
        "observable": True,
        "forms": [
            form(f"{place}/run", "readproperty"),
            form(f"{place}/run", "observeproperty", "unobserveproperty", subprotocol="sse"),
        ],
    }


def _role_order(place: str, order: str) -> dict[str, Any]:
    return {
        "title": f"{order.capitalize()} the Role",
        "output": _state(),
        "synchronous": False,
        "forms": [form(f"{place}/run/{order}", "invokeaction")],
    }
