"""Parameters of the robot's nodes, named ``/node.parameter``: the node ends at the first point.

A name without the leading slash is answered as it was requested, as Foxglove's own bridge does.
Parameters are read and set by the nodes' own services, so the client needs the right to call these. Values that were
read are shared by all clients of the robot (:mod:`relay_server.channels.parameters`), as apps request all parameters
again and again. Changes of parameters that a client follows come from ``/parameter_events``, to which it needs the
right.
"""

from __future__ import annotations

import base64
import binascii
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import msgspec

from relay_protocol import jsontext, nonfinite
from relay_protocol.errors import Invalid, Refused, SwitchboardError, Unavailable
from relay_protocol.limits import NAME
from relay_protocol.rights import Operation
from relay_server.channels.parameters import NAMES, TOPIC, ParameterValue, Reader
from relay_server.common.concurrency import gather_per_key
from relay_server.foxglove import messages
from relay_server.foxglove.context import FoxgloveContext
from relay_server.relay_node import params
from relay_server.relay_node.visible_graph import visible_graph

REQUESTS = 32
"""Most requests of one client for parameters that wait for answers."""

EVENTS_ID, READ_ID = "parameters", "parameters-read"
"""Ids of statuses: of requests that were not carried out, and of nodes that could not be read."""

_LIST_SERVICE, _LIST_SERVICE_TYPE = "/list_parameters", "rcl_interfaces/srv/ListParameters"
_GET_SERVICE = "/get_parameters"
_TYPE_OF_HINT = {"float64": params.DOUBLE, "float64_array": params.DOUBLES, "byte_array": params.BYTES}
_HINT_OF_TYPE = {type_number: hint for hint, type_number in _TYPE_OF_HINT.items()}
"""Between the field ``type`` of this protocol and ``rcl_interfaces/msg/ParameterType``."""

Value = dict[str, Any]
"""Fields ``value`` and perhaps ``type`` of a parameter."""

WantedNames = dict[str, list[str] | None]
"""Names of parameters by node; ``None``: all of the node."""


