"""Values of functions that are malformed or too large."""

from __future__ import annotations

import io
import threading
from typing import Any

import msgspec
import numpy as np
import pytest

from relay_protocol.errors import Invalid
from relay_protocol.functions import (
    CallFailed,
    CostlyResult,
    FunctionRegistry,
    array_bytes,
    decode_value,
    encode_value,
    function,
    read_array,
    to_json,
)


def npy(header: str) -> bytes:
    """A file with this header."""
    text = header.encode("latin1")
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


@pytest.mark.parametrize(
    "data",
    [
        npy("{'descr': '<f8', 'fortran_order': False, 'shape': (-1, -1)}\n") + bytes(8),
        npy("{'descr': '|V0', 'fortran_order': False, 'shape': (1,)}\n"),
        npy("{'descr': [('a',)], 'fortran_order': False, 'shape': (1,)}\n"),
        npy("{'descr': {1: 2}, 'fortran_order': False, 'shape': ()}\n"),
        npy("(" * 3000 + "\n"),
        npy("{'descr': '<f8'\n"),
        b"\x93NUMPY\x01",
        b"",
    ],
)
def test_a_malformed_array_is_invalid(data: bytes) -> None:
    with pytest.raises(Invalid):
        read_array(data)


@pytest.mark.parametrize("body", [b"\xa2\xff\xfe", b"\x91" * 100_000, b"\xc1", b"\x81\x80\x01"])
def test_malformed_messagepack_is_invalid(body: bytes) -> None:
    with pytest.raises(Invalid):
        decode_value(body)
    with pytest.raises(Invalid):
        to_json(body)


@function()
def cyclic() -> Any:
    """A list that holds itself."""
    found: list[Any] = []
    found.append(found)
    return found


@function()
def lone_surrogate() -> str:
    """A text that is not Unicode."""
    return "\ud800"


@pytest.mark.parametrize("name", ["cyclic", "lone_surrogate"])
def test_a_result_that_can_not_be_sent_is_refused_with_a_reason(name: str) -> None:
    registry = FunctionRegistry()
    registry.add(cyclic, lone_surrogate)
    with pytest.raises(CallFailed, match="returned what its signature does not say"):
        registry.find(name).run(encode_value({}))


@function()
def of_a_thread(value: threading.Thread) -> None:
    """A parameter that is no data."""


def test_a_type_that_can_not_be_sent_is_named_to_the_author() -> None:
    with pytest.raises(Invalid, match=r"function of_a_thread: .* the type Thread, which can.t be sent; use"):
        FunctionRegistry().add(of_a_thread)


def test_a_result_of_too_many_values_is_none_for_json() -> None:
    with pytest.raises(CostlyResult, match="application/msgpack"):
        to_json(msgspec.msgpack.encode([1] * 300_000))
    with pytest.raises(Invalid, match="ends too early"):
        to_json(b"\xdd\xff\xff\xff\xff" + bytes(100_000))


def test_a_large_result_of_few_values_is_json() -> None:
    value = {
        "cloud": np.zeros(100_000),
        "data": bytes(100_000),
        "text": "a" * 70_000,
        "short": "b" * 300,
        "numbers": [1, -1, 300, 70_000, 2**33, -200, -40_000, -(2**33), 0.5, True, False, None] * 3000,
        "maps": [{str(i): i for i in range(20)}] * 20,
        "tuple": list(range(20)),
    }
    expected = {**value, "cloud": array_bytes(np.zeros(100_000))}
    assert msgspec.json.decode(to_json(encode_value(value))) == msgspec.json.decode(
        msgspec.json.encode(expected)
    )
    assert io.BytesIO(expected["cloud"]).read(6) == b"\x93NUMPY"
