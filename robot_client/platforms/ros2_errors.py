"""ROS 2's errors as words for people far from the robot."""

from __future__ import annotations

import re

_PLACE = re.compile(r", at \.{0,2}/")


def in_words(error: BaseException) -> str:
    """What an error of rclpy or the middleware says, without the places in their sources that it was built from."""
    text = str(error)
    place = _PLACE.search(text)
    if place is not None:
        text = text[: place.start()]
    return text.strip() or type(error).__name__
