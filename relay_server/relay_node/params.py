"""``/rosapi/…`` about parameters, answered by the nodes' own parameter services on the robot.

A parameter is named ``<node>:<parameter>``, its value is JSON text. The caller needs the right to call that service of
that node. Source: rosapi of rosbridge_suite for ROS 2; ROS 2 design, "ROS 2 Parameters";
``rcl_interfaces/msg/ParameterType``.
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import math
from collections import deque
from typing import Any

from relay_protocol import jsontext, nonfinite
from relay_protocol.errors import Invalid, MalformedMessage, NotFound, SwitchboardError, Unavailable
from relay_protocol.limits import NAME
from relay_protocol.rights import Operation
from relay_server.common.concurrency import PerKeySemaphore, gather_per_key
from relay_server.relay_node.arguments import absolute, text
from relay_server.relay_node.visible_graph import visible_graph
from relay_server.sessions.context import ClientContext
from relay_server.sessions.motion_requests import call_context

NOT_SET = 0
BOOL = 1
INTEGER = 2
DOUBLE = 3
STRING = 4
BYTES = 5
BOOLS = 6
INTEGERS = 7
DOUBLES = 8
STRINGS = 9

_FIELDS = {
    BOOL: "bool_value",
    INTEGER: "integer_value",
    DOUBLE: "double_value",
    STRING: "string_value",
    BYTES: "byte_array_value",
    BOOLS: "bool_array_value",
    INTEGERS: "integer_array_value",
    DOUBLES: "double_array_value",
    STRINGS: "string_array_value",
}
MAX_VALUES = 65_536
"""Most values of a parameter that is a list; each is looked at several times."""

_OF_ELEMENTS = {BOOL: BOOLS, INTEGER: INTEGERS, DOUBLE: DOUBLES, STRING: STRINGS}


def from_parameter(parameter: Any) -> tuple[Any] | None:
    """The value as JSON has it, in a tuple of its own because it can be null (NaN); ``None`` when nothing is set.

    :param parameter: a ParameterValue in JSON, from a robot
    :raises Invalid: it is none
    """
    try:
        kind = parameter["type"]
        if kind == NOT_SET:
            return None
        value = parameter[_FIELDS[kind]]
        if kind != STRING and _count_of(value) > MAX_VALUES:
            raise Invalid(f"this parameter has more than {MAX_VALUES} values, which the relay does not show")
        if kind == BYTES and isinstance(value, str):
            # In messages bytes are base64; a parameter's value is what people read and write.
            return (list(base64.b64decode(value, validate=True)),)
    except (TypeError, KeyError, binascii.Error, ValueError):
        raise Invalid("this is no value of a parameter") from None
    return (value,)


def _count_of(value: Any) -> int:
    """Values of a list, or of the base64 of bytes; 0 for others."""
    if isinstance(value, list):
        return len(value)
    return len(value) * 3 // 4 - value[-2:].count("=") if isinstance(value, str) else 0


def to_parameter(value: Any, current_type: int | None = None) -> dict[str, Any]:
    """A ParameterValue in JSON, to be sent to a robot.

    :param value: decoded from JSON
    :param current_type: the type the parameter has now, where that is known: it decides between 1 and 1.0, bytes
        and integers, what an empty list is of, and whether null is NaN, as which it is read
    :raises Invalid: no parameter can have this value
    """
    if isinstance(value, list):
        if len(value) > MAX_VALUES:
            raise Invalid(f"a parameter may have {MAX_VALUES} values, not {len(value)}")
        if current_type == DOUBLES or any(isinstance(each, float) for each in value):
            value = [math.nan if each is None else each for each in value]
        kind = _kind_of_list(value, current_type)
    else:
        if value is None and current_type == DOUBLE:
            value = math.nan
        kind = _kind(value)
        if kind == INTEGER and current_type == DOUBLE:
            kind = DOUBLE
    return {"type": kind, _FIELDS[kind]: value}


def _kind(value: Any) -> int:
    if isinstance(value, bool):
        return BOOL
    if isinstance(value, int):
        return INTEGER
    if isinstance(value, float):
        return DOUBLE
    if isinstance(value, str):
        return STRING
    if value is None:
        raise Invalid(
            "null is NaN, which only a parameter of numbers with a fraction can be; this one is none now"
        )
    raise Invalid("a parameter is a boolean, a number, a string, or a list of one of these")


def _kind_of_list(values: list[Any], current_type: int | None) -> int:
    kinds = {_kind(each) for each in values}
    if not kinds:
        if current_type in (BYTES, BOOLS, INTEGERS, DOUBLES, STRINGS):
            return current_type
        raise Invalid("the parameter has no type yet, and an empty list has none; send a list with a value")
    if kinds == {INTEGER, DOUBLE} or (kinds == {INTEGER} and current_type == DOUBLES):
        return DOUBLES
    if kinds == {INTEGER} and current_type == BYTES and all(0 <= each <= 255 for each in values):
        return BYTES
    if len(kinds) > 1:
        raise Invalid("a parameter's list holds values of one type only")
    return _OF_ELEMENTS[kinds.pop()]


SECONDS = 5.0
"""A node has this long to answer about one parameter, as in rosapi."""

LIST_SECONDS = 2.0
"""A node has this long to list its parameters; one that does not is left out."""

ALL_SECONDS = 10.0
"""All nodes together have this long."""

SURVEYS = 16
SURVEYS_OF_USER = 4
"""Questions for which the nodes of one robot are asked at a time, and those of one user."""

_LIST = "rcl_interfaces/srv/ListParameters"
NAMES = 65_536
"""Most names in one answer; longer ones than a name may be are left out."""

_surveys = PerKeySemaphore(
    SURVEYS, f"{SURVEYS} callers are asking all nodes for their parameters; try again in a moment"
)
_surveys_of_user = PerKeySemaphore(
    SURVEYS_OF_USER,
    f"{SURVEYS_OF_USER} questions of yours for all parameters wait already; try again in a moment",
)


def _split(args: Any) -> tuple[str, str]:
    """Node and parameter.

    :raises Invalid: not of the form ``<node>:<parameter>``
    """
    given = text(args, "name")
    node, colon, parameter = given.partition(":")
    if not colon or not node.strip("/") or not parameter:
        raise Invalid(f"'{given[:80]}' is no parameter; write <node>:<parameter>, say /camera:exposure")
    return absolute(node), parameter


async def ask_node(
    client: ClientContext,
    node: str,
    service: str,
    request: Any,
    seconds: float = SECONDS,
    earliest_sent: int | None = None,
) -> Any:
    """Call a parameter service of a node.

    :param earliest_sent: see :class:`relay_server.sessions.message_age.MessageAge`;
        ``None``: that of what the client sends now
    :raises Refused: the caller may not call it
    :raises NotFound: the node is not there, or has no such service
    """
    name = f"{node}/{service}"
    with client.quota.counted():
        client.require(Operation.CALL, name)
        found = visible_graph(client).services.get(name)
        if found is None or not found.types:
            raise NotFound(f"there is no node {node} with parameters on robot {client.robot.name}")
    client.quota.count_robot_request()
    args = jsontext.encode(nonfinite.from_floats(request))
    answer = await client.channel.requests.call(
        name,
        found.types[0],
        args,
        seconds,
        call_context(client, name, client.earliest_sent if earliest_sent is None else earliest_sent, args),
    )
    with client.quota.counted():
        return jsontext.decode_any(answer)


async def _value(client: ClientContext, node: str, parameter: str) -> Any:
    """The parameter's ``rcl_interfaces/msg/ParameterValue``; its type is 0 when it is not set."""
    answer = await ask_node(client, node, "get_parameters", {"names": [parameter]})
    try:
        values = answer["values"]
        # A node that does not know the parameter at all sends no value.
        return values[0] if values else {"type": NOT_SET}
    except (TypeError, KeyError) as error:
        raise odd_answer(node) from error