class FoxgloveParameters:
    """The parameters that one client reads, sets and follows."""

    def __init__(self, context: FoxgloveContext) -> None:
        self._context = context
        self._cache = context.client.channel.parameters
        self._followed: dict[str, str] = {}
        """Full names of parameters, and how the client spells them."""
        self._follows_all = False
        self._left_out: set[str] = set()
        """Full names of parameters that are not followed although all are."""
        self._running = 0

    def end(self) -> None:
        """The session is over."""
        self._cache.unfollow(self)

    # --- operations ---------------------------------------------------------------------------------------

    def get(self, operation: messages.GetParametersOp) -> None:
        """Answer with parameters; without names with all."""
        names = self._context.first_entries(operation.parameter_names, NAMES, "getParameters")
        self._begin(self._answer(names, operation.id))

    def set(self, operation: messages.SetParametersOp) -> None:
        """Set parameters; answer with their values, if the client has given an id."""
        parameters = self._context.first_entries(operation.parameters, NAMES, "setParameters")
        self._begin(self._set(parameters, operation.id))

    def subscribe(self, operation: messages.SubscribeParametersOp) -> None:
        """Follow parameters; without names all."""
        names = operation.parameter_names
        named = _spelling(names)
        followed = self._followed | named
        if len(followed) > NAMES:
            self._context.deny(f"at most {NAMES} parameters can be followed", EVENTS_ID)
            return
        self._followed = followed
        if names:
            self._left_out -= named.keys()
        else:
            self._follows_all = True
            self._left_out = set()
        self._cache.follow(self)

    def unsubscribe(self, operation: messages.UnsubscribeParametersOp) -> None:
        """Follow parameters no more; without names none."""
        names = operation.parameter_names
        if not names:
            self._followed = {}
            self._follows_all = False
            self._left_out = set()
            return
        named = _spelling(names).keys()
        left_out = self._left_out | named if self._follows_all else set()
        if len(left_out) > NAMES:
            self._context.deny(f"at most {NAMES} parameters can be left out when all are followed", EVENTS_ID)
            return
        self._left_out = left_out
        for name in named:
            self._followed.pop(name, None)

    def _begin(self, work: Any) -> None:
        if self._running >= REQUESTS:
            work.close()
            text = f"{REQUESTS} requests for parameters wait already; wait for answers"
            self._context.deny(text, EVENTS_ID)
            return
        self._running += 1
        self._context.run(self._counted(work))

    async def _counted(self, work: Any) -> None:
        try:
            await work
        except SwitchboardError as error:
            self._context.deny(f"parameters: {error}", EVENTS_ID)
        finally:
            self._running -= 1

    # --- reading ------------------------------------------------------------------------------------------

    async def _answer(self, names: list[str], id: str | None) -> None:
        wanted = _by_node(names) if names else dict.fromkeys(self._readable_nodes())
        self._cache.follow(self)
        read = await self._read(wanted)
        with self._context.client.quota.timed():
            self._send(self._entries(read), id, _spelling(names))

    def _entries(self, nodes: WantedNames) -> list[dict[str, Any]]:
        """The known values of some parameters, by their full names."""
        return [
            _entry(node, name, value)
            for node, wanted in nodes.items()
            for name, value in self._values(node, wanted)
        ]

    def _values(self, node: str, wanted: list[str] | None) -> list[tuple[str, Value]]:
        """The known values of a node that the client may read now."""
        permit = self._context.client.permit
        if not permit.decide(Operation.CALL, f"{node}{_GET_SERVICE}").allowed:
            return []
        known = self._cache.values(node)
        names = known if wanted is None else [name for name in wanted if name in known]
        found = ((name, _value_or_none(known[name])) for name in names)
        return [(name, value) for name, value in found if value is not None]

    def _readable_nodes(self) -> list[str]:
        return [
            name.removesuffix(_LIST_SERVICE)
            for name, service in visible_graph(self._context.client).services.items()
            if name.endswith(_LIST_SERVICE) and _LIST_SERVICE_TYPE in service.types
        ]

    async def _read(self, wanted: WantedNames) -> WantedNames:
        """Read what is not known of some nodes, all of them at the same time; returns the part that is known now."""
        found: WantedNames = {}
        failures: list[str] = []

        async def read(node: str) -> None:
            try:
                await self._read_node(node, wanted[node])
                found[node] = wanted[node]
            except SwitchboardError as error:
                failures.append(f"{node}: {error}")

        try:
            await self._context.client.channel.requests.within(
                params.ALL_SECONDS, gather_per_key(deque(wanted), read)
            )
        except Unavailable as error:
            failures.append(str(error))
        if failures:
            text = f"parameters were not read: {'; '.join(failures[:4])}"
            self._context.show_state("warning", text, READ_ID)
        else:
            self._context.statuses.remove(READ_ID)
        return {node: names for node, names in wanted.items() if node in found}

    async def _read_node(self, node: str, names: list[str] | None) -> None:
        """Read parameters of a node that are not known; ``None``: all, except of a silent node.

        :raises SwitchboardError: see :meth:`ParameterCache.read`
        """
        self._context.client.require(Operation.CALL, f"{node}{_GET_SERVICE}")
        if names is None and self._cache.is_silent(node) and not self._cache.knows(node, None):
            raise Unavailable("it does not answer")
        await self._cache.read(node, names, self._reader(node))

    def _reader(self, node: str) -> Reader:
        client = self._context.client

        async def read(names: Sequence[str] | None) -> dict[str, ParameterValue]:
            if names is None:
                listed = await params.ask_node(client, node, "list_parameters", {}, params.LIST_SECONDS)
                names = _names_in(node, listed)
            return await read_values(names) if names else {}

        async def read_values(names: Sequence[str]) -> dict[str, ParameterValue]:
            answer = await params.ask_node(client, node, "get_parameters", {"names": names})
            values = _values_in(node, names, answer)
            if values is not None:
                return values
            # A node of rclcpp that does not know one of the names at all leaves out values, and not only that one.
            found: dict[str, ParameterValue] = {}
            for name in names if len(names) > 1 else ():
                found |= await read_values([name])
            return found

        return read

    # --- setting ------------------------------------------------------------------------------------------

    async def _set(self, entries: list[messages.ParameterEntry], id: str | None) -> None:
        earliest_sent = self._context.client.earliest_sent
        by_node: dict[str, list[tuple[str, messages.ParameterEntry]]] = {}
        for entry in entries:
            full = _full_name(entry.name)
            if full is None:
                text = f"parameters: '{entry.name[:80]}' is no parameter; write /node.parameter"
                self._context.deny(text, EVENTS_ID)
                continue
            node, _, name = full.partition(".")
            by_node.setdefault(node, []).append((name, entry))
        for node, wanted in by_node.items():
            try:
                await self._set_on_node(node, wanted, earliest_sent)
            except SwitchboardError as error:
                self._context.deny(f"set parameters of {node}: {error}", f"parameters-set:{node}")
        names = [entry.name for entry in entries]
        nodes = _by_node(names)
        await gather_per_key(deque(nodes), lambda node: self._read_again(node, nodes[node] or []))
        found = self._entries(nodes)
        if id is not None:
            self._send(found, id, _spelling(names))
        if not self._may_follow():
            followed = [each for each in found if self._is_followed(each["name"])]
            self._send(followed, None, self._followed)

    async def _read_again(self, node: str, names: list[str]) -> None:
        try:
            await self._cache.read_again(node, names, self._reader(node))
        except SwitchboardError as error:
            text = f"parameters of {node} were not read: {error}"
            self._context.show_state("warning", text, READ_ID)

    async def _set_on_node(
        self, node: str, wanted: list[tuple[str, messages.ParameterEntry]], earliest_sent: int
    ) -> None:
        """:raises SwitchboardError: the node refuses, with the reason"""
        client = self._context.client
        client.require(Operation.CALL, f"{node}/set_parameters")
        request: list[dict[str, Any]] = [
            {"name": name, "value": await self._parameter_value(node, name, entry)} for name, entry in wanted
        ]
        answer = await params.ask_node(
            client, node, "set_parameters", {"parameters": request}, earliest_sent=earliest_sent
        )
        reasons = []
        try:
            for each, result in zip(request, answer["results"], strict=True):
                if result["successful"]:
                    deleted = each["value"]["type"] == params.NOT_SET
                    client.activity("param.set", param=f"{node}:{each['name']}", deleted=deleted)
                else:
                    reasons.append(f"{each['name']}: {str(result['reason'])[:200]}")
        except (TypeError, KeyError, ValueError) as error:
            raise params.odd_answer(node) from error
        if reasons:
            raise Refused("; ".join(reasons))
        self._context.statuses.remove(f"parameters-set:{node}")

    async def _parameter_value(self, node: str, name: str, entry: messages.ParameterEntry) -> dict[str, Any]:
        """A ``rcl_interfaces/msg/ParameterValue`` in JSON."""
        if isinstance(entry.value, msgspec.UnsetType):
            return {"type": params.NOT_SET}
        value = nonfinite.to_floats(jsontext.decode_any(bytes(entry.value)))
        current_type = _TYPE_OF_HINT.get(entry.type or "")
        if current_type == params.BYTES:
            value = _bytes_of(value)
        elif current_type is None and params.is_ambiguous(value):
            current_type = await params.type_of_parameter(self._context.client, node, name)
        return params.to_parameter(value, current_type)

    # --- events -------------------------------------------------------------------------------------------

    def _is_followed(self, name: str) -> bool:
        return name in self._followed or (self._follows_all and name not in self._left_out)

    def _may_follow(self) -> bool:
        return self._context.client.permit.decide(Operation.SUBSCRIBE, TOPIC).allowed

    def parameters_changed(self, node: str, changed: dict[str, ParameterValue | None]) -> None:
        """Send the new values of the parameters that are followed."""
        followed = {name: value for name, value in changed.items() if self._is_followed(f"{node}.{name}")}
        if not followed or not self._may_follow():
            return
        found = []
        for name, parameter in followed.items():
            value = {} if parameter is None else _value_or_none(parameter)
            if value is not None:
                found.append(_entry(node, name, value))
        self._send(found, None, self._followed)

    def _send(self, found: list[dict[str, Any]], id: str | None, spelling: Mapping[str, str]) -> None:
        """Send values.

        :param id: of the request; ``None``: nothing is sent if there are no values
        :param spelling: names as the client spells them, by full names
        """
        parameters = [{**each, "name": spelling.get(each["name"], each["name"])} for each in found]
        if id is not None:
            self._context.send(messages.text("parameterValues", parameters=parameters, id=id))
        elif parameters:
            self._context.send(messages.text("parameterValues", parameters=parameters))


