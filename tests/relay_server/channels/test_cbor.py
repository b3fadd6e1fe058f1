"""Messages in CBOR."""

from __future__ import annotations

import json

import cbor2

from relay_protocol import rosbridge
from relay_server.channels import encodings
from relay_server.channels.encodings import MessageEncoding
from tests.worlds.relay import messages_in


def test_a_publish_is_a_map_of_three() -> None:
    """A body in CBOR is inserted unchanged."""
    body = cbor2.dumps({"data": float("nan")})
    message = encodings.publish("/tøpic", body)
    assert message.endswith(body)
    decoded = cbor2.loads(message)
    assert list(decoded) == ["op", "topic", "msg"]
    assert (decoded["op"], decoded["topic"]) == ("publish", "/tøpic")
    assert decoded["msg"]["data"] != decoded["msg"]["data"]


def test_raw_has_the_time_and_the_bytes() -> None:
    """The time has seconds and nanoseconds; the bytes are unchanged."""
    body = encodings.raw(1_700_000_000_000_000_005, b"\x00\x01\x00\x00\xff")
    assert cbor2.loads(body) == {"secs": 1_700_000_000, "nsecs": 5, "bytes": b"\x00\x01\x00\x00\xff"}


def test_answers_have_the_content_of_the_json() -> None:
    message = rosbridge.service_response("/sum", "a", True, b'{"list":[1,2.5,null],"text":"\\u00e9"}')
    for compression in ("cbor", "cbor-raw"):
        [(first, payload)] = messages_in(encodings.frames(message, MessageEncoding(compression)))
        assert first == 0x82
        assert cbor2.loads(payload) == json.loads(message)
