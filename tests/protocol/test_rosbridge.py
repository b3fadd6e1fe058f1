"""rosbridge operations of clients."""

from __future__ import annotations

import json

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relay_protocol import limits, rosbridge
from relay_protocol.errors import MalformedMessage


def test_a_publish_keeps_its_body_undecoded() -> None:
    """The body is the client's own text, byte for byte."""
    message = rosbridge.decode(b'{"op":"publish","topic":"/a","msg":{"x" : 1.50}}')
    assert isinstance(message, rosbridge.Publish)
    assert bytes(message.msg) == b'{"x" : 1.50}'


@pytest.mark.parametrize(("text", "wanted"), [('"a"', "a"), ("7", 7), ("null", None)])
def test_ids_are_strings_numbers_or_none(text: str, wanted: object) -> None:
    """Clients may number their calls."""
    message = rosbridge.decode(f'{{"op":"unsubscribe","topic":"/a","id":{text}}}'.encode())
    assert isinstance(message, rosbridge.Unsubscribe)
    assert message.id == wanted


def test_arguments_may_be_a_list_or_an_object() -> None:
    """Both of rosbridge's forms are passed on undecoded."""
    for args in (b"[1,2]", b'{"a":1}'):
        message = rosbridge.decode(b'{"op":"call_service","service":"/s","args":' + args + b"}")
        assert isinstance(message, rosbridge.CallService)
        assert isinstance(message.args, msgspec.Raw)
        assert bytes(message.args) == args


def test_absent_arguments_are_distinguished_from_null() -> None:
    """Missing arguments are falsy; null is a text like any other."""
    absent = rosbridge.decode(b'{"op":"call_service","service":"/s"}')
    null = rosbridge.decode(b'{"op":"call_service","service":"/s","args":null}')
    assert isinstance(absent, rosbridge.CallService)
    assert isinstance(null, rosbridge.CallService)
    assert not absent.args
    assert isinstance(null.args, msgspec.Raw)
    assert bytes(null.args) == b"null"


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ('{"op":"subscribe","topic":"/a","type":"p/T","throttle_rate":null,"queue_length":null,"compression":null}',
         rosbridge.Subscribe(topic="/a", type="p/T")),
        ('{"op":"advertise","topic":"/a","type":"p/T","latch":null,"queue_size":null,"qos":null,"id":null}',
         rosbridge.Advertise(topic="/a", type="p/T")),
        ('{"op":"call_service","service":"/s","id":"1","type":null,"compression":null,"fragment_size":null}',
         rosbridge.CallService(service="/s", id="1")),
        ('{"op":"send_action_goal","action":"/f","id":2,"feedback":null,"action_type":null}',
         rosbridge.SendActionGoal(action="/f", id=2)),
    ],
)  # fmt: skip
def test_a_field_that_is_null_counts_as_left_out(text: str, plain: object) -> None:
    """Many JSON libraries write unset fields as null; such a call must not be lost."""
    assert rosbridge.decode(text.encode()) == plain


def test_a_null_beside_other_fields_keeps_the_body_as_it_came() -> None:
    """The body is still the client's own text, and a null body stays one."""
    message = rosbridge.decode(b'{"op":"publish","topic":"/a","latch":null,"msg":{"x" : 1.50}}')
    assert isinstance(message, rosbridge.Publish)
    assert bytes(message.msg) == b'{"x" : 1.50}'
    message = rosbridge.decode(b'{"op":"publish","topic":"/a","latch":null,"msg":null}')
    assert isinstance(message, rosbridge.Publish)
    assert bytes(message.msg) == b"null"


@pytest.mark.parametrize(
    "text",
    [
        '{"op":"subscribe","topic":null}',
        '{"op":null,"topic":"/a"}',
        '{"op":"subscribe","topic":"/a","throttle_rate":null,"queue_length":"a"}',
    ],
)
def test_a_null_hides_no_other_fault(text: str) -> None:
    """Missing fields and wrong types are reported as usual."""
    with pytest.raises(MalformedMessage):
        rosbridge.decode(text.encode())


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ('{"op":"subscribe","topic":"/a","queue_length":2.0,"fragment_size":1e3,"id":7.0,"type":null}',
         rosbridge.Subscribe(topic="/a", queue_length=2, fragment_size=1000, id=7)),
        ('{"op":"advertise","topic":"/a","type":"p/T","queue_size":10.0}',
         rosbridge.Advertise(topic="/a", type="p/T", queue_size=10)),
        ('{"op":"fragment","id":"f","data":"{}","num":0.0,"total":1.0}',
         rosbridge.Fragment(id="f", data="{}", num=0, total=1)),
        ('{"op":"action_result","action":"/f","id":"1","status":4.0}',
         rosbridge.ActionResult(action="/f", id="1", status=4)),
    ],
)  # fmt: skip
def test_integers_may_be_written_with_a_point(text: str, plain: object) -> None:
    """Some languages have no other numbers."""
    assert rosbridge.decode(text.encode()) == plain


def test_a_point_beside_other_fields_keeps_the_body_as_it_came() -> None:
    """Numbers in the body are checked by the type."""
    message = rosbridge.decode(b'{"op":"publish","topic":"/a","queue_size":1.0,"msg":{"id" : 2.0}}')
    assert isinstance(message, rosbridge.Publish)
    assert (message.queue_size, bytes(message.msg)) == (1, b'{"id" : 2.0}')


