"""ROS 2's errors as words for people far from the robot."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from rclpy.exceptions import NameValidationException
from rclpy.validate_namespace import validate_namespace

from relay_protocol.errors import Invalid, SwitchboardError

_PLACE = re.compile(r", at \.{0,2}/")


def in_words(error: BaseException) -> str:
    """What an error of rclpy or the middleware says, without the places in their sources that it was built from."""
    text = str(error)
    place = _PLACE.search(text)
    if place is not None:
        text = text[: place.start()]
    return text.strip() or type(error).__name__


@contextmanager
def refusals(what: str) -> Iterator[None]:
    """Say what ROS 2 has against something.

    :param what: what is tried
    :raises Invalid: it was refused
    """
    try:
        yield
    except SwitchboardError:
        raise
    except Exception as error:
        raise Invalid(f"ROS 2 refuses {what}: {in_words(error)}") from None


def check_namespace(namespace: str) -> None:
    """See that nodes can have this namespace; rclpy would find out only when half of a node is there.

    :param namespace: with or without a slash in front; empty for none
    :raises Invalid: it can't be one
    """
    try:
        validate_namespace(namespace if namespace.startswith("/") else f"/{namespace}")
    except NameValidationException as error:
        raise Invalid(f"'{namespace}' is no ROS namespace: {in_one_line(error)}") from None


def in_one_line(error: Exception) -> str:
    """What rclpy says of a name that can't be, without the arrow it draws below."""
    reason, *name = str(error).splitlines()[:2]
    return ": ".join((reason.rstrip(":."), *(each.strip() for each in name)))
