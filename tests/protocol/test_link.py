"""JSON messages of the robot link."""

from __future__ import annotations

import types
import typing
from typing import Any

import msgspec
import pytest
from hypothesis import given, reject
from hypothesis import strategies as st

from relay_protocol import frames, jsontext, limits, link
from relay_protocol.errors import Invalid, MalformedMessage

DECODERS = {
    name: decoder for name, decoder in vars(link).items() if isinstance(decoder, msgspec.json.Decoder)
}
MESSAGES = [
    (name, message) for name, decoder in DECODERS.items() for message in typing.get_args(decoder.type)
]
TEXT = st.text(max_size=8)


def values(kind: Any) -> st.SearchStrategy[Any]:
    """Values of one annotation."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        (meta,) = arguments[1:]
        if meta.pattern is not None:
            return st.from_regex(meta.pattern)
        if meta.gt is not None:
            return st.floats(meta.gt, meta.le, exclude_min=True)
        if meta.ge is None:
            return values(arguments[0])
        return (st.integers if arguments[0] is int else st.floats)(meta.ge, meta.le)
    if origin is typing.Literal:
        return st.sampled_from(arguments)
    if origin is tuple:
        return st.tuples(*map(values, arguments))
    if origin in (typing.Union, types.UnionType):
        return st.one_of(*map(values, arguments))
    if origin is list:
        return st.lists(values(arguments[0]), max_size=3)
    if origin is dict:
        return st.dictionaries(TEXT, values(arguments[1]), max_size=3)
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return structs(kind)
    return {
        str: TEXT,
        int: st.integers(-(2**63), 2**63 - 1),
        bool: st.booleans(),
        float: st.floats(allow_nan=False, allow_infinity=False),
        type(None): st.none(),
        msgspec.UnsetType: st.just(msgspec.UNSET),
        Any: st.none() | st.booleans() | TEXT,
        msgspec.Raw: st.sampled_from([b"{}", b'{"a":1}', b"[1,2]"]).map(msgspec.Raw),
    }[kind]


def structs(kind: type[msgspec.Struct]) -> st.SearchStrategy[Any]:
    """Messages of one type with any fields."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return st.fixed_dictionaries({name: values(hints[name]) for name in kind.__struct_fields__}).map(
        lambda fields: _made(kind, fields)
    )


def _made(kind: type[msgspec.Struct], fields: dict[str, Any]) -> Any:
    try:
        return kind(**fields)
    except ValueError:  # a rule for the whole message, such as the minimum time of a suppression
        reject()


def comparable(value: Any) -> Any:
    """Raw values compare by identity; their text compares by content."""
    if isinstance(value, msgspec.Raw):
        return bytes(value)
    if isinstance(value, msgspec.Struct):
        return type(value), {name: comparable(getattr(value, name)) for name in value.__struct_fields__}
    return value


@given(st.sampled_from(MESSAGES), st.data())
def test_every_message_survives_the_wire(case: tuple[str, type[msgspec.Struct]], data: st.DataObject) -> None:
    """Each message of each link is encoded, framed, split and decoded unchanged."""
    decoder, message = case
    sent = data.draw(structs(message))
    (frame,) = frames.FrameDecoder(limit=100_000).feed(link.frame(sent))
    assert isinstance(frame, frames.JsonFrame)
    assert comparable(jsontext.decode(DECODERS[decoder], frame.body)) == comparable(sent)


@given(st.sampled_from(sorted(DECODERS)), st.binary(max_size=60) | st.text(max_size=60).map(str.encode))
def test_junk_raises_nothing_but_malformed(decoder: str, data: bytes) -> None:
    """Any bytes are a message or this error."""
    with pytest.raises(MalformedMessage):
        jsontext.decode(DECODERS[decoder], data)


def test_tags_are_the_snake_case_names() -> None:
    """The op of a message follows from its class name."""
    tags = {message.__struct_config__.tag for _, message in MESSAGES}
    assert {"open_channel", "call_service", "type_definition", "hello"} <= tags


def test_defaults_are_left_out() -> None:
    """Only other values are written."""
    assert (
        jsontext.encode(link.Subscribe(number=1, topic="/a")) == b'{"op":"subscribe","number":1,"topic":"/a"}'
    )


def test_unknown_fields_are_passed_over() -> None:
    """A newer peer may send more fields."""
    message = jsontext.decode(link.relay_control_decoder, b'{"op":"bye","reason":"x","later":[1]}')
    assert message == link.Bye(reason="x")


