"""Messages in PNG."""

from __future__ import annotations

import base64
import io
import json

import pytest
from PIL import Image

from relay_server.channels import encodings
from relay_server.channels.encodings import MessageEncoding
from tests.worlds.relay import messages_in


def picture_of(message: bytes) -> Image.Image:
    """The image in a ``png`` operation."""
    operation = json.loads(message)
    assert list(operation) == ["op", "data"] and operation["op"] == "png"
    return Image.open(io.BytesIO(base64.b64decode(operation["data"], validate=True)))


@pytest.mark.parametrize("length", [*range(2, 40), 3 * 17 * 17, 3 * 17 * 17 + 1, 100_000])
def test_the_pixels_are_the_bytes(length: int) -> None:
    """8-bit RGB without alpha, row by row, padded with line feeds, about square."""
    message = (b'"' + b"0123456789" * 10_000)[: length - 1] + b'"'
    picture = picture_of(encodings.png(message))
    assert picture.mode == "RGB"
    assert picture.tobytes().rstrip(b"\n") == message
    width, height = picture.size
    assert 3 * width * (height - 1) < length <= 3 * width * height
    assert length < 100 or abs(width - height) <= 2


def test_characters_beyond_ascii_are_escaped() -> None:
    """In browsers roslib 1.x reads each byte as a character, so the JSON is ASCII."""
    message = json.dumps({"data": "naïve 😀 \\u00e9 \x7f"}, ensure_ascii=False).encode()
    data = picture_of(encodings.png(message)).tobytes()
    assert data.isascii()
    assert json.loads(data) == json.loads(message)


def test_ascii_is_unchanged() -> None:
    """Quotes, backslashes and white space are kept, next to escaped characters too."""
    message = '{"a\\"é\\\\é\\\\": "\\\\\\"\\n\\u00e9",\r\n\t"b" : ["\\/", "é\\\\"]}'
    data = picture_of(encodings.png(message.encode())).tobytes().rstrip(b"\n")
    assert data.decode() == message.replace("é", "\\u00e9")
    assert json.loads(data) == json.loads(message)


def test_pixels_are_all_that_remains() -> None:
    """No chunk may make a browser change the colours, since they carry the text."""
    data = base64.b64decode(json.loads(encodings.png(b'{"op":"status"}'))["data"])
    at, kinds = 8, []
    while at < len(data):
        kinds.append(data[at + 4 : at + 8])
        at += 12 + int.from_bytes(data[at : at + 4], "big")
    assert set(kinds) == {b"IHDR", b"IDAT", b"IEND"}


def test_long_answers_come_plain() -> None:
    """Long JSON would block the relay while it is made into a PNG."""
    for length, op in ((encodings.MAX_PNG, "png"), (encodings.MAX_PNG + 1, "status")):
        message = b'{"op":"status"}'.ljust(length)
        [(first, payload)] = messages_in(encodings.frames(message, MessageEncoding("png")))
        assert (first, json.loads(payload)["op"]) == (0x81, op)
