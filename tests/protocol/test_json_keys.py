"""No JSON object has a key twice, for each method of the check."""

from __future__ import annotations

import json
import random
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import MalformedMessage, SwitchboardError
from relay_protocol.ros_types import TypeRegistry
from tests.worlds.growth import grows_linearly

TYPES = TypeRegistry()
TYPES.add("std_msgs/msg/String", "string data")
KEYS = st.text('xX1:"\\ e{}ß', max_size=2)


def pairs_of(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    """Objects with possible duplicate keys, with any spelling of a key and spaces anywhere."""
    space = st.sampled_from(["", " ", "\n"])
    key = st.builds(spelled, KEYS, st.booleans(), st.randoms(use_true_random=False))
    pair = st.builds("{}{}{}:{}{}".format, space, key, space, space, inner)
    return st.lists(pair, max_size=4).map(lambda pairs: "{" + ",".join(pairs) + "}")


def spelled(key: str, escaped: bool, choice: random.Random) -> str:
    """A key in JSON, with randomly escaped characters."""
    if not escaped:
        return json.dumps(key, ensure_ascii=choice.random() < 0.5)
    return '"' + "".join(f"\\u{ord(each):04x}" for each in key) + '"'


TEXTS = st.recursive(
    st.sampled_from(
        ["null", "true", "1", "-1.5", "2E+9", '""', '":"', '"a\\"b:"', '"\\u003a"', '"x1"', '"1"']
    ),
    lambda inner: pairs_of(inner) | st.lists(inner, max_size=3).map(lambda each: "[" + ", ".join(each) + "]"),
    max_leaves=20,
)


def distinct(text: str) -> bool:
    """Checks by counting the pairs of each object."""
    doubled = []

    def look(pairs: list[tuple[str, Any]]) -> None:
        doubled.append(len(dict(pairs)) != len(pairs))

    json.loads(text, object_pairs_hook=look)
    return not any(doubled)


def accepted(text: str) -> bool:
    """Checks as the relay does."""
    try:
        jsontext.check_keys(text.encode())
    except MalformedMessage as error:
        assert "twice" in str(error)
        return False
    return True


@given(TEXTS, st.sampled_from([0, jsontext.SHORT_BYTES, 40 * jsontext.SHORT_BYTES]))
@example('{"x":1,"\\u0078":2}', 0)
@example('{"x1":1,"x2":2}', 0)
@example('{"a":"\\u003a","b":1,"b":2}', 0)
@example('{"v":"val",":a":1,":a":2}', 0)
@example('{"v":":","w":{}}', 0)
@settings(deadline=None, max_examples=150)
def test_a_text_is_refused_just_when_an_object_has_a_key_twice(text: str, padding: int) -> None:
    """For any length and escapes."""
    padded = f'[{text},"{"y" * padding}"]'
    assert accepted(padded) == distinct(text)


def test_a_key_that_differs_by_a_digit_is_another() -> None:
    assert accepted('{"x1":1,"x2":2}')
    assert not accepted('{"x1":1,"x1":2}')


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "9" * 5000, "1e999"])
def test_numbers_are_not_judged_here(number: str) -> None:
    """Including those that other checks refuse."""
    assert accepted(f'{{"x":{number},"y":1}}')
    assert not accepted(f'{{"x":{number},"x":1}}')


@pytest.mark.parametrize(
    "unit",
    ['{"a":{"x":1,"y":2}}', '"text"', '{"":1}', "0.125", '"\\u0061"', '{"\\u0061":[]}', "[[],[]]", "key"],
)
def test_the_time_grows_with_the_text_and_no_faster(unit: str) -> None:

    def make(count: int) -> bytes:
        units = [f'"{number}":0' for number in range(count)] if unit == "key" else [unit] * count
        text = ",".join(units)
        return (f"{{{text}}}" if unit == "key" else f"[{text}]").encode()

    assert grows_linearly(jsontext.check_keys, make, 80_000)


@given(TEXTS, st.sampled_from([0, 400]))
@example('{"x":1,"\\u0078":2}', 0)
@example('{"x":"\\u003a","y":1,"y":2}', 0)
@settings(deadline=None)
def test_a_text_is_encoded_again_just_when_no_key_comes_twice(text: str, padding: int) -> None:
    padded = f'[{text},"{"y" * padding}"]'
    try:
        again = jsontext.recode(padded.encode())
    except MalformedMessage as error:
        assert "twice" in str(error)
        assert not distinct(text)
    else:
        assert distinct(text)
        assert json.loads(again) == json.loads(padded)