def _full_name(name: str) -> str | None:
    """The full name of a parameter; ``None``: it is none."""
    node, point, parameter = name.partition(".")
    if not (node.strip("/") and point and parameter):
        return None
    return name if node.startswith("/") else f"/{name}"


def _spelling(names: Iterable[str]) -> dict[str, str]:
    """Names as they are spelt, by full names; what is no name of a parameter is left out."""
    return {full: name for name in names if (full := _full_name(name)) is not None}


def _by_node(names: Iterable[str]) -> WantedNames:
    found: dict[str, list[str] | None] = {}
    for each in _spelling(names):
        node, _, name = each.partition(".")
        wanted = found.setdefault(node, [])
        if wanted is not None:
            wanted.append(name)
    return found


def _entry(node: str, name: str, value: Value) -> dict[str, Any]:
    return {"name": f"{node}.{name}", **value}


def _value_of(parameter: Any) -> Value | None:
    """A ``rcl_interfaces/msg/ParameterValue`` as this protocol has it; ``None``: it is not set.

    :raises Invalid: it is none
    """
    found = params.from_parameter(parameter)
    if found is None:
        return None
    value, kind = found[0], parameter["type"]
    if kind == params.BYTES:
        value = base64.b64encode(bytes(value)).decode()
    hint = _HINT_OF_TYPE.get(kind)
    return {"value": value} if hint is None else {"value": value, "type": hint}


