"""Thing Descriptions (W3C WoT Thing Description 1.1) of robots and of the directory, as JSON.

The forms are addresses of the HTTP API that exist anyway: a topic is a property, a service or an action is an action.
Modules, parameters and cameras have names with hyphens, as all that is no topic, service or action.
Addresses are complete, because not all clients resolve them against ``base``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple
from urllib.parse import quote
from uuid import NAMESPACE_URL, uuid5

from relay_server.resources.states import ResourceLocation
from relay_server.wot.data_schema import Schema

TD_CONTEXT = "https://www.w3.org/2022/wot/td/v1.1"
DISCOVERY_CONTEXT = "https://www.w3.org/2022/wot/discovery"

MAX_AFFORDANCES = 500
"""Most topics, services, actions, modules and cameras of each kind in one description."""

MAX_THING_FIELDS = 6_000
"""Most fields of messages in one description; further messages are objects without a description."""

MODULE_ORDERS = ("start", "stop", "restart")

POLL_SECONDS = 60
"""Seconds that a long poll of a topic waits."""

JSON = "application/json"
OBJECT: Schema = {"type": "object"}
TEXT: Schema = {"type": "string"}
SECONDS: Schema = {"type": "number", "unit": "s"}
ANY: Schema = {
    "oneOf": [{"type": each} for each in ("object", "array", "string", "number", "boolean", "null")]
}
TIME: Schema = {"type": "number", "description": "Unix seconds"}

MOVES = (
    "It moves the robot: send a freshness token, which 'freshness-token' gives, within the robot's deadline."
)

FRESHNESS = {"freshness": {**TEXT, "description": "a freshness token"}}
"""The variable of addresses that move the robot."""


class ThingTopic(NamedTuple):
    """A topic that the reader may use.

    :param type: its full name, or empty
    :param moves: whether messages on it move the robot
    """

    name: str
    type: str
    readable: bool
    writable: bool
    moves: bool


class ThingOperation(NamedTuple):
    """A service or an action that the reader may call.

    :param type: its full name, or empty
    """

    name: str
    type: str
    moves: bool


class ThingParameters(NamedTuple):
    """Whether the reader may read and set parameters of nodes."""

    readable: bool
    writable: bool


class RobotThing(NamedTuple):
    """The part of a robot that a reader may see.

    :param full: name that is unique in the relay
    :param note: why it has no topics, services and actions, if so
    :param left_out: topics, services and actions beyond :data:`MAX_AFFORDANCES`
    :param modules: names
    :param cameras: names
    """

    name: str
    full: str
    description: str
    note: str
    topics: list[ThingTopic]
    services: list[ThingOperation]
    actions: list[ThingOperation]
    left_out: int
    parameters: ThingParameters
    modules: list[str]
    cameras: list[str]


Schemas = Callable[[str], Schema]
"""Returns the schema of a message, or of a part of a service or action, by its full name."""


def thing_id(base: str, kind: str, full: str) -> str:
    """The id of a Thing, the same as long as the relay has this address.

    :param base: ``scheme://host[:port]`` of the relay
    :param kind: ``robots`` or ``roles``
    :param full: name that is unique in the relay
    """
    return uuid5(NAMESPACE_URL, f"{base}/{kind}/{full}").urn


def security_of(base: str) -> dict[str, Any]:
    """The security of a Thing: a token as for the whole API."""
    token = {
        "scheme": "bearer",
        "in": "header",
        "format": "opaque",
        "authorization": f"{base}/oauth/token",
        "description": "A token of the relay, by 'switchboard token create' or OAuth 2.0",
    }
    return {"securityDefinitions": {"token": token}, "security": ["token"]}


def form(href: str, *operations: str, **more: Any) -> dict[str, Any]:
    """A form with JSON."""
    return {"href": href, "op": list(operations), "contentType": JSON, **more}


# --- robots -----------------------------------------------------------------------------------------------


def robot_description(thing: RobotThing, base: str, schemas: Schemas) -> dict[str, Any]:
    """The Thing Description of a robot."""
    place = ResourceLocation(base, thing.name)
    words = [thing.description or "A robot.", thing.note]
    if thing.left_out:
        words.append(f"{thing.left_out} topics, services and actions are left out.")
    actions = {_label(each.name): _service(each, place, schemas) for each in thing.services}
    goals = {_label(each.name): _action(each, place, schemas) for each in thing.actions}
    found = {
        "@context": TD_CONTEXT,
        "id": thing_id(base, "robots", thing.full),
        "title": thing.name,
        "description": " ".join(filter(None, words)),
        **security_of(base),
        "links": [{"href": place.address, "rel": "alternate", "type": JSON}],
        "properties": {_label(each.name): _topic(each, place, schemas) for each in thing.topics},
        "actions": actions | goals,
        "events": {"event-log": _event_log(place)},
    }
    operations = [*thing.services, *thing.actions]
    if any(each.moves for each in thing.topics) or any(each.moves for each in operations):
        found["properties"]["freshness-token"] = _freshness_token(place)
    if goals:
        found["properties"] |= {"goal-list": _goals(place), "goal-status": _goal_status(place)}
        found["actions"]["cancel-goal"] = _cancel_goal(place)
    if thing.parameters.readable:
        found["properties"] |= {
            "parameter-list": _parameter_list(place),
            "parameter": _parameter(place, thing.parameters.writable),
        }
    for module in thing.modules:
        found["properties"][f"module-{module}"] = _module(place, module)
        for order in MODULE_ORDERS:
            found["actions"][f"{order}-module-{module}"] = _module_order(place, module, order)
    found["properties"] |= {f"image-of-{_label(each)}": _image(place, each) for each in thing.cameras}
    return found


def _label(name: str) -> str:
    """The name of an affordance. Those of ROS have no hyphens, unlike the relay's own."""
    return name.lstrip("/")


