"""rosbridge v2 operations a client may send, as one tagged union (SPEC 1).

Message bodies stay undecoded (:class:`msgspec.Raw`): the relay decodes only what it judges, and the body
once, when its type is known.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

import msgspec
from msgspec import UNSET

from relay_protocol import json_cost, jsontext, nonfinite
from relay_protocol.limits import JSON_DEPTH, KIB
from relay_protocol.link import Thinning
from relay_protocol.message import Body, Message
from relay_protocol.qos import QoS

Id = str | int | None
"""rosbridge says a string; some clients number their calls."""

Bodies = list[msgspec.Raw] | dict[str, msgspec.Raw]


class Op(Message, frozen=True, kw_only=True, gc=False):
    """Base of what a client may ask; the ``id`` comes back with answers."""

    id: Id = None


class Advertise(Op, frozen=True, kw_only=True):
    topic: str
    type: str
    latch: bool = False
    queue_size: int = 100
    qos: QoS | None = None


class Unadvertise(Op, frozen=True, kw_only=True):
    topic: str


class Publish(Op, frozen=True, kw_only=True):
    topic: str
    msg: msgspec.Raw = msgspec.Raw(b"{}")
    latch: bool = False
    queue_size: int = 100
    qos: QoS | None = None
    type: str = ""


class Subscribe(Op, frozen=True, kw_only=True):
    topic: str
    type: str | None = None
    throttle_rate: float = 0
    queue_length: int = 0
    fragment_size: int | None = None
    compression: str = "none"
    qos: QoS | None = None
    thin: Thinning | None = None


class Unsubscribe(Op, frozen=True, kw_only=True):
    topic: str


class CallService(Op, frozen=True, kw_only=True):
    service: str
    args: Body = msgspec.UNSET
    type: str = ""
    fragment_size: int | None = None
    compression: str = "none"
    timeout: float | None = None


class ServiceResponse(Op, frozen=True, kw_only=True):
    service: str
    result: bool = True
    values: Body = msgspec.UNSET


class AdvertiseService(Op, frozen=True, kw_only=True):
    service: str
    type: str


class UnadvertiseService(Op, frozen=True, kw_only=True):
    service: str


class AdvertiseAction(Op, frozen=True, kw_only=True):
    action: str
    type: str


class UnadvertiseAction(Op, frozen=True, kw_only=True):
    action: str


class SendActionGoal(Op, frozen=True, kw_only=True):
    """:param feedback: whether ``action_feedback`` is wanted"""

    action: str
    action_type: str = ""
    args: Body = msgspec.UNSET
    feedback: bool = False
    fragment_size: int | None = None
    compression: str = "none"


class CancelActionGoal(Op, frozen=True, kw_only=True):
    action: str


class ActionFeedback(Op, frozen=True, kw_only=True):
    """From a client that offers the action."""

    action: str
    values: Body = msgspec.UNSET


class ActionResult(Op, frozen=True, kw_only=True):
    """From a client that offers the action; ``status`` is of ``action_msgs/msg/GoalStatus``."""

    action: str
    status: int | None = None
    result: bool = True
    values: Body = msgspec.UNSET


class Fragment(Message, frozen=True, kw_only=True):
    """A part of the text of one message; ``num`` counts from 0 to ``total`` - 1."""

    id: str | int
    data: str
    num: int
    total: int


class SetLevel(Op, frozen=True, kw_only=True):
    level: str


class Auth(Op, frozen=True, kw_only=True):
    """rosauth's message; ``mac`` carries the access token, the rest is taken and not used."""

    mac: str
    client: Any = None
    dest: Any = None
    rand: Any = None
    t: Any = None
    level: Any = None
    end: Any = None


ClientOp = (
    Advertise
    | Unadvertise
    | Publish
    | Subscribe
    | Unsubscribe
    | CallService
    | ServiceResponse
    | AdvertiseService
    | UnadvertiseService
    | AdvertiseAction
    | UnadvertiseAction
    | SendActionGoal
    | CancelActionGoal
    | ActionFeedback
    | ActionResult
    | Fragment
    | SetLevel
    | Auth
)