def odd_answer(node: str) -> Unavailable:
    """The error of an answer that can't be read."""
    return Unavailable(f"node {node} gave an answer about its parameters that makes no sense")


async def get_param(client: ClientContext, args: Any) -> Any:
    """``/rosapi/get_param``. What can't be had comes as ``default_value``, or as null."""
    default = text(args, "default_value", 1, "")
    try:
        node, parameter = _split(args)
        found = await _value(client, node, parameter)
        try:
            value = from_parameter(found)
        except Invalid as error:
            raise odd_answer(node) from error
        if value is not None:
            return _got(jsontext.encode(value[0]).decode())
        if default:
            return _got(_as_json(default))
        reason = f"the parameter {parameter} of node {node} is not set"
    except SwitchboardError as error:
        reason = str(error)
    return {"value": _as_json(default), "successful": False, "reason": reason}


def _got(value: str) -> dict[str, Any]:
    return {"value": value, "successful": True, "reason": ""}


def _as_json(default: str) -> str:
    """The default as JSON text; what is none counts as a string."""
    if not default:
        return "null"
    try:
        return jsontext.encode(jsontext.decode_any(default.encode())).decode()
    except MalformedMessage:
        return jsontext.encode(default).decode()


async def has_param(client: ClientContext, args: Any) -> Any:
    """``/rosapi/has_param``: false also for what the caller may not ask, as for what is not there."""
    try:
        node, parameter = _split(args)
        return {"exists": from_parameter(await _value(client, node, parameter)) is not None}
    except SwitchboardError:
        return {"exists": False}


