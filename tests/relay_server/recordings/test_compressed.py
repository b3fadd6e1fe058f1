"""Images as messages."""

from __future__ import annotations

import base64
import json

import pytest

from relay_protocol.ros_types import TypeRegistry
from relay_server.recordings import recorder


@pytest.mark.parametrize("codec", ["jpeg", "png"])
@pytest.mark.parametrize("size", [0, 1, 1000])
def test_an_image_is_a_message_of_its_type(codec: str, size: int) -> None:
    """The common codec reads and writes the same bytes."""
    types = TypeRegistry()
    types.add(recorder.TYPE, recorder.TEXT)
    picture = bytes(number % 256 for number in range(size))
    message = recorder.message(picture, 1_700_000_000_123_456_789, codec)
    fields = json.loads(types.to_json(recorder.TYPE, message))
    assert fields == {
        "header": {"stamp": {"sec": 1_700_000_000, "nanosec": 123_456_789}, "frame_id": ""},
        "format": codec,
        "data": base64.b64encode(picture).decode(),
    }
    assert types.from_json(recorder.TYPE, fields, 0) == message


def test_the_topic_is_named_as_image_transport_has_it() -> None:
    """A topic that has such a name keeps it."""
    assert recorder.topic_of("/front/image_raw") == "/front/image_raw/compressed"
    assert recorder.topic_of("/front/image_raw/compressed") == "/front/image_raw/compressed"