_LIST = ord("[")
_FEW_LISTS = 16
_SHALLOW = 5 * (JSON_DEPTH - _FEW_LISTS)
"""A shorter text with few lists is not nested too deeply: an object in another takes at least five bytes, ``{"":`` and
``}``."""

_TOLERATED_FAULTS = ("got `null`", "got `float`")
"""Parts of msgspec's errors about a field that is null, or no integer: decoding is tried again without these."""

_BODIES = frozenset(("msg", "args", "values"))
"""Fields of which null is a valid value."""

_INTEGERS = frozenset(("id", "queue_size", "queue_length", "fragment_size", "num", "total", "status"))
_EXACT = 2**53
"""Largest integer up to which all are exact as a double."""

_decode: Callable[[bytes], ClientOp] = msgspec.json.Decoder(ClientOp).decode


def decode(data: bytes) -> ClientOp:
    """One client message. NaN and infinity in its body are marked, see :mod:`relay_protocol.nonfinite`.

    In a ``publish`` the last of two equal keys counts. The robot gets what was read here, so it reads nothing else.

    :raises MalformedMessage: not strict JSON, a key twice, an unknown ``op``, a field missing or of the wrong type
    :raises NotFinite: NaN or infinity outside of the body
    :raises TooCostly: see :func:`relay_protocol.json_cost.check`; with NaN or infinity
        :func:`relay_protocol.json_cost.check_literals`
    """
    # The checks of jsontext.decode, with fewer calls, as this runs for every message of every client. A short text
    # needs no check of cost, and with few lists none of nesting: it is too short to be nested too deeply.
    if len(data) > _SHALLOW or (_LIST in data and data.count(_LIST) > _FEW_LISTS):
        json_cost.check(data)
        jsontext.check_text(data)
    elif not data.isascii():
        jsontext.check_utf8(data)
    try:
        message = _decode(data)
    except jsontext.FAULTS as error:
        message = _decode_leniently(data, error)
    if type(message) is not Publish:
        jsontext.check_keys(data)
    return message


def _decode_leniently(data: bytes, fault: Exception) -> ClientOp:
    if nonfinite.may_hold_literals(data):
        marked = nonfinite.mark_fields(data, _BODIES)
        if marked is not None:
            data = marked
            try:
                return _decode(data)
            except jsontext.FAULTS as error:
                fault = error
    if any(words in str(fault) for words in _TOLERATED_FAULTS):
        try:
            return _decode(_without_nulls(data))
        except jsontext.FAULTS as error:
            fault = error
    raise jsontext.malformed(fault, ClientOp) from None


def _without_nulls(data: bytes) -> bytes:
    """The same message without the fields that are null: some clients write null for an omitted field.

    Integers written as ``2.0`` become integers, as some languages have only floating-point numbers.
    """
    fields = msgspec.json.decode(data, type=dict[str, msgspec.Raw])
    kept = {
        name: _integer(each) if name in _INTEGERS else each
        for name, each in fields.items()
        if name in _BODIES or bytes(each) != b"null"
    }
    return msgspec.json.encode(kept)


def _integer(text: msgspec.Raw) -> Any:
    """The integer that a number equals; any other text unchanged."""
    try:
        number = msgspec.json.decode(text, type=float)
    except jsontext.FAULTS:
        return text
    return int(number) if number.is_integer() and abs(number) <= _EXACT else text


class _Request(msgspec.Struct, frozen=True):
    """The fields that are read of a message that :func:`decode` refused."""

    op: msgspec.Raw = msgspec.Raw(b"null")
    id: msgspec.Raw = msgspec.Raw(b"null")
    service: msgspec.Raw = msgspec.Raw(b"null")
    action: msgspec.Raw = msgspec.Raw(b"null")


_LONGEST_WORD = 4 * KIB
"""Longest field, in bytes, that is read of a refused message."""


class Unreadable(NamedTuple):
    """What can be read of a message that :func:`decode` refused.

    :param id: as far as it is one
    :param request: the call or goal that a client waits for an answer to, with nothing but its name and ``id``;
        ``None`` for any other op, and without either
    """

    id: Id = None
    request: CallService | SendActionGoal | None = None


