"""No JSON object has a key twice, for each method of the check."""

from __future__ import annotations

import json
import random
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from relay_protocol import jsontext, rosbridge
from relay_protocol.errors import MalformedMessage
from tests.worlds.growth import grows_linearly

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
    """For any length and escapes, and any number of repetitions."""
    padded = f'[{text},"{"y" * padding}"]'
    assert [accepted(padded) for _ in range(4)] == [distinct(text)] * 4


@given(TEXTS, st.sampled_from("0123456789eE.+-"))
@settings(deadline=None)
def test_other_numbers_make_no_difference(text: str, character: str) -> None:
    """An accepted text does not make another one accepted that differs in digits, in keys too."""
    accepted(text), accepted(text), accepted(text)
    other = text.replace("1", character)
    try:
        expected = distinct(other)
    except ValueError:
        return
    assert accepted(other) is expected


def test_a_key_that_differs_by_a_digit_is_another() -> None:
    """Both before and after the structure is cached."""
    for _ in range(4):
        assert accepted('{"x1":1,"x2":2}')
        assert not accepted('{"x1":1,"x1":2}')
        assert accepted('{"x":1,"y":2}')
        assert not accepted('{"x":1,"x":2}')


def test_shapes_that_are_kept_are_bounded() -> None:
    """Texts that are never repeated cannot fill the memory."""
    for number in range(3 * jsontext.SHAPES):
        name = "".join(chr(ord("a") + int(digit)) for digit in str(number))
        for _ in range(3):
            assert accepted(f'{{"{name}":1}}')
    assert len(jsontext._seen_shapes) <= jsontext.SHAPES
    assert len(jsontext.proved_shapes) <= jsontext.SHAPES


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


ENDS = st.sampled_from(["}", "}", "} ", "\n}", "}\n"])


@given(st.permutations(['"op":"publish"', '"topic":"/a"']), st.lists(FIELDS, max_size=5), st.booleans(), ENDS)
@example(['"op":"publish"', '"topic":"/a"'], ['"more":{"op":"x"}'], False, "}")
@example(['"op":"publish"', '"topic":"/a"'], ['"topic":"/a"', '"msg":{"data":"x"}'], True, "}")
@example(['"op":"publish"', '"topic":"/a"'], ['"topic":"/a"', '"msg":""'], False, "}\n")
@example(['"op":"publish"', '"topic":"/a"'], ['"topic":"/a"', '"msg":"x"'], False, "}\n")
@settings(deadline=None, max_examples=250)
def test_a_message_whose_body_ends_with_a_string_has_each_key_once(
    needed: list[str], fields: list[str], long: bool, end: str
) -> None:
    """For any other content, and any length of the string."""
    text = "{" + ",".join(needed + fields) + end
    if long:
        text = text.replace("long", "x" * 5000)
    try:
        rosbridge.decode(text.encode())
    except MalformedMessage as error:
        if "twice" in str(error):
            assert not distinct(text)
        return
    assert distinct(text)


REPEATED = {
    "op": '{"op":"unsubscribe","topic":"/a","op":"unsubscribe"}',
    "another op": '{"op":"unsubscribe","topic":"/a","op":"subscribe"}',
    "topic": '{"op":"publish","topic":"/a","topic":"/b","msg":{}}',
    "with an escape": '{"op":"unsubscribe","topic":"/a","\\u0074opic":"/b"}',
    "unknown": '{"op":"unsubscribe","topic":"/a","colour":1,"colour":1}',
    "msg": '{"op":"publish","topic":"/a","msg":{},"msg":{"x":1}}',
    "in msg": '{"op":"publish","topic":"/a","msg":{"x":1,"x":1}}',
    "in a msg of text": '{"op":"publish","topic":"/a","msg":{"data":"x","data":"y"}}',
    "beside a text": '{"op":"publish","topic":"/a","topic":"/b","msg":{"data":"x"}}',
    "beside a text with a colon": '{"op":"publish","topic":"/a","topic":"/b","msg":":"}',
    "with an empty type": '{"op":"publish","topic":"/a","type":"","type":"","msg":{"data":"x"}}',
    "deep in a list": '{"op":"call_service","service":"/a","args":[[{"y":{"x":[1],"x":[2]}}]]}',
    "beside null": '{"op":"subscribe","topic":"/a","type":null,"type":"std_msgs/String"}',
    "a long text": '{"op":"publish","topic":"/a","topic":"/b","msg":{"data":"%s"}}' % ("x" * 10_000),
    "an id beside a text": '{"op":"publish","id":"1","id":"2","topic":"/a","msg":{"data":"x"}}',
    "long": '{"op":"publish","topic":"/a","msg":{"data":"%s","data":""}}' % ("x" * 10_000),
}


@pytest.mark.parametrize("name", REPEATED)
def test_a_client_message_with_a_key_twice_is_refused(name: str) -> None:
    """Also in an unused field, and in the body."""
    with pytest.raises(MalformedMessage, match="twice"):
        rosbridge.decode(REPEATED[name].encode())


def test_the_key_is_named() -> None:
    """If it is short."""
    with pytest.raises(MalformedMessage, match=r"the key 'ranges' twice in one object; send each key once"):
        jsontext.decode_any(b'{"ranges":1,"ranges":2}')
    with pytest.raises(MalformedMessage, match=r"'x{37}\.\.\.' twice"):
        jsontext.decode_any(b'{"%s":1,"%s":2}' % (b"x" * 1000, b"x" * 1000))
