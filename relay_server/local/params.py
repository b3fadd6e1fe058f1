"""``/rosapi/…`` about parameters, answered by the nodes' own parameter services on the robot.

A parameter is named ``<node>:<parameter>``, its value is JSON text. Whoever asks needs the right to call just that
service of just that node. Source: rosapi of rosbridge_suite for ROS 2; ROS 2 design, "ROS 2 Parameters";
``rcl_interfaces/msg/ParameterType``.
"""

from __future__ import annotations

import contextlib
from collections import deque
from typing import Any

from relay_protocol import jsontext, nonfinite
from relay_protocol.errors import Invalid, MalformedMessage, NotFound, SwitchboardError, Unavailable
from relay_protocol.limits import NAME
from relay_protocol.rights import Operation
from relay_server.local.arguments import absolute, text
from relay_server.local.together import Places, side_by_side
from relay_server.local.values import NOT_SET, from_parameter, to_parameter
from relay_server.local.view import view
from relay_server.session import Session

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

_surveys = Places(
    SURVEYS, f"{SURVEYS} callers are asking all nodes for their parameters; try again in a moment"
)
_surveys_of_user = Places(
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


async def _ask(
    session: Session,
    node: str,
    service: str,
    request: Any,
    seconds: float = SECONDS,
    stamp: int | None = None,
) -> Any:
    """Call a parameter service of a node.

    :param stamp: the relay's monotonic nanoseconds before which this can't have been asked for; as of now when it is
        left out
    :raises Refused: the caller may not call it
    :raises NotFound: the node is not there, or has no such service
    """
    name = f"{node}/{service}"
    with session.share.counted():
        session.judge(Operation.CALL, name)
        found = view(session).services.get(name)
        if found is None or not found.types:
            raise NotFound(f"there is no node {node} with parameters on robot {session.robot.name}")
    session.share.asks_robot()
    answer = await session.channel.asking.call(
        name,
        found.types[0],
        jsontext.encode(nonfinite.with_marks(request)),
        seconds,
        session.calling.sent(name, session.not_before if stamp is None else stamp),
    )
    with session.share.counted():
        return jsontext.decode_any(answer)


async def _value(session: Session, node: str, parameter: str) -> Any:
    """The parameter's ``rcl_interfaces/msg/ParameterValue``; its type is 0 when it is not set."""
    answer = await _ask(session, node, "get_parameters", {"names": [parameter]})
    try:
        values = answer["values"]
        # A node that does not know the parameter at all sends no value.
        return values[0] if values else {"type": NOT_SET}
    except (TypeError, KeyError) as error:
        raise _odd(node) from error


def _odd(node: str) -> Unavailable:
    return Unavailable(f"node {node} gave an answer about its parameters that makes no sense")


async def get_param(session: Session, args: Any) -> Any:
    """``/rosapi/get_param``. What can't be had comes as ``default_value``, or as null."""
    default = text(args, "default_value", 1, "")
    try:
        node, parameter = _split(args)
        found = await _value(session, node, parameter)
        try:
            value = from_parameter(found)
        except Invalid as error:
            raise _odd(node) from error
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


async def has_param(session: Session, args: Any) -> Any:
    """``/rosapi/has_param``: false also for what the caller may not ask, as for what is not there."""
    try:
        node, parameter = _split(args)
        return {"exists": from_parameter(await _value(session, node, parameter)) is not None}
    except SwitchboardError:
        return {"exists": False}


async def set_param(session: Session, args: Any) -> Any:
    """``/rosapi/set_param``"""
    given, stamp = text(args, "value", 1), session.not_before
    try:
        node, parameter = _split(args)
        try:
            value = nonfinite.plain(jsontext.decode_any(nonfinite.mark(given.encode())))
        except MalformedMessage as error:
            raise Invalid(f"'value' must be JSON text: {error}") from None
        session.judge(Operation.CALL, f"{node}/set_parameters")
        has = await _type_it_has(session, node, parameter) if _ambiguous(value) else None
        return await _set(session, node, parameter, to_parameter(value, has), stamp)
    except SwitchboardError as error:
        return {"successful": False, "reason": str(error)}


def _ambiguous(value: Any) -> bool:
    """JSON does not tell 1 from 1.0, NaN from nothing, nor bytes from integers, nor what an empty list would hold."""
    return isinstance(value, list | None) or (isinstance(value, int) and not isinstance(value, bool))


async def _type_it_has(session: Session, node: str, parameter: str) -> int | None:
    """The type of the parameter now, ``None`` when nobody can tell."""
    try:
        found = (await _value(session, node, parameter))["type"]
    except (SwitchboardError, TypeError, KeyError):
        return None
    return found if isinstance(found, int) else None


async def delete_param(session: Session, args: Any) -> Any:
    """``/rosapi/delete_param``: in ROS 2 a parameter is deleted by setting it to nothing."""
    try:
        node, parameter = _split(args)
        return await _set(session, node, parameter, {"type": NOT_SET})
    except SwitchboardError as error:
        return {"successful": False, "reason": str(error)}


async def _set(
    session: Session, node: str, parameter: str, value: dict[str, Any], stamp: int | None = None
) -> dict[str, Any]:
    request = {"parameters": [{"name": parameter, "value": value}]}
    answer = await _ask(session, node, "set_parameters", request, stamp=stamp)
    try:
        (result,) = answer["results"]
        done, reason = bool(result["successful"]), str(result["reason"])
    except (TypeError, KeyError, ValueError) as error:
        raise _odd(node) from error
    if done:
        session.notice("param.set", param=f"{node}:{parameter}", deleted=value["type"] == NOT_SET)
    return {"successful": done, "reason": reason}


async def get_param_names(session: Session, args: Any) -> Any:
    """``/rosapi/get_param_names``: of all nodes the caller may ask, side by side. Who does not answer is left out."""
    nodes = [
        name.removesuffix("/list_parameters")
        for name, service in view(session).services.items()
        if name.endswith("/list_parameters") and _LIST in service.types
    ]
    found: dict[str, list[str]] = {}
    waiting, room = deque(nodes), NAMES

    async def ask(node: str) -> None:
        nonlocal room
        # Who does not answer, or not with names, is left out.
        with contextlib.suppress(SwitchboardError, TypeError, KeyError):
            answer = await _ask(session, node, "list_parameters", {}, LIST_SECONDS)
            told = answer["result"]["names"][:NAMES]
            found[node] = [f"{node}:{each}" for each in told if isinstance(each, str) and len(each) <= NAME]
            room -= len(found[node])
        if room <= 0:
            waiting.clear()

    mine, places = _surveys_of_user.take(session.allowance), _surveys.take(session.channel)
    with mine, places, contextlib.suppress(Unavailable):
        await session.channel.asking.within(ALL_SECONDS, side_by_side(waiting, ask))
    return {"names": [name for node in nodes for name in found.get(node, [])][:NAMES]}