def unreadable(data: bytes) -> Unreadable:
    """Read what is possible of a message that :func:`decode` refused; nothing if it is no JSON object."""
    if nonfinite.may_hold_literals(data):
        with suppress(json_cost.TooCostly):
            json_cost.check_literals(data)
            json_cost.check(data)
            data = nonfinite.mark(data)
    try:
        request = msgspec.json.decode(data, type=_Request)
    except jsontext.FAULTS:
        return Unreadable()
    op, id = _word(request.op), _usable(_word(request.id))
    asked = {"call_service": request.service, "send_action_goal": request.action}.get(str(op))
    name = UNSET if asked is None else _word(asked)
    if name is UNSET or (id is None and not isinstance(name, str)):
        return Unreadable(id)
    name = name if isinstance(name, str) else ""
    if op == "call_service":
        return Unreadable(id, CallService(service=name, id=id))
    return Unreadable(id, SendActionGoal(action=name, id=id))


def _word(text: msgspec.Raw) -> Any:
    """A field of a refused message; ``None`` if it is too long to be read."""
    return msgspec.json.decode(text) if len(bytes(text)) <= _LONGEST_WORD else None


def _usable(id: Any) -> Id:
    if isinstance(id, float) and id.is_integer() and abs(id) <= _EXACT:
        return int(id)
    if isinstance(id, bool) or not isinstance(id, (str, int)) or id in nonfinite.NUMBERS:
        return None
    return id


def publish(topic: str, body: bytes) -> bytes:
    """A ``publish`` towards a client, around a body that is JSON already."""
    return publish_head(topic) + body + b"}"


def publish_head(topic: str) -> bytes:
    """What comes before the body in :func:`publish`; behind it comes a brace."""
    return b'{"op":"publish","topic":' + jsontext.encode(topic) + b',"msg":'


def service_response(service: str, id: Id, result: bool, values: bytes) -> bytes:
    """A ``service_response`` towards a client; ``values`` is JSON, a string when ``result`` is false."""
    return _object("service_response", service=service, id=id) + _result(result, values)


def call_service(service: str, id: str, args: bytes) -> bytes:
    """A ``call_service`` towards the client that offers the service; ``args`` is JSON."""
    return _object("call_service", service=service, id=id) + b',"args":' + args + b"}"


def send_action_goal(action: str, id: str, type_name: str, args: bytes, feedback: bool) -> bytes:
    """A ``send_action_goal`` towards the client that offers the action; ``args`` is JSON."""
    head = _object("send_action_goal", action=action, id=id, action_type=type_name)
    return head + b',"args":' + args + b',"feedback":' + _truth(feedback) + b"}"


def cancel_action_goal(action: str, id: str) -> bytes:
    """A ``cancel_action_goal`` towards the client that pursues the goal."""
    return _object("cancel_action_goal", action=action, id=id) + b"}"


def action_feedback(action: str, id: Id, values: bytes) -> bytes:
    """An ``action_feedback`` towards the client that sent the goal; ``values`` is JSON."""
    return _object("action_feedback", action=action, id=id) + b',"values":' + values + b"}"


def action_result(action: str, id: Id, status: int, result: bool, values: bytes) -> bytes:
    """The ``action_result`` towards the client that sent the goal; ``values`` is JSON, a string on failure."""
    return _object("action_result", action=action, id=id, status=status) + _result(result, values)


def _object(op: str, **fields: Any) -> bytes:
    """An object without its closing brace; fields that are ``None`` are left out."""
    return jsontext.encode({"op": op, **{name: each for name, each in fields.items() if each is not None}})[
        :-1
    ]


def _result(result: bool, values: bytes) -> bytes:
    return b',"result":' + _truth(result) + b',"values":' + values + b"}"


def _truth(value: bool) -> bytes:
    return b"true" if value else b"false"


def status(level: str, text: str, id: Id = None) -> bytes:
    """A ``status`` towards a client, for those who asked with ``set_level``."""
    message: dict[str, Any] = {"op": "status", "level": level, "msg": text}
    if id is not None:
        message["id"] = id
    return jsontext.encode(message)