FIELDS = st.sampled_from(
    [
        '"op":"publish"', '"topic":"/a"', '"topic":"/b:c"', '"msg":{"data":"x"}', '"msg":{"data":"a:b"}', '"msg":{}',
        '"msg":""', '"msg":":"', '"msg":1', '"msg":{"data":"x","data":"y"}', '"msg":{"a":{"data":"x"}}', '"type":""',
        '"type":"a/B"', '"id":"q"', '"id":null', '"id":7', '"latch":false', '"more":{"data":"x"}', '"more":{"op":"x"}',
        '"m\\u0073g":{"data":"x"}', '"msg":{"data":"\\"}}"}', '"msg":{"data":"long"}', '"msg": {"data" :"x"}',
        '"qos":null', '"more":1',
    ]
)  # fmt: skip


@given(st.permutations(['"op":"publish"', '"topic":"/a"']), st.lists(FIELDS, max_size=5), st.booleans())
@settings(deadline=None, max_examples=250)
def test_of_equal_keys_of_a_publish_the_last_counts(needed: list[str], fields: list[str], long: bool) -> None:
    """For any other content, and any length of a string. It is what the parser of the standard library reads."""
    text = "{" + ",".join(needed + fields) + "}"
    if long:
        text = text.replace("long", "x" * 5000)
    try:
        message = rosbridge.decode(text.encode())
    except MalformedMessage:
        return
    assert isinstance(message, rosbridge.Publish)
    read = {"msg": {}, **json.loads(text)}
    assert (message.topic, message.id, json.loads(bytes(message.msg))) == (
        read["topic"],
        read.get("id"),
        read["msg"],
    )


BODIES = pairs_of(TEXTS) | st.sampled_from(
    [
        '{"data":"x","data":"y"}', '{"data":"x","dat\\u0061":":"}', '{"data":"x","data":1}', '{"data":1,"data":"y"}',
        '{"data":"\\u0000","data":"y"}', '{"data":"y","data":"\\u0000"}', '{"data":"%s","data":"y"}' % ("x" * 9000),
    ]
)  # fmt: skip


@given(BODIES)
@settings(deadline=None, max_examples=250)
def test_a_robot_of_json_gets_no_key_twice(body: str) -> None:
    """It gets what the relay has read: the last of two, or nothing."""
    check = TYPES.check("std_msgs/msg/String")
    try:
        sent = check(body.encode())
    except SwitchboardError:
        return
    assert distinct(sent.decode())
    assert json.loads(sent) == {"data": "", **json.loads(body)}


REPEATED = {
    "op": '{"op":"unsubscribe","topic":"/a","op":"unsubscribe"}',
    "another op": '{"op":"unsubscribe","topic":"/a","op":"subscribe"}',
    "with an escape": '{"op":"unsubscribe","topic":"/a","\\u0074opic":"/b"}',
    "unknown": '{"op":"unsubscribe","topic":"/a","colour":1,"colour":1}',
    "deep in a list": '{"op":"call_service","service":"/a","args":[[{"y":{"x":[1],"x":[2]}}]]}',
    "beside null": '{"op":"subscribe","topic":"/a","type":null,"type":"std_msgs/String"}',
}


@pytest.mark.parametrize("name", REPEATED)
def test_a_client_message_with_a_key_twice_is_refused(name: str) -> None:
    """Also in an unused field, and in arguments."""
    with pytest.raises(MalformedMessage, match="twice"):
        rosbridge.decode(REPEATED[name].encode())


def test_the_key_is_named() -> None:
    """If it is short."""
    with pytest.raises(MalformedMessage, match=r"the key 'ranges' twice in one object; send each key once"):
        jsontext.decode_any(b'{"ranges":1,"ranges":2}')
    with pytest.raises(MalformedMessage, match=r"'x{37}\.\.\.' twice"):
        jsontext.decode_any(b'{"%s":1,"%s":2}' % (b"x" * 1000, b"x" * 1000))