def _topic(topic: ThingTopic, place: ResourceLocation, schemas: Schemas) -> dict[str, Any]:
    href = place.of("topics", topic.name)
    found: dict[str, Any] = {
        "title": topic.name,
        "description": _words(f"A topic of type {topic.type or 'unknown'}.", topic.moves),
        "type": "object",
        "properties": {
            "topic": {**TEXT, "readOnly": True},
            "type": TEXT,
            "at": {**TIME, "readOnly": True},
            "value": schemas(topic.type),
        },
        "required": ["value"],
        "observable": topic.readable,
        "forms": [],
    }
    if topic.readable:
        found["forms"].append(form(href, "readproperty"))
    else:
        found["writeOnly"] = True
    if not topic.writable:
        found["readOnly"] = True
    elif topic.moves:
        found["uriVariables"] = FRESHNESS
        found["forms"].append(form(_fresh(href), "writeproperty"))
    else:
        found["forms"].append(form(href, "writeproperty"))
    if topic.readable:
        observe = ("observeproperty", "unobserveproperty")
        poll = f"{href}?next=true&wait={POLL_SECONDS}"
        found["forms"] += [
            # First, as most clients send no credentials when they open a stream of events.
            form(poll, *observe, subprotocol="longpoll"),
            form(f"{href}?whole=true", *observe, subprotocol="sse"),
        ]
    return found


def _service(service: ThingOperation, place: ResourceLocation, schemas: Schemas) -> dict[str, Any]:
    timeout = {**SECONDS, "minimum": 0.1, "maximum": 300, "default": 10}
    return {
        "title": service.name,
        "description": _words(f"A service of type {service.type or 'unknown'}.", service.moves),
        "input": _object(args=schemas(_part(service.type, "Request")), timeout=timeout),
        "output": _object(values=schemas(_part(service.type, "Response"))),
        "synchronous": True,
        **_invoke(place.of("services", service.name), service.moves),
    }


