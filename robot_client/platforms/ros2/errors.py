"""Errors of ROS 2 as texts for clients."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from rclpy.exceptions import NameValidationException
from rclpy.validate_namespace import validate_namespace

from relay_protocol.errors import Invalid, SwitchboardError

_SOURCE_LOCATION = re.compile(r", at \.{0,2}/")


def error_text(error: BaseException) -> str:
    """Text of an error of rclpy or the middleware, without the source locations it contains."""
    text = str(error)
    location = _SOURCE_LOCATION.search(text)
    if location is not None:
        text = text[: location.start()]
    return text.strip() or type(error).__name__


@contextmanager
def refusals(what: str) -> Iterator[None]:
    """Turn errors of ROS 2 into :class:`Invalid`.

    :param what: what is requested, for the error
    :raises Invalid: ROS 2 refused it
    """
    try:
        yield
    except SwitchboardError:
        raise
    except Exception as error:
        raise Invalid(f"ROS 2 refuses {what}: {error_text(error)}") from None


def check_namespace(namespace: str) -> None:
    """Check a namespace; rclpy would check it only after it has created a part of the node.

    :param namespace: with or without a leading slash; empty for none
    :raises Invalid: it is not valid
    """
    try:
        validate_namespace(namespace if namespace.startswith("/") else f"/{namespace}")
    except NameValidationException as error:
        raise Invalid(f"'{namespace}' is not a ROS namespace: {in_one_line(error)}") from None


def in_one_line(error: Exception) -> str:
    """Text of rclpy's error for an invalid name, without the arrow below it."""
    reason, *name = str(error).splitlines()[:2]
    return ": ".join((reason.rstrip(":."), *(each.strip() for each in name)))