def test_error_for_an_unknown_op_lists_the_known_ones() -> None:
    """The error lists the ones valid here."""
    with pytest.raises(MalformedMessage) as caught:
        jsontext.decode(link.relay_control_decoder, b'{"op":"subscribe","number":1,"topic":"/a"}')
    known = (
        "bye, close_channel, close_video, control_grant, inhibit, measure_processes, open_channel, open_file_link, "
        "open_video, order_module, ping, pong, read_module_log, resume, stop, suppress"
    )
    assert str(caught.value) == f"unknown op 'subscribe'; known are {known}"


def test_a_long_unknown_op_is_cut_short() -> None:
    """Text of a peer must not fill the log."""
    with pytest.raises(MalformedMessage) as caught:
        jsontext.decode(link.handshake_request_decoder, b'{"op":"' + b"x" * 10_000 + b'"}')
    assert len(str(caught.value)) < 120


def test_a_missing_field_is_named() -> None:
    """The error says what is missing."""
    with pytest.raises(MalformedMessage, match="missing required field `nonce`"):
        jsontext.decode(link.handshake_reply_decoder, b'{"op":"challenge","relay":"r"}')


@given(st.binary(max_size=40))
def test_base64_fields_survive(data: bytes) -> None:
    """Bytes in a JSON field are returned unchanged."""
    assert link.from_base64(link.to_base64(data), "x") == data


@pytest.mark.parametrize("text", ["a", "ab=c", "####", "YQ", "ß", "YQ==\n"])
def test_invalid_base64_is_refused_by_name(text: str) -> None:
    """The error names the field."""
    with pytest.raises(Invalid, match="nonce is not base64"):
        link.from_base64(text, "nonce")


LONG = "x" * (limits.LABEL_LENGTH + 1)
MANY = ["x"] * (limits.GRAPH_NODES + 1)


@pytest.mark.parametrize(
    "message",
    [
        {"op": "describe", "host": LONG},
        {"op": "describe", "extra": {LONG: ""}},
        {"op": "describe", "extra": {"a": LONG}},
        {"op": "describe", "extra": {str(number): "" for number in range(limits.LIST_ITEMS + 1)}},
        {"op": "describe", "motion": {"types": ["x"] * (limits.LIST_ITEMS + 1)}},
        {"op": "describe", "motion": {"topics": [LONG]}},
        {"op": "graph", "topics": {LONG: {"types": []}}},
        {"op": "graph", "topics": {"/a": {"types": [], "publishers": MANY}}},
        {"op": "graph", "services": {"/a": {"types": [LONG]}}},
        {"op": "graph", "nodes": {LONG: {}}},
        {"op": "alert", "level": LONG, "text": ""},
    ],
    ids=lambda message: "-".join(message),
)
def test_description_of_a_robot_is_bounded(message: dict[str, Any]) -> None:
    """Fields and lists have the contract's limits."""
    with pytest.raises(MalformedMessage, match="length <="):
        jsontext.decode(link.robot_control_decoder, jsontext.encode(message))


def test_a_definition_is_bounded() -> None:
    """A text over the limit is refused."""
    message = {"op": "type_definition", "type": "a/msg/B", "text": "#" * (limits.TYPE_DEFINITION + 1)}
    with pytest.raises(MalformedMessage, match="length <="):
        jsontext.decode(link.robot_channel_decoder, jsontext.encode(message))


@pytest.mark.parametrize(
    ("kind", "field", "fields"),
    [
        (link.Bye, "reason", {}),
        (link.Alert, "text", {"level": "info"}),
        (link.Failed, "reason", {"request": "subscribe", "reference": "1"}),
        (link.ServiceResponse, "reason", {"id": "1", "result": False}),
    ],
)
def test_texts_are_cut(kind: Any, field: str, fields: dict[str, Any]) -> None:
    """In both directions: a long text ends no link."""
    long = "x" * (limits.TEXT_LENGTH + 1)
    assert len(getattr(kind(**fields, **{field: long}), field)) == limits.TEXT_LENGTH
    body = jsontext.encode({"op": link.lower_tag(kind.__name__), **fields, field: long})
    decoder = link.robot_control_decoder if kind is link.Alert else link.robot_channel_decoder
    assert getattr(jsontext.decode(decoder, body), field) == "x" * (limits.TEXT_LENGTH - 1) + "…"


@pytest.mark.parametrize(
    ("service", "moves"),
    [
        ("/reset", True),
        ("/resets", False),
        ("/dock/_action/send_goal", True),
        ("/dock/_action/get_result", False),
        ("/undock/_action/send_goal", False),
        ("/dock/_action/send_goal/x", False),
    ],
)
def test_a_service_that_accepts_goals_moves_the_robot_as_its_action_does(service: str, moves: bool) -> None:
    policy = link.MotionPolicy(services=["/reset"], actions=["/dock"])
    assert policy.moves_by_service(service) is moves