@pytest.mark.parametrize("number", ["2.5", "1e300", "-0.5", '"2.0"', "true"])
def test_non_integer_is_refused(number: str) -> None:
    """Numbers are not rounded, and a text is not a number."""
    with pytest.raises(MalformedMessage, match="queue_length"):
        rosbridge.decode(f'{{"op":"subscribe","topic":"/a","queue_length":{number}}}'.encode())


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ('{"op":"call_service","service":"/s","id":"1","timeout":"x"}', rosbridge.CallService(service="/s", id="1")),
        ('{"op":"call_service","service":"/s","id":3.0,"type":5}', rosbridge.CallService(service="/s", id=3)),
        ('{"op":"call_service","service":"/s","id":[1]}', rosbridge.CallService(service="/s")),
        ('{"op":"call_service","id":"1"}', rosbridge.CallService(service="", id="1")),
        ('{"op":"send_action_goal","action":"/f","id":2,"feedback":"yes"}',
         rosbridge.SendActionGoal(action="/f", id=2)),
        ('{"op":"send_action_goal","action":7,"id":"g"}', rosbridge.SendActionGoal(action="", id="g")),
        ('{"op":"call_service","id":true}', None),
        ('{"op":"call_service"}', None),
        ('{"op":"subscribe","topic":5,"id":"1","service":"/s"}', None),
        ('{"op":["call_service"],"service":"/s"}', None),
        ('{"op":"call_service","service":"/s","id":"1"', None),
        ('["call_service"]', None),
        ('', None),
    ],
)  # fmt: skip
def test_pending_request_is_found_in_malformed_bytes(text: str, wanted: object) -> None:
    """A call or a goal is recognised by its op, with its name or its id."""
    with pytest.raises(MalformedMessage):
        rosbridge.decode(text.encode())
    assert rosbridge.unreadable(text.encode()).request == wanted


@pytest.mark.parametrize("args", [b"[" * 200 + b"]" * 200, b'"\xff"'])
def test_pending_request_is_found_beside_a_refused_body(args: bytes) -> None:
    """Too deep, or not UTF-8: the other fields can still be read."""
    text = b'{"op":"call_service","id":"1","service":"/s","args":' + args + b"}"
    with pytest.raises(MalformedMessage):
        rosbridge.decode(text)
    assert rosbridge.unreadable(text) == ("1", rosbridge.CallService(service="/s", id="1"))


@given(st.binary(max_size=60) | st.text(max_size=60).map(str.encode))
def test_junk_needs_no_answer(data: bytes) -> None:
    """For any bytes the search does not fail."""
    assert rosbridge.unreadable(data) == (None, None)


def test_error_for_an_unknown_op_lists_the_known_ones() -> None:
    """The error has the op and the known ones."""
    with pytest.raises(
        MalformedMessage, match=r"unknown op 'subscrbe'; known are action_feedback, .*unsubscribe"
    ):
        rosbridge.decode(b'{"op":"subscrbe","topic":"/a"}')


def test_two_ops_are_refused_as_such() -> None:
    """A message with op twice does not count as an unknown one."""
    with pytest.raises(MalformedMessage, match="'op' twice"):
        rosbridge.decode(b'{"op":"subscribe","op":"publish","topic":"/a"}')


@given(st.binary(max_size=60) | st.text(max_size=60).map(str.encode))
def test_junk_raises_nothing_but_malformed(data: bytes) -> None:
    """Any bytes are an operation or this error."""
    with pytest.raises(MalformedMessage):
        rosbridge.decode(data)


@given(st.text(max_size=20), st.none() | st.integers(-(2**53), 2**53) | st.text(max_size=5), st.booleans())
def test_relay_sends_json(text: str, ident: rosbridge.Id, result: bool) -> None:
    """Messages to clients are joined from parts and are valid JSON."""
    publish = json.loads(rosbridge.publish(text, b'{"a":1}'))
    assert publish == {"op": "publish", "topic": text, "msg": {"a": 1}}
    response = json.loads(rosbridge.service_response(text, ident, result, msgspec.json.encode(text)))
    wanted = {"op": "service_response", "service": text, "result": result, "values": text}
    assert response == (wanted if ident is None else {**wanted, "id": ident})
    status = json.loads(rosbridge.status("error", text, ident))
    assert status["level"] == "error"
    assert status["msg"] == text
    assert status.get("id") == ident


@pytest.mark.parametrize("extra", [0, 1, 2, 60])
def test_objects_in_each_other_are_counted_however_short(extra: int) -> None:
    """The shortest text of each depth: the maximum depth is accepted, one more is refused."""
    inner = limits.JSON_DEPTH - 2 + extra
    text = b'{"op":"publish","topic":"t","msg":' + b'{"":' * inner + b"{}" + b"}" * inner + b"}"
    if extra == 0:
        assert isinstance(rosbridge.decode(text), rosbridge.Publish)
    else:
        with pytest.raises(MalformedMessage, match="deeper than"):
            rosbridge.decode(text)
