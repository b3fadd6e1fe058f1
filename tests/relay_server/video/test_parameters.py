"""Parameters of a viewer, as in web_video_server."""

from __future__ import annotations

from typing import Any

import pytest

from relay_protocol import link
from relay_protocol.errors import Invalid
from relay_server.video.parameters import Kind, StreamParameters, parse_parameters


def settings(query: str, kind: Kind = "stream") -> link.VideoSettings:
    """Parsed settings."""
    return parse_parameters(f"topic=/a&{query}", kind).settings


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("", {}),
        ("width=320&height=240&quality=35", {"width": 320, "height": 240, "quality": 35}),
        ("fps=12.5", {"fps": 12.5}),
        ("crop=10,20,300,200&rotate=270", {"crop": (10, 20, 300, 200), "rotate": 270}),
        ("invert&stamp", {"invert": True, "stamp": True}),
        ("invert=true&stamp=false", {"invert": True}),
        ("invert=yes&width=-1&height=-1", {"invert": True}),
        ("invert=false", {}),
        ("quality=0", {"quality": 1}),
        ("type=png", {"codec": "png"}),
        ("type=png&quality=3", {"codec": "png"}),
        ("type=png&quality=-1", {"codec": "png"}),
        ("type=mjpeg", {}),
        ("type=ros_compressed", {"transport": "compressed"}),
        ("qos_profile=sensor_data&default_transport=raw", {"qos": "sensor_data", "transport": "raw"}),
        ("qos_profile=system_default", {}),
        ("codec=jpeg&ticket=xyz&bitrate=100000", {}),
    ],
)
def test_the_parameters_of_web_video_server_are_understood(query: str, expected: dict[str, Any]) -> None:
    """Unsupported ones are ignored."""
    assert settings(query) == link.VideoSettings(**expected)


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("width=-2", "'width' must be a whole number from 0 to 8192"),
        ("height=8193", "from 0 to 8192"),
        ("height=٣", "whole number"),
        ("quality=-1", "'quality' must be a whole number from 0 to 100"),
        ("quality=101", "from 0 to 100"),
        ("fps=nan", "'fps' must be a number from 0 to 1000"),
        ("fps=1001", "from 0 to 1000"),
        ("crop=1,2,3", "'crop' must be x,y,width,height"),
        ("crop=1,2,0,3", "width or height of 0"),
        ("crop=1,2,3,99999", "up to 8192"),
        ("rotate=45", "'rotate' must be one of '0', '90', '180', '270'"),
        ("stamp=maybe", "'stamp' must be one of 'true', '1', 'false', '0', or empty"),
        ("type=vp8", "'type' must be one of 'mjpeg', 'ros_compressed', 'png'"),
        ("codec=h264", "'codec' must be one of 'jpeg'"),
        ("qos_profile=best", "'default', 'sensor_data', 'system_default', or empty"),
        ("default_transport=theora", "'raw', 'compressed'"),
        ("type=ros_compressed&default_transport=raw", "contradict"),
        ("quality=5&quality=6", "'quality' occurs 2 times"),
        ("x=%ff", "not UTF-8"),
        ("x&" * 65, "more than 64 parameters"),
    ],
)
def test_invalid_value_error_names_the_valid_ones(query: str, words: str) -> None:
    """In words for the user."""
    with pytest.raises(Invalid) as failed:
        settings(query)
    assert words in str(failed.value)


@pytest.mark.parametrize("topic", ["", "topic=", "topic=/", "topic=/%0a", "topic=/" + "x" * 255])
def test_a_camera_has_to_be_named(topic: str) -> None:
    """By a valid topic name."""
    with pytest.raises(Invalid, match="topic"):
        parse_parameters(topic, "stream")


def test_a_name_without_slash_is_taken_as_if_it_had_one() -> None:
    """As everywhere."""
    assert parse_parameters("topic=camera/image%20raw", "stream") == StreamParameters(
        "/camera/image raw", link.VideoSettings()
    )


def test_not_everything_can_be_had_everywhere() -> None:
    """H.264 needs a viewer that can decode it."""
    assert settings("codec=h264", "ws").codec == "h264"