async def set_param(client: ClientContext, args: Any) -> Any:
    """``/rosapi/set_param``"""
    given, earliest_sent = text(args, "value", 1), client.earliest_sent
    try:
        node, parameter = _split(args)
        try:
            value = nonfinite.to_floats(jsontext.decode_any(nonfinite.mark(given.encode())))
        except MalformedMessage as error:
            raise Invalid(f"'value' must be JSON text: {error}") from None
        client.require(Operation.CALL, f"{node}/set_parameters")
        current_type = await type_of_parameter(client, node, parameter) if is_ambiguous(value) else None
        return await _set(client, node, parameter, to_parameter(value, current_type), earliest_sent)
    except SwitchboardError as error:
        return {"successful": False, "reason": str(error)}


def is_ambiguous(value: Any) -> bool:
    """JSON does not distinguish 1 from 1.0, NaN from null, bytes from integers, nor types of empty lists."""
    return isinstance(value, list | None) or (isinstance(value, int) and not isinstance(value, bool))


async def type_of_parameter(client: ClientContext, node: str, parameter: str) -> int | None:
    """The type of the parameter now, ``None`` when it is not known."""
    try:
        found = (await _value(client, node, parameter))["type"]
    except (SwitchboardError, TypeError, KeyError):
        return None
    return found if isinstance(found, int) else None


async def delete_param(client: ClientContext, args: Any) -> Any:
    """``/rosapi/delete_param``: in ROS 2 a parameter is deleted by setting it to nothing."""
    try:
        node, parameter = _split(args)
        return await _set(client, node, parameter, {"type": NOT_SET})
    except SwitchboardError as error:
        return {"successful": False, "reason": str(error)}


async def _set(
    client: ClientContext, node: str, parameter: str, value: dict[str, Any], earliest_sent: int | None = None
) -> dict[str, Any]:
    request = {"parameters": [{"name": parameter, "value": value}]}
    answer = await ask_node(client, node, "set_parameters", request, earliest_sent=earliest_sent)
    try:
        (result,) = answer["results"]
        done, reason = bool(result["successful"]), str(result["reason"])
    except (TypeError, KeyError, ValueError) as error:
        raise odd_answer(node) from error
    if done:
        client.activity("param.set", param=f"{node}:{parameter}", deleted=value["type"] == NOT_SET)
    return {"successful": done, "reason": reason}


async def get_param_names(client: ClientContext, args: Any) -> Any:
    """``/rosapi/get_param_names``: of all nodes the caller may ask, at the same time. Silent nodes are left out."""
    nodes = [
        name.removesuffix("/list_parameters")
        for name, service in visible_graph(client).services.items()
        if name.endswith("/list_parameters") and _LIST in service.types
    ]
    found: dict[str, list[str]] = {}
    waiting, room = deque(nodes), NAMES

    async def ask(node: str) -> None:
        nonlocal room
        # Nodes that do not answer, or not with names, are left out.
        with contextlib.suppress(SwitchboardError, TypeError, KeyError):
            answer = await ask_node(client, node, "list_parameters", {}, LIST_SECONDS)
            names = answer["result"]["names"][:NAMES]
            found[node] = [f"{node}:{each}" for each in names if isinstance(each, str) and len(each) <= NAME]
            room -= len(found[node])
        if room <= 0:
            waiting.clear()

    mine, places = _surveys_of_user.take(client.quota.user), _surveys.take(client.channel)
    with mine, places, contextlib.suppress(Unavailable):
        await client.channel.requests.within(ALL_SECONDS, gather_per_key(waiting, ask))
    return {"names": [name for node in nodes for name in found.get(node, [])][:NAMES]}
