"""Messages in CBOR."""

from __future__ import annotations

import json

import cbor2

from relay_protocol import rosbridge
from relay_server.channels import encodings
from relay_server.channels.encodings import MessageEncoding
from tests.relay_server.memory import messages_in


def test_a_publish_is_a_map_of_three() -> None:
    """The body that is CBOR already goes in as it is."""
    body = cbor2.dumps({"data": float("nan")})
    message = encodings.publish("/tøpic", body)
    assert message.endswith(body)
    decoded = cbor2.loads(message)
    assert list(decoded) == ["op", "topic", "msg"]
    assert (decoded["op"], decoded["topic"]) == ("publish", "/tøpic")
    assert decoded["msg"]["data"] != decoded["msg"]["data"]


def test_raw_has_the_time_and_the_bytes() -> None:
    """The time is divided into seconds and nanoseconds, the bytes are untouched."""
    body = encodings.raw(1_700_000_000_000_000_005, b"\x00\x01\x00\x00\xff")
    assert cbor2.loads(body) == {"secs": 1_700_000_000, "nsecs": 5, "bytes": b"\x00\x01\x00\x00\xff"}


def test_answers_say_what_the_json_says() -> None:
    """An answer in CBOR is a binary message with the same content."""
    message = rosbridge.service_response("/sum", "a", True, b'{"list":[1,2.5,null],"text":"\\u00e9"}')
    for compression in ("cbor", "cbor-raw"):
        [(first, payload)] = messages_in(encodings.frames(message, MessageEncoding(compression)))
        assert first == 0x82
        assert cbor2.loads(payload) == json.loads(message)