def _value_or_none(parameter: Any) -> Value | None:
    """As :func:`_value_of`; ``None`` also for what is no value."""
    try:
        return _value_of(parameter)
    except Invalid:
        return None


def _names_in(node: str, listed: Any) -> list[str]:
    try:
        names = listed["result"]["names"][:NAMES]
        return [each for each in names if isinstance(each, str) and len(each) <= NAME]
    except (TypeError, KeyError) as error:
        raise params.odd_answer(node) from error


def _values_in(node: str, names: Sequence[str], answer: Any) -> dict[str, ParameterValue] | None:
    """Values in an answer of ``get_parameters``; ``None``: there are not as many as names."""
    try:
        values = answer["values"]
        if len(values) != len(names):
            return None
        return {
            name: value for name, value in zip(names, values, strict=True) if _value_of(value) is not None
        }
    except (TypeError, KeyError, Invalid) as error:
        raise params.odd_answer(node) from error


def _bytes_of(value: Any) -> list[int]:
    if isinstance(value, str) and len(value) > 2 * params.MAX_VALUES:
        raise Invalid(f"a byte_array may have {params.MAX_VALUES} bytes")
    try:
        return list(base64.b64decode(value, validate=True))
    except (TypeError, ValueError, binascii.Error):
        raise Invalid("the value of a byte_array must be base64 text") from None