def _action(action: ThingOperation, place: ResourceLocation, schemas: Schemas) -> dict[str, Any]:
    goal, invoke = f"{place.of('goals')}/{{id}}", _invoke(place.of("actions", action.name), action.moves)
    feedback, result = schemas(_part(action.type, "Feedback")), schemas(_part(action.type, "Result"))
    return {
        "title": action.name,
        "description": _words(
            f"An action of type {action.type or 'unknown'}. A goal is cancelled unless its status is queried "
            "again within 'poll_timeout'.",
            action.moves,
        ),
        "uriVariables": {
            "id": {**TEXT, "description": "of a goal, to query or cancel it"},
            **invoke.get("uriVariables", {}),
        },
        "input": _object(
            goal=schemas(_part(action.type, "Goal")),
            poll_timeout={**SECONDS, "exclusiveMinimum": 0, "maximum": 3600, "default": 10},
        ),
        "output": _goal_info(feedback, result),
        "synchronous": False,
        "forms": [
            *invoke["forms"],
            form(goal, "queryaction", **{"htv:methodName": "GET"}),
            form(goal, "cancelaction", **{"htv:methodName": "DELETE"}),
        ],
    }


def _goal_info(feedback: Schema, result: Schema) -> Schema:
    return _object(
        id=TEXT,
        action=TEXT,
        type=TEXT,
        state={
            **TEXT,
            "enum": ["active", "cancelling", "succeeded", "canceled", "aborted", "refused"],
        },
        reason=or_null(TEXT),
        begun=TIME,
        ended=or_null(TIME),
        feedback=or_null(feedback),
        result=or_null(result),
    )


def _goals(place: ResourceLocation) -> dict[str, Any]:
    return {
        "title": "Goals",
        "description": "The reader's own goals",
        **_object(goals={"type": "array", "items": OBJECT}, next=TEXT),
        "readOnly": True,
        "forms": [form(place.of("goals"), "readproperty")],
    }


def _goal_status(place: ResourceLocation) -> dict[str, Any]:
    return {
        "title": "Status of a goal",
        "description": "The same as to query an action, for clients that can't",
        "uriVariables": {"id": TEXT},
        **_goal_info(OBJECT, OBJECT),
        "readOnly": True,
        "forms": [form(f"{place.of('goals')}/{{id}}", "readproperty")],
    }


def _cancel_goal(place: ResourceLocation) -> dict[str, Any]:
    return {
        "title": "Cancel a goal",
        "description": "The same as to cancel an action, for clients that can't",
        "uriVariables": {"id": TEXT},
        "idempotent": True,
        "synchronous": False,
        "forms": [form(f"{place.of('goals')}/{{id}}/cancel", "invokeaction")],
    }


def _parameter_list(place: ResourceLocation) -> dict[str, Any]:
    return {
        "title": "Parameters",
        "description": "Names of the parameters of all nodes, a page; 'next' is the 'after' of the next one",
        "uriVariables": {"after": TEXT},
        **_object(params={"type": "array", "items": _object(name=TEXT)}, next=TEXT),
        "readOnly": True,
        "forms": [form(place.of("params") + "{?after}", "readproperty")],
    }


def _parameter(place: ResourceLocation, writable: bool) -> dict[str, Any]:
    operations = ("readproperty", "writeproperty") if writable else ("readproperty",)
    return {
        "title": "Parameter",
        "description": "A parameter of a node",
        "uriVariables": {"name": {**TEXT, "description": "<node>:<parameter>, as 'parameter-list' has it"}},
        **_object(name={**TEXT, "readOnly": True}, value=ANY),
        "required": ["value"],
        **({} if writable else {"readOnly": True}),
        "forms": [form(f"{place.of('params')}/{{+name}}", *operations)],
    }


def _module(place: ResourceLocation, module: str) -> dict[str, Any]:
    return {
        "title": module,
        "description": "A module: a process that the robot starts, watches and restarts",
        **_object(name=TEXT, kind=TEXT, state=TEXT, wanted={"type": "boolean"}, restarts={"type": "integer"}),
        "readOnly": True,
        "forms": [form(place.of("modules", module), "readproperty")],
    }


def _module_order(place: ResourceLocation, module: str, order: str) -> dict[str, Any]:
    return {
        "title": f"{order.capitalize()} {module}",
        "description": f"The module {module}: {order} it. The robot accepts the order before it is carried out.",
        "synchronous": False,
        "forms": [form(f"{place.of('modules', module)}/{order}", "invokeaction")],
    }


def _image(place: ResourceLocation, camera: str) -> dict[str, Any]:
    href = f"{place.base}/robots/{quote(place.robot)}/video/snapshot?topic={quote(camera, safe='')}"
    return {
        "title": camera,
        "description": "The newest image of a camera",
        **TEXT,
        "contentMediaType": "image/jpeg",
        "readOnly": True,
        "forms": [{"href": href, "op": ["readproperty"], "contentType": "image/jpeg"}],
    }


def _event_log(place: ResourceLocation) -> dict[str, Any]:
    href = f"{place.base}/api/v1/events?robot={quote(place.robot, safe='')}"
    return {
        "title": "Events",
        "description": "Events about the robot, as the relay stores them",
        "data": _object(id={"type": "integer"}, source=TEXT, kind=TEXT, at=TIME, data=OBJECT),
        "forms": [form(href, "subscribeevent", "unsubscribeevent", subprotocol="sse")],
    }


def _freshness_token(place: ResourceLocation) -> dict[str, Any]:
    return {
        "title": "Freshness token",
        "description": "Proof that a request is not older than this answer, for requests that move the robot",
        **_object(freshness=TEXT),
        "readOnly": True,
        "forms": [form(f"{place.address}/freshness", "readproperty")],
    }


def _invoke(href: str, moves: bool) -> dict[str, Any]:
    if moves:
        return {"uriVariables": FRESHNESS, "forms": [form(_fresh(href), "invokeaction")]}
    return {"forms": [form(href, "invokeaction")]}


def _fresh(href: str) -> str:
    return href + "{?freshness}"


def _part(type_name: str, part: str) -> str:
    return f"{type_name}_{part}" if type_name else ""


def _words(text: str, moves: bool) -> str:
    return f"{text} {MOVES}" if moves else text


def _object(**properties: Schema) -> Schema:
    return {"type": "object", "properties": properties}


def or_null(schema: Schema) -> Schema:
    """A value of this schema, or null."""
    return {"oneOf": [schema, {"type": "null"}]}


def typed(description: Any) -> Any:
    """A description in which each schema has a type: of alternatives the first remains, so null is left out.

    For clients that need a type, and do not check values.
    """
    if isinstance(description, list):
        return [typed(each) for each in description]
    if not isinstance(description, dict):
        return description
    if isinstance(alternatives := description.get("oneOf"), list):
        rest = {name: each for name, each in description.items() if name != "oneOf"}
        return typed({**alternatives[0], **rest})
    return {name: typed(each) for name, each in description.items()}


# --- the directory ----------------------------------------------------------------------------------------


def directory_description(base: str, things: str) -> dict[str, Any]:
    """The Thing Description of the directory (W3C WoT Discovery, section 7.3.2).

    :param things: address of the list of Things
    """
    page = {"type": "integer", "minimum": 0}
    return {
        "@context": [TD_CONTEXT, DISCOVERY_CONTEXT],
        "@type": "ThingDirectory",
        "id": thing_id(base, "things", ""),
        "title": "Switchboard",
        "description": "Robots and devices of this relay that the reader has a right on",
        **security_of(base),
        "properties": {
            "things": {
                "title": "Things",
                "type": "array",
                "items": OBJECT,
                "readOnly": True,
                "uriVariables": {"offset": page, "limit": {**page, "minimum": 1}},
                "forms": [
                    {
                        "href": f"{things}{{?offset,limit}}",
                        "op": ["readproperty"],
                        "contentType": "application/ld+json",
                    }
                ],
            }
        },
        "actions": {
            "retrieveThing": {
                "title": "Retrieve a Thing",
                "uriVariables": {"id": {**TEXT, "description": "id of the Thing"}},
                "output": OBJECT,
                "safe": True,
                "idempotent": True,
                "synchronous": True,
                "forms": [
                    {
                        "href": f"{things}/{{id}}",
                        "op": ["invokeaction"],
                        "contentType": "application/td+json",
                        "htv:methodName": "GET",
                    }
                ],
            }
        },
    }
